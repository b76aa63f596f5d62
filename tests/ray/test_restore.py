"""A checkpoint restores to the very weights that were saved, or raises; portable policies act as RLlib does."""

import json
import pickle
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from trials import make_task, run_trial

from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy
from policies.activations import ACTIVATIONS
from policies.errors import CannotRunError, CheckpointError, NotFoundError
from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.packed.member import Weights
from policies.portable.file import Layer, PolicyNetwork, read_policy, save_policy
from tests.rounding import assert_greedy, assert_network

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

MODULE = "default_policy"
# Of outputs: two hidden layers of 64 at most, a head, activations.
NUM_TERMS = 170


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def trained(
    request: pytest.FixtureRequest, ray_session: None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, Any]]:
    """(checkpoint folder, its Algorithm as it was when it was saved)."""
    from tune_jobs.training.rllib import RLlibEngine

    task = make_task(tmp_path_factory.mktemp("sweep"), request.param)
    engine = RLlibEngine()
    progress = run_trial(task, engine)
    yield Path(task.sweep_place) / progress.checkpoints[-1].path, engine.algorithm
    engine.close()


@pytest.fixture
def checkpoint(trained: tuple[Path, Any], tmp_path: Path) -> Path:
    """A copy of the checkpoint, to be damaged."""
    folder = tmp_path / trained[0].name
    shutil.copytree(trained[0], folder)
    return folder


def learner_state(algo: Any) -> tuple[Weights, Weights]:
    """(weights, optimizer's moments) of the learner, as numpy arrays by name."""
    learner = algo.learner_group._learner
    weights = {name: value.numpy().copy() for name, value in learner.module[MODULE].state_dict().items()}
    states = learner.get_optimizer(MODULE).state_dict()["state"]
    return weights, {f"{index}.{key}": value.numpy().copy() for index, s in states.items() for key, value in s.items()}


def assert_equal_arrays(ours: Weights, theirs: Weights) -> None:
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        np.testing.assert_array_equal(value, theirs[name], err_msg=name)


def test_a_checkpoint_restores_as_the_algorithm_that_was_saved_and_trains_on(trained: tuple[Path, Any]) -> None:
    from tune_jobs.sweeps import verbs as sweeps

    folder, saved = trained
    algo = sweeps.restore(folder)
    weights, moments = learner_state(algo)
    saved_weights, saved_moments = learner_state(saved)
    assert_equal_arrays(weights, saved_weights)
    assert saved_moments
    assert_equal_arrays(moments, saved_moments)
    acting = {name: value.numpy() for name, value in algo.env_runner.module.state_dict().items()}
    assert_equal_arrays(acting, {name: saved_weights[name] for name in acting})
    assert algo.iteration == saved.iteration == 2
    groups = [algorithm.learner_group._learner.get_optimizer(MODULE).param_groups[0] for algorithm in (algo, saved)]
    assert [{key: group[key] for key in ("lr", "eps")} for group in groups[:1]] == [
        {key: group[key] for key in ("lr", "eps")} for group in groups[1:]
    ]
    steps_before = saved.metrics.peek(("env_runners", "num_env_steps_sampled_lifetime"))
    for _ in range(2):
        # Two: after a restore DQN first fills its replay buffer again.
        result = algo.train()
    assert algo.iteration == 4
    assert result["env_runners"]["num_env_steps_sampled_lifetime"] > steps_before
    changed, _ = learner_state(algo)
    assert any(not np.array_equal(changed[name], weights[name]) for name in weights)
    algo.stop()


def test_any_altered_or_missing_file_is_an_error_that_names_it(checkpoint: Path) -> None:
    from tune_jobs.sweeps import verbs as sweeps

    files = json.loads((checkpoint / "manifest.json").read_text())["files"]
    on_disk = {path.relative_to(checkpoint).as_posix() for path in checkpoint.rglob("*") if path.is_file()}
    assert set(files) == on_disk - {"manifest.json"}
    assert any(name.startswith("rllib/") for name in files)
    for name in files:
        path = checkpoint / name
        content = path.read_bytes()
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]) if content else b"x")
        with pytest.raises(CheckpointError, match=f"(?s){name}.*SHA-256"):
            sweeps.restore(checkpoint)
        path.write_bytes(content + b" ")
        with pytest.raises(CheckpointError, match=name):
            sweeps.restore(checkpoint)
        path.unlink()
        with pytest.raises(CheckpointError, match=f"lacks the file {name}"):
            sweeps.restore(checkpoint)
        path.write_bytes(content)
    sweeps.restore(checkpoint).stop()


