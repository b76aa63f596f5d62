"""Checkpoints of packs on games with lives: a restored Algorithm learns from lives and signs as its trial did."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from atari_games import ID, register
from trials import make_task

from policies.envs.make import ATARI_TRAINING
from policies.errors import CheckpointError
from policies.portable.file import save_policy

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

BOTH = {"terminal_on_life_loss": True, "clip_rewards": True}
ONE = {"terminal_on_life_loss": False, "clip_rewards": True}


def checkpoint_of(folder: Path, algorithm: str, training: dict[str, bool] | None) -> Path:
    from tune_jobs.training.packed import PackedEngine

    register()
    engine = PackedEngine(env_kind="scalar")
    changes: dict[str, Any] = {"num_envs": 2, "conv_filters": ((2, 32, 32),), "atari_training": training}
    engine.add(make_task(folder, algorithm, env_id=ID, **changes), None)
    engine.train_iteration()
    checkpoint = folder / "000001"
    save_policy(engine.policy("t0000"), checkpoint)
    engine.save("t0000", checkpoint)
    engine.close()
    return checkpoint


def state_of(checkpoint: Path) -> tuple[Path, dict[str, Any]]:
    path = checkpoint / "packed" / "state.json"
    return path, json.loads(path.read_text())


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
@pytest.mark.parametrize("training", [BOTH, ONE, None])
def test_a_restored_algorithm_learns_from_what_its_trial_did(
    tmp_path: Path, algorithm: str, training: dict[str, bool] | None
) -> None:
    from policies.packed.to_rllib import algorithm_from_checkpoint

    restored = algorithm_from_checkpoint(checkpoint_of(tmp_path, algorithm, training))
    assert restored.config.env_config.get(ATARI_TRAINING) == training
    runner: Any = restored.env_runner
    if algorithm == "dqn":
        sample = runner.sample_transitions(32, num_env_steps=0, num_episodes=0)
        # Of the games' own rewards none is smaller than 4.
        assert set(abs(sample.transitions.rewards)) == ({4.0} if training is None else {1.0})
        # A life of 2, 2 and 3 steps, or a game of 7, and what its last step gives.
        assert (sample.transitions.discounts == 0).sum() == (12 if training == BOTH else 4)
    restored.train()
    restored.stop()


def test_a_checkpoint_from_before_it_was_saved_is_restored_as_it_was(tmp_path: Path) -> None:
    from policies.packed.to_rllib import algorithm_from_checkpoint

    checkpoint = checkpoint_of(tmp_path, "dqn", BOTH)
    path, state = state_of(checkpoint)
    del state["atari_training"]
    path.write_text(json.dumps(state))
    restored = algorithm_from_checkpoint(checkpoint)
    assert ATARI_TRAINING not in restored.config.env_config
    restored.stop()


@pytest.mark.parametrize("damaged", [True, ["clip_rewards"], {"clip_rewards": 1}])
def test_a_damaged_value_is_an_error(tmp_path: Path, damaged: Any) -> None:
    from policies.packed.state import load_member

    checkpoint = checkpoint_of(tmp_path, "dqn", BOTH)
    path, state = state_of(checkpoint)
    path.write_text(json.dumps({**state, "atari_training": damaged}))
    with pytest.raises(CheckpointError, match="does not hold a member's state"):
        load_member(checkpoint / "packed", "t0000")
