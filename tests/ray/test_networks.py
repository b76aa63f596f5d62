"""Our RLModules: what they compute, and how their statistics travel."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from network_builds import build, observations_of, portable, rllib_outputs
from rllib_cases import MODULE, Build, learner_of, module_of

from policies.acting.load import load_policy
from policies.acting.policy import NetworkPolicy
from policies.errors import CheckpointError, SpecError
from policies.hyperparams import Algorithm, DQNHyperparams, PPOHyperparams
from policies.portable.file import ConvLayer, save_policy
from tests.rounding import assert_greedy, assert_network

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["build"]

FILTERS = ((6, 4, 2), (4, 2, 1))
# In each of these networks at most: kernels of 4 * 4 * 2 and 2 * 2 * 6, a dense layer of 64, a head, activations.
NUM_TERMS = 300


IMAGES: dict[str, Any] = {"conv_filters": FILTERS, "initializer": "orthogonal"}
KINDS: dict[str, tuple[Algorithm, str, dict[str, Any], dict[str, Any]]] = {
    "ppo conv": ("ppo", "TestShades-v0", {}, {**IMAGES, "activation": "relu"}),
    "ppo conv shared": ("ppo", "TestShades-v0", {}, {**IMAGES, "vf_share_layers": True, "activation": "linear"}),
    "ppo conv float": ("ppo", "TestShades-v0", {"as_bytes": False}, {**IMAGES, "activation": "gelu"}),
    "ppo conv continuous": ("ppo", "TestShades-v0", {"num_pushes": 2}, {**IMAGES, "activation": "silu"}),
    "ppo conv normalized": ("ppo", "TestShades-v0", {}, {**IMAGES, "normalize_observations": True}),
    "ppo normalized": ("ppo", "Acrobot-v1", {}, {"normalize_observations": True}),
    "ppo normalized continuous": ("ppo", "Pendulum-v1", {}, {"normalize_observations": True, "vf_share_layers": True}),
    "dqn conv": ("dqn", "TestShades-v0", {}, {**IMAGES, "dueling": False}),
    "dqn conv dueling": ("dqn", "TestShades-v0", {}, {**IMAGES, "activation": "elu"}),
    "dqn normalized": ("dqn", "Acrobot-v1", {}, {"normalize_observations": True, "dueling": False}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_portable_network_computes_what_the_module_computes(build: Build, kind: str, tmp_path: Path) -> None:
    algorithm, env_id, env_args, values = KINDS[kind]
    algo, hyperparams = build(algorithm, env_id, env_args, **values)
    algo.train()
    obs = observations_of(algo, scale=3.0)
    with torch.no_grad():
        head = module_of(algo).pi if algorithm == "ppo" else module_of(algo).af
        # Spread the outputs around 0, so that each action is the best one somewhere.
        outputs = torch.from_numpy(rllib_outputs(algo, obs))
        if algorithm == "ppo" or not values.get("dueling", True):
            head.bias -= outputs.mean(dim=0)
    algo.env_runner.module.set_state(module_of(algo).get_state(inference_only=True))
    expected = rllib_outputs(algo, obs)
    save_policy(portable(algo, hyperparams, env_args), tmp_path)
    policy = load_policy(tmp_path)
    assert isinstance(policy, NetworkPolicy)
    found = policy.outputs(obs)
    if "dueling" in kind:  # the state value is left out
        found, expected = (array - array.mean(axis=1, keepdims=True) for array in (found, expected))
    assert_network(found, expected, num_terms=NUM_TERMS)
    if isinstance(policy.action_space, gym.spaces.Discrete):
        best = expected.argmax(axis=1)
        assert "dueling" in kind or len(np.unique(best)) > 1
        start = int(policy.action_space.start)
        assert_greedy(np.asarray(policy.act(obs)) - start, best, expected, num_terms=NUM_TERMS)
    for index in (0, 7, 999):
        np.testing.assert_array_equal(policy.outputs(obs[index : index + 1])[0], policy.outputs(obs)[index])
        np.testing.assert_array_equal(policy.act(obs[index]), np.asarray(policy.act(obs))[index])


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_training_on_images_moves_all_that_learns(build: Build, algorithm: Algorithm) -> None:
    algo, hyperparams = build(algorithm, "TestShades-v0", conv_filters=FILTERS)
    module = module_of(algo)
    before = {name: value.clone() for name, value in module.state_dict().items()}
    acting_module = algo.env_runner.module
    dtypes: set[torch.dtype] = set()
    prepare = acting_module.prepare

    def spied(obs: torch.Tensor) -> Any:
        dtypes.add(obs.dtype)
        return prepare(obs)

    acting_module.prepare = spied
    algo.train()
    assert dtypes == {torch.uint8}  # a quarter of the memory; the module scales them
    after = module.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    learning = {name for name in before if "target" not in name}
    assert learning - changed == set()
    acting = algo.env_runner.module.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in acting.items())
    if algorithm == "dqn":
        rows = next(algo.replay.batches(1, 4))
        assert rows.obs.dtype == np.uint8  # a quarter of the memory that floats would take
    NetworkPolicy(portable(algo, hyperparams)).check_finite()


def test_pixels_of_cartpole_train(build: Build) -> None:
    for algorithm in ("ppo", "dqn"):
        algo, hyperparams = build(
            algorithm, env_args={"pixels": True}, conv_filters=((8, 8, 4), (8, 3, 2)), activation="relu"
        )
        before = module_of(algo).state_dict()
        before = {name: value.clone() for name, value in before.items()}
        algo.train()
        assert any(not torch.equal(value, before[name]) for name, value in module_of(algo).state_dict().items())
        policy = NetworkPolicy(portable(algo, hyperparams, {"pixels": True}))
        env = algo.env_runner.env
        obs = env.single_observation_space.sample()
        assert policy.act(obs) == rllib_outputs(algo, obs[None]).argmax()


@pytest.mark.parametrize(
    ("env_id", "values", "words"),
    [
        ("CartPole-v1", {"conv_filters": FILTERS}, "conv_filters"),
        ("TestShades-v0", {}, "conv_filters"),
        ("TestShades-v0", {"conv_filters": ((4, 8, 1), (4, 3, 1))}, r"conv_filters\[1\]"),
    ],
)
def test_networks_that_do_not_go_with_the_observations_are_refused(
    env_id: str, values: dict[str, Any], words: str
) -> None:
    from policies.networks.parts import make_encoder
    from policies.networks.rl_modules import module_spec

    env = gym.make(env_id)
    config = module_spec(PPOHyperparams(**values)).model_config
    with pytest.raises(SpecError, match=words):
        make_encoder(env.observation_space, config)


@pytest.mark.parametrize("dueling", [True, False])
def test_a_target_network_is_a_copy_and_need_not_be(build: Build, dueling: bool) -> None:
    module = module_of(build("dqn", initializer="orthogonal", dueling=dueling)[0])
    pairs = module.get_target_network_pairs()
    assert [online for online, _ in pairs] == [module.encoder, module.af, *([module.vf] if dueling else [])]
    for online, target in pairs:
        assert online is not target
        assert all(map(torch.equal, online.parameters(), target.parameters()))
        assert not any(parameter.requires_grad for parameter in target.parameters())
    module = module_of(build("dqn", target_network=False, double_q=False, dueling=dueling)[0])
    assert module.get_target_network_pairs() == []
    obs = torch.randn(3, 4)
    values = module.forward_target({"obs": obs})["qf_preds"]
    torch.testing.assert_close(values, module.compute_q_values({"obs": obs})["qf_preds"])
    assert not values.requires_grad


# -- statistics of observations


def statistics(build: Build, **values: Any) -> Any:
    algo, _ = build("ppo", normalize_observations=True, **values)
    return module_of(algo)


def test_statistics_of_batches_are_those_of_all_observations(build: Build) -> None:
    module = statistics(build)
    rng = np.random.default_rng(0)
    # Batches of other means, and of one observation; a mean far from 0.
    parts = [
        rng.normal(loc=mean, scale=scale, size=(n, 4)) for mean, scale, n in ((0, 1, 50), (3, 2, 1), (100, 5, 400))
    ]
    for part in [*parts, np.zeros((0, 4))]:
        module.update_observation_statistics(part.astype(np.float32))
    everything = np.concatenate(parts).astype(np.float32).astype(np.float64)
    assert int(module.obs_count) == 451
    np.testing.assert_allclose(module.obs_mean, everything.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(module.obs_var, everything.var(axis=0), rtol=1e-5)
    far = torch.full((1, 4), 1e6)
    torch.testing.assert_close(module.prepare(torch.cat([far, -far])), torch.tensor([[10.0] * 4, [-10.0] * 4]))


def test_without_observations_nothing_is_shifted(build: Build) -> None:
    obs = torch.randn(5, 4)
    torch.testing.assert_close(statistics(build).prepare(obs), obs)


def test_bytes_are_scaled_before_they_are_counted(build: Build) -> None:
    module = statistics(build, env_id="TestShades-v0", conv_filters=FILTERS)
    images = np.random.default_rng(0).integers(0, 256, (30, 12, 9, 2), dtype=np.uint8)
    module.update_observation_statistics(images)
    np.testing.assert_allclose(module.obs_mean, (images / 255).mean(axis=0), rtol=1e-5)
    prepared = module.prepare(torch.from_numpy(images)).numpy()
    np.testing.assert_allclose(prepared.mean(axis=0), 0.0, atol=1e-4)
    np.testing.assert_allclose(prepared.std(axis=0), 1.0, rtol=1e-3)


def test_a_batch_is_trained_with_the_statistics_it_was_sampled_with(build: Build) -> None:
    """Or PPO's ratio would not begin at 1."""
    algo, _ = build("ppo", normalize_observations=True)
    algo.train()
    learner, module, differences = learner_of(algo), module_of(algo), []
    update = learner._update

    def spied(batch: Any, *args: Any, **kwargs: Any) -> Any:
        rows = batch[MODULE]
        with torch.no_grad():
            now = module.forward_train(rows)["action_dist_inputs"]
        mask = rows["loss_mask"]
        differences.append(float((now - rows["action_dist_inputs"])[mask].abs().max()))
        return update(batch, *args, **kwargs)

    learner._update = spied
    count = int(module.obs_count)
    algo.train()
    # Logits of a few tenths, of 300 terms in products of other batch sizes: rounding is below 2e-5 of them.
    assert differences[0] < 1e-5
    assert differences[-1] > 1e-4
    assert int(module.obs_count) > count


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_statistics_are_in_checkpoints(build: Build, algorithm: Algorithm, tmp_path: Path) -> None:
    from policies.rllib.restore import check_weights, restore_algorithm

    algo, hyperparams = build(algorithm, normalize_observations=True)
    algo.train()
    network = portable(algo, hyperparams).network
    algo.save_to_path(str(tmp_path))
    restored = restore_algorithm(tmp_path, network)
    for name, value in module_of(algo).state_dict().items():
        assert torch.equal(value, module_of(restored).state_dict()[name]), name
        if name.startswith("obs_"):
            assert torch.equal(value, restored.env_runner.module.state_dict()[name]), name
    assert int(module_of(restored).obs_count) > 0
    for source, module in (("learner", module_of(restored)), ("env runner", restored.env_runner.module)):
        module.obs_var[1] *= 1.5
        with pytest.raises(CheckpointError, match=f"{source}.*observation statistics"):
            check_weights(restored, network)
        module.obs_var[1] = module_of(algo).obs_var[1]
    check_weights(restored, network)
    restored.train()
    restored.stop()