def test_a_folder_that_is_no_checkpoint_is_an_error(checkpoint: Path, tmp_path: Path) -> None:
    from tune_jobs.sweeps import verbs as sweeps

    with pytest.raises(NotFoundError, match="nowhere"):
        sweeps.restore(tmp_path / "nowhere")
    (checkpoint / "manifest.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"manifest\.json"):
        sweeps.restore(checkpoint)
    (checkpoint / "manifest.json").unlink()
    with pytest.raises(NotFoundError):
        sweeps.restore(checkpoint)


def test_what_rllib_cannot_restore_is_an_error(checkpoint: Path) -> None:
    """Also where nobody looked at the hashes."""
    from policies.rllib.restore import restore_algorithm

    state = next((checkpoint / "rllib" / "learner_group").rglob("module_state.pkl"))
    state.write_bytes(b"\x80\x04N.")  # the pickle of None
    with pytest.raises(CheckpointError, match="rllib"):
        restore_algorithm(checkpoint / "rllib", read_policy(checkpoint).network)


def test_an_rllib_checkpoint_without_its_algorithms_state_is_an_error(checkpoint: Path) -> None:
    from policies.rllib.restore import restore_algorithm

    (checkpoint / "rllib" / "class_and_ctor_args.pkl").unlink()
    with pytest.raises(CheckpointError, match="RLlib cannot restore"):
        restore_algorithm(checkpoint / "rllib")


def test_a_checkpoint_that_was_trained_on_a_gpu_is_restored_where_there_is_none(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told by what RLlib makes the Algorithm of; weights and moments are NumPy's in it, wherever they were trained."""
    from policies.rllib.restore import restore_algorithm

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    file = checkpoint / "rllib" / "class_and_ctor_args.pkl"
    made_of = pickle.loads(file.read_bytes())
    made_of["ctor_args_and_kwargs"][0][0]["num_gpus_per_learner"] = 0.25
    file.write_bytes(pickle.dumps(made_of))
    algo = restore_algorithm(checkpoint / "rllib", read_policy(checkpoint).network)
    assert algo.config.num_gpus_per_learner == 0
    assert algo.train()["training_iteration"] == 3
    algo.stop()


def test_a_checkpoint_of_more_env_runners_than_cpus_is_restored_without_them(checkpoint: Path) -> None:
    """RLlib would wait for their CPUs without an end."""
    from tune_jobs.training.rllib import algorithm_from_checkpoint

    file = checkpoint / "rllib" / "class_and_ctor_args.pkl"
    made_of = pickle.loads(file.read_bytes())
    made_of["ctor_args_and_kwargs"][0][0]["num_env_runners"] = 64
    file.write_bytes(pickle.dumps(made_of))
    algo = algorithm_from_checkpoint(checkpoint)
    assert algo.config.num_env_runners == 0
    assert algo.train()["training_iteration"] == 3
    algo.stop()


@pytest.mark.parametrize(("num_cpus", "num_left"), [(2.0, 1), (1.0, 0)], ids=["enough", "few"])
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_env_runners_are_restored_where_there_are_cpus_for_them_and_for_one_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algorithm: str, num_cpus: float, num_left: int
) -> None:
    from tune_jobs.training.rllib import RLlibEngine, algorithm_from_checkpoint

    engine = RLlibEngine()
    engine.build(make_task(tmp_path, algorithm, num_env_runners=1), None)
    engine.train_iteration()
    engine.save(tmp_path)
    save_policy(engine.policy(), tmp_path)
    engine.close()
    monkeypatch.setattr("ray.cluster_resources", lambda: {"CPU": num_cpus})
    algo = algorithm_from_checkpoint(tmp_path)
    assert (algo.config.num_env_runners, algo.env_runner_group.num_remote_env_runners()) == (num_left, num_left)
    assert algo.train()["training_iteration"] == 2
    algo.stop()


def test_a_process_that_has_joined_no_ray_counts_its_own_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    from tune_jobs.training import rllib

    monkeypatch.setattr("ray.cluster_resources", lambda: {"CPU": 5.0})
    assert rllib._num_cpus() == 5
    monkeypatch.setattr("ray.is_initialized", lambda: False)
    monkeypatch.setattr(rllib, "usable_cpus", lambda: 3.0)
    assert rllib._num_cpus() == 3


def test_a_trial_with_a_gpu_is_not_restored_on_the_cpu(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trial that goes on where PyTorch sees no GPU has to fail: it would go on many times slower, and unnoticed."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    from tune_jobs.training.rllib import RLlibEngine

    task = replace(make_task(tmp_path / "sweep"), num_gpus=0.25)
    with pytest.raises(CannotRunError, match=r"num_gpus is 0\.25"):
        RLlibEngine().build(task, checkpoint)


@pytest.mark.parametrize("part", ["weight", "bias"])
@pytest.mark.parametrize("number", [0, 1])
def test_weights_other_than_the_saved_ones_are_an_error(checkpoint: Path, number: int, part: str) -> None:
    """One number of one layer, in the last bit."""
    from policies.rllib.restore import restore_algorithm

    network = read_policy(checkpoint).network
    restore_algorithm(checkpoint / "rllib", network).stop()
    layers = list(network.layers)
    arrays = {"weight": layers[number].weight.copy(), "bias": layers[number].bias.copy()}
    arrays[part].flat[-1] = np.nextafter(arrays[part].flat[-1], np.float32(np.inf))
    layers[number] = Layer(**arrays, activation=layers[number].activation)
    with pytest.raises(CheckpointError, match=f"layer {number}"):
        restore_algorithm(checkpoint / "rllib", PolicyNetwork(network.kind, tuple(layers)))


def test_an_env_runner_with_other_weights_than_the_learner_is_an_error(trained: tuple[Path, Any]) -> None:
    from policies.rllib.restore import check_weights, restore_algorithm

    folder, _ = trained
    network = read_policy(folder).network
    algo = restore_algorithm(folder / "rllib", network)
    with torch.no_grad():
        next(algo.env_runner.module.encoder.parameters()).add_(1.0)
    with pytest.raises(CheckpointError, match="env runner"):
        check_weights(algo, network)
    algo.stop()


# -- portable policies


def rllib_actions(algo: Any, obs: NDArray[np.float32]) -> Any:
    """Greedy actions as RLlib computes and sends them to the environment."""
    from ray.rllib.utils.spaces.space_utils import unsquash_action

    module = algo.env_runner.module
    with torch.no_grad():
        out = module.forward_inference({"obs": torch.from_numpy(obs)})
        if "actions" in out:
            actions = out["actions"]
        else:
            dist = module.get_inference_action_dist_cls().from_logits(out["action_dist_inputs"])
            actions = dist.to_deterministic().sample()
    space = algo.env_runner.env.single_action_space
    if isinstance(space, gym.spaces.Box):
        assert algo.config.normalize_actions
        return unsquash_action(actions.numpy(), space)
    return actions.numpy() + space.start


def spread_actions(algo: Any, obs: NDArray[np.float32]) -> None:
    """Set weights with which activations saturate, discrete actions differ, and continuous ones reach both bounds."""
    module = algo.learner_group._learner.module[MODULE]
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.mul_(3.0)
        head = module.pi if hasattr(module, "pi") else module.af
        encoder = module._actor if hasattr(module, "pi") else module.encoder
        outputs = head(encoder(module.prepare(torch.from_numpy(obs))))
        head.weight.div_(outputs.std(dim=0)[:, None])
        head.bias.sub_(outputs.mean(dim=0)).div_(outputs.std(dim=0))
    algo.env_runner.module.set_state(module.get_state(inference_only=True))


NETWORKS: dict[str, tuple[Algorithm, str, dict[str, Any]]] = {
    "ppo-separate": ("ppo", "Acrobot-v1", {"vf_share_layers": False}),
    "ppo-shared": ("ppo", "Acrobot-v1", {"vf_share_layers": True}),
    "ppo-discrete-from-5": ("ppo", "TestTicks-v0", {}),
    "ppo-continuous": ("ppo", "Pendulum-v1", {}),
    "ppo-continuous-shared": ("ppo", "Pendulum-v1", {"vf_share_layers": True}),
    "dqn-dueling": ("dqn", "Acrobot-v1", {"dueling": True}),
    "dqn-plain": ("dqn", "Acrobot-v1", {"dueling": False}),
}


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("network", NETWORKS)
def test_greedy_actions_of_the_policy_file_are_rllibs(network: str, activation: str, tmp_path: Path) -> None:
    from policies.rllib.config import build_algorithm_config
    from policies.rllib.restore import portable_policy

    algorithm, env_id, values = NETWORKS[network]
    settings = {"hidden_sizes": (24, 16), "activation": activation, **values}
    hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, settings))
    torch.manual_seed(0)
    algo = build_algorithm_config(hyperparams, env_id=env_id, seed=0).build_algo()
    obs_space = algo.env_runner.env.single_observation_space
    obs = np.random.default_rng(1).normal(scale=2.0, size=(1_000, *obs_space.shape)).astype(np.float32)
    spread_actions(algo, obs)
    save_policy(portable_policy(algo, hyperparams, env_id=env_id, env_args={}), tmp_path)
    policy = load_policy(tmp_path)
    assert isinstance(policy, NetworkPolicy)
    expected = rllib_actions(algo, obs)
    algo.stop()
    actions = np.asarray(policy.act(obs))
    assert len(np.unique(expected)) > 1
    if isinstance(policy.action_space, gym.spaces.Box):
        low, high = policy.action_space.low, policy.action_space.high
        assert (expected.min(), expected.max()) == (low, high)
        assert np.mean((expected > low) & (expected < high)) > 0.2
        # Weights are three times their usual size here, so sums cancel more; stretched to +-2.
        assert_network(actions, expected, num_terms=9 * NUM_TERMS)
    else:
        assert isinstance(policy.action_space, gym.spaces.Discrete)
        start = int(policy.action_space.start)
        assert_greedy(actions - start, expected - start, policy.outputs(obs), num_terms=9 * NUM_TERMS)
    one = policy.act(obs[0])
    assert np.array_equal(one, actions[0])


