"""RLModule classes of a user's own: they train, restore by themselves, act, and are imported only where allowed."""

import pickle
import sys
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch
from network_builds import build, observations_of, portable, rllib_outputs
from rllib_cases import Build, module_of

from policies.acting.load import load_policy
from policies.errors import CheckpointError, SpecError
from policies.hyperparams import Algorithm, TrainedHyperparams, make_hyperparams
from policies.portable.file import read_policy, save_policy
from tests.narrowing import present
from tests.rounding import assert_greedy, assert_network

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

__all__ = ["build"]

MODULES = "tune_jobs_test_modules"
# One hidden layer of 16 or two of 64 at most, a head, activations, and what stretches actions.
NUM_TERMS = 200


@pytest.fixture
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The module of test classes may be imported, in this test alone."""
    monkeypatch.setattr("policies.envs.modules._allowed", {MODULES})


OWN = {
    "ppo from scratch": ("ppo", "CartPole-v1", "OwnPPO"),
    "ppo continuous": ("ppo", "Pendulum-v1", "OwnPPO"),
    "dqn from ours": ("dqn", "Acrobot-v1", "OwnDQN"),
    "dqn from rllib": ("dqn", "CartPole-v1", "PlainDQN"),
}


@pytest.mark.parametrize("kind", OWN)
@pytest.mark.usefixtures("allowed")
def test_a_module_of_ones_own_trains_restores_and_acts(build: Build, kind: str, tmp_path: Path) -> None:
    import tune_jobs_test_modules
    from ray.rllib.utils.spaces.space_utils import unsquash_action

    from policies.rllib.restore import restore_algorithm

    algorithm, env_id, name = OWN[kind]
    own_class = getattr(tune_jobs_test_modules, name)
    algo, hyperparams = build(algorithm, env_id, rl_module=f"{MODULES}:{name}")
    assert type(module_of(algo)) is type(algo.env_runner.module) is own_class
    assert module_of(algo).model_config["fcnet_hiddens"] == [16]
    before = {key: value.clone() for key, value in module_of(algo).state_dict().items()}
    algo.train()
    assert any(not torch.equal(value, before[key]) for key, value in module_of(algo).state_dict().items())

    save_policy(portable(algo, hyperparams), tmp_path / "policy")
    assert present(read_policy(tmp_path / "policy").network.module).class_path == f"{MODULES}:{name}"
    algo.save_to_path(str(tmp_path / "rllib"))
    restored = restore_algorithm(tmp_path / "rllib", read_policy(tmp_path / "policy").network)
    assert type(module_of(restored)) is type(restored.env_runner.module) is own_class
    for key, value in module_of(algo).state_dict().items():
        assert torch.equal(value, module_of(restored).state_dict()[key])
    restored.train()
    restored.stop()

    policy = load_policy(tmp_path / "policy")
    policy.check_finite()
    obs = observations_of(algo, num=200, scale=2.0)
    outputs = rllib_outputs(algo, obs)
    actions = np.asarray(policy.act(obs))
    if isinstance(policy.action_space, gym.spaces.Box):
        expected = unsquash_action(outputs[:, :1], policy.action_space)
        assert_network(actions, expected, num_terms=NUM_TERMS)
    else:
        assert_greedy(actions, outputs.argmax(axis=1), outputs, num_terms=NUM_TERMS)
    assert np.array_equal(policy.act(obs[0]), actions[0])
    assert np.shape(policy.act(obs[:0])) == (0, *present(policy.action_space.shape))
    # RLlib's own modules hold classes that are made in functions where actions are several choices.
    policy.module.own = lambda: None  # type: ignore[attr-defined]
    assert np.array_equal(pickle.loads(pickle.dumps(policy)).act(obs), actions)


def test_a_module_that_was_not_allowed_is_never_imported(
    build: Build, allowed: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from policies.rllib.restore import restore_algorithm

    algo, hyperparams = build("ppo", rl_module=f"{MODULES}:OwnPPO")
    save_policy(portable(algo, hyperparams), tmp_path / "policy")
    algo.save_to_path(str(tmp_path / "rllib"))
    monkeypatch.setattr("policies.envs.modules._allowed", set())
    monkeypatch.delitem(sys.modules, MODULES)
    with pytest.raises(SpecError, match="not allowed"):
        build("ppo", rl_module=f"{MODULES}:OwnPPO")
    saved = read_policy(tmp_path / "policy")
    with pytest.raises(SpecError, match="not allowed"):
        load_policy(tmp_path / "policy")
    with pytest.raises(SpecError, match="not allowed"):
        restore_algorithm(tmp_path / "rllib", saved.network)
    assert MODULES not in sys.modules


def test_a_module_that_is_gone_is_an_error(
    build: Build, allowed: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """RLlib itself only warns, and goes on with another class."""
    import tune_jobs_test_modules

    from policies.rllib.restore import restore_algorithm

    algo, _ = build("ppo", rl_module=f"{MODULES}:OwnPPO")
    algo.save_to_path(str(tmp_path))
    monkeypatch.delattr(tune_jobs_test_modules, "OwnPPO")
    with pytest.raises(CheckpointError, match="cannot restore"):
        restore_algorithm(tmp_path)


@pytest.mark.parametrize(
    ("algorithm", "values", "name", "words"),
    [
        ("ppo", {}, "NUMBER", "is 3, which is not an RLModule class"),
        ("ppo", {}, "NoValues", "is not a ValueFunctionAPI"),
        ("dqn", {}, "OwnPPO", "is not a QNetAPI"),
        ("ppo", {}, "Nothing", "nothing called 'Nothing'"),
        ("dqn", {"epsilon_schedule": "exponential"}, "PlainDQN", "epsilon_schedule exponential"),
        ("dqn", {"target_network": False, "double_q": False}, "PlainDQN", "target_network is false"),
    ],
)
@pytest.mark.usefixtures("allowed")
def test_classes_that_cannot_be_trained_are_refused(
    algorithm: Algorithm, values: dict[str, Any], name: str, words: str
) -> None:
    from policies.networks.rl_modules import module_spec

    with pytest.raises(SpecError, match=words):
        module_spec(cast("TrainedHyperparams", make_hyperparams(algorithm, values)), f"{MODULES}:{name}")


@pytest.mark.parametrize(("algorithm", "name"), [("ppo", "RecurrentPPO"), ("dqn", "RecurrentDQN")])
@pytest.mark.usefixtures("allowed")
def test_a_recurrent_module_is_refused_where_it_is_built(build: Build, algorithm: Algorithm, name: str) -> None:
    words = f"rl_module '{MODULES}:{name}' is recurrent: .* no state is carried from one step to the next"
    with pytest.raises(SpecError, match=words) as caught:
        build(algorithm, rl_module=f"{MODULES}:{name}")
    assert "frame_stack" in caught.value.hint


@pytest.mark.usefixtures("allowed")
def test_what_a_module_says_that_is_not_implemented_is_told(build: Build) -> None:
    with pytest.raises(NotImplementedError, match="of images only"):
        build("ppo", rl_module=f"{MODULES}:NotOfVectors")


@pytest.mark.usefixtures("allowed")
def test_a_module_that_says_that_it_has_no_state_trains(build: Build) -> None:
    algo, _ = build("ppo", rl_module=f"{MODULES}:OfNoState")
    before = {key: value.clone() for key, value in module_of(algo).state_dict().items()}
    algo.train()
    assert any(not torch.equal(value, before[key]) for key, value in module_of(algo).state_dict().items())


@pytest.mark.usefixtures("allowed")
def test_a_recurrent_module_does_not_act(build: Build, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its class has become so since it was trained."""
    import tune_jobs_test_modules

    algo, hyperparams = build("ppo", rl_module=f"{MODULES}:OwnPPO")
    save_policy(portable(algo, hyperparams), tmp_path / "policy")
    monkeypatch.setattr(tune_jobs_test_modules.OwnPPO, "get_initial_state", lambda self: {"h": torch.zeros(4)})
    with pytest.raises(SpecError, match=f"{MODULES}:OwnPPO' is recurrent"):
        load_policy(tmp_path / "policy")