def test_convolutions_of_a_checkpoint_are_checked(build: Build, tmp_path: Path) -> None:
    from dataclasses import replace

    from policies.rllib.restore import check_weights

    algo, hyperparams = build("ppo", "TestShades-v0", conv_filters=FILTERS)
    network = portable(algo, hyperparams).network
    check_weights(algo, network)
    changed = network.conv[1].weight.copy()
    changed.flat[0] = np.nextafter(changed.flat[0], np.float32(9))
    conv = (network.conv[0], ConvLayer(changed, network.conv[1].bias, 1, "tanh"))
    with pytest.raises(CheckpointError, match="convolution 1"):
        check_weights(algo, replace(network, conv=conv))
    for values, what in (
        ({}, "so many convolutions and hidden layers: 3, its hyperparameters say 1"),
        ({"conv_filters": ((6, 4, 2), (5, 2, 1))}, r"convolutions \[\(6, 4, 2\), \(4, 2, 1\)\]"),
        ({"conv_filters": FILTERS, "normalize_observations": True}, "no weights 'obs_mean'"),
    ):
        with pytest.raises(CheckpointError, match=what):
            portable(algo, PPOHyperparams(**{"hidden_sizes": (16,), **values}))


def test_statistics_that_the_hyperparameters_do_not_name_are_an_error(build: Build) -> None:
    """Or the policy file would be without them, and act on other numbers."""
    algo, _ = build("dqn", normalize_observations=True)
    with pytest.raises(CheckpointError, match="normalised observations: True"):
        portable(algo, DQNHyperparams(hidden_sizes=(16,)))