def test_trained_policies_act_as_their_checkpoints(trained: tuple[Path, Any]) -> None:
    folder, saved = trained
    obs = np.random.default_rng(2).normal(size=(1_000, 4)).astype(np.float32)
    policy = load_policy(folder)
    assert isinstance(policy, NetworkPolicy)
    assert_greedy(policy.act(obs), rllib_actions(saved, obs), policy.outputs(obs), num_terms=NUM_TERMS)


def test_a_network_other_than_the_hyperparameters_say_is_an_error(trained: tuple[Path, Any]) -> None:
    from policies.rllib.restore import portable_policy

    _, saved = trained
    algorithm: Algorithm = "dqn" if "DQN" in type(saved).__name__ else "ppo"
    cases: list[tuple[dict[str, Any], str]] = [
        ({"hidden_sizes": (8, 8)}, "no weights"),
        ({"hidden_sizes": (9,)}, "hidden layers"),
        *([({"hidden_sizes": (8,), "vf_share_layers": True}, "no weights")] if algorithm == "ppo" else []),
    ]
    for values, what in cases:
        hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, values))
        with pytest.raises(CheckpointError, match=what):
            portable_policy(saved, hyperparams, env_id="CartPole-v1", env_args={})


def test_the_policy_of_a_checkpoint_tells_how_it_was_trained(trained: tuple[Path, Any]) -> None:
    folder, _ = trained
    policy = NetworkPolicy(read_policy(folder))
    training = policy.portable.training
    assert (training["trial_id"], training["iteration"], policy.env_id) == ("t0000", 2, "CartPole-v1")
    assert training["hyperparams"]["hidden_sizes"] == [8]
