"""Checkpoints of before: pickles that name modules as they were called then, and manifests that name no engine."""

import pickle
import shutil
import sys
from pathlib import Path

import pytest

from policies.hyperparams import DQNHyperparams, PPOHyperparams, TrainedHyperparams
from policies.rllib.old_names import _MOVED, old_names
from tune_jobs import restore

SAMPLES = Path(__file__).parent / "samples" / "rllib_of_format_2"
OLD_PACK = Path(__file__).parents[1] / "unit" / "samples" / "packed_of_format_2"


@pytest.mark.ray
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_sweep_of_before_is_restored_and_trains_on(ray_session: None, tmp_path: Path, algorithm: str) -> None:
    shutil.copytree(SAMPLES / algorithm, tmp_path / algorithm)
    # Raises unless its weights are those of the policy file beside it.
    algo = restore(tmp_path / algorithm / "t0000")
    try:
        before = algo.iteration
        algo.train()
        assert (before, algo.iteration) == (2, 3)
    finally:
        algo.stop()


@pytest.mark.ray
def test_a_pack_of_before_manifests_named_engines_is_restored_and_trains_on(ray_session: None, tmp_path: Path) -> None:
    shutil.copytree(OLD_PACK, tmp_path / "pack")
    algo = restore(tmp_path / "pack" / "t0000")
    try:
        before = algo.iteration
        algo.train()
        assert (before, algo.iteration) == (2, 3)
    finally:
        algo.stop()


@pytest.mark.parametrize("made", [DQNHyperparams(lr=0.01), PPOHyperparams(gamma=0.9)], ids=type)
def test_hyperparameters_pickled_before_some_were_new_have_their_defaults(made: TrainedHyperparams) -> None:
    state = made.__getstate__()
    for name in ("conv_filters", "initializer", "normalize_observations"):
        del state["__dict__"][name]
    older = type(made).__new__(type(made))
    older.__setstate__(state)
    assert older.initializer == "torch"
    assert older == made
    assert pickle.loads(pickle.dumps(made)) == made


def test_each_old_name_leads_to_what_it_had() -> None:
    names = {
        "policies.dqn_algorithm": "ReplayDQN",
        "policies.dqn_learner": "DQNLearner",
        "policies.env_runner": "ArrayEnvRunner",
        "policies.exploration": "EpsilonGreedy",
        "policies.ppo_learner": "PPOLearner",
        "tune_jobs.engines.env_runner": "EnvRunner",
    }
    assert set(names) == set(_MOVED)
    for module, name in names.items():
        named = f"c{module}\n{name}\n.".encode()
        with old_names():
            found = pickle.loads(named)
        assert (found.__name__, found.__module__) == (name, _MOVED[module])
        assert module not in sys.modules


def test_a_users_own_module_of_an_old_name_is_theirs_again_afterwards(monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = type(sys)("policies.exploration")
    theirs.Curiosity = dict  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "policies.exploration", theirs)
    with old_names():
        assert pickle.loads(b"cpolicies.exploration\nCuriosity\n.") is dict
    assert sys.modules["policies.exploration"] is theirs
