"""Trials on a game with lives: the learner sees them and the signs of rewards, what is reported does not."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from atari_games import ID, NO_OPENCV, needs_opencv, register
from trials import make_task, run_trial

from policies.acting.evaluate import evaluate_policy
from policies.acting.load import load_policy
from policies.envs.make import make_env
from tune_jobs.training.protocol import TrialTask

if TYPE_CHECKING:
    from tune_jobs.training.rllib import RLlibEngine

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

BOTH = {"terminal_on_life_loss": True, "clip_rewards": True}
GAME = (24.0, 8)
"""The return and the env steps of a game without preprocessing, whatever is done: seven steps of 4, and one of -4."""


@pytest.fixture
def engine() -> Iterator[RLlibEngine]:
    from tune_jobs.training.rllib import RLlibEngine

    register()
    engine = RLlibEngine()
    yield engine
    engine.close()


def game_task(folder: Path, algorithm: str, **changes: Any) -> TrialTask:
    changes = {"num_envs": 2, "conv_filters": ((2, 32, 32),), "atari_training": BOTH} | changes
    return make_task(folder, algorithm, env_id=ID, **changes)


def ends_and_rewards(engine: RLlibEngine, num_steps: int) -> tuple[list[bool], list[float]]:
    """Each step of the first sub-environment as the learner gets it."""
    runner = engine.algorithm.env_runner_group.local_env_runner
    episodes = runner.sample(num_timesteps=2 * num_steps, explore=True)
    ends: list[bool] = []
    rewards: list[float] = []
    # Both games go the same way, and chunks come in the order of their ends.
    for before, episode in itertools.pairwise([None, *episodes[::2]]):
        assert episode is not None
        # Nothing of the life before is in the next one, but the observation that it begins with.
        if before is None or before.is_terminated:
            assert (episode.t_started, episode.observations.lookback) == (0, 0)
        ends += [False] * (len(episode) - 1) + [bool(episode.is_terminated)]
        rewards += episode.get_rewards().tolist()
    return ends, rewards


@pytest.mark.parametrize(
    ("training", "ends", "rewards"),
    [
        (BOTH, (2, 4, 7), [1, -1, 1, 1, 1, 1, 1, 1]),
        ({"terminal_on_life_loss": False, "clip_rewards": True}, (7,), [1, -1, 1, 1, 1, 1, 1, 1]),
        ({"terminal_on_life_loss": True, "clip_rewards": False}, (2, 4, 7), [4, -4, 4, 4, 4, 4, 4, 4]),
        (None, (7,), [4, -4, 4, 4, 4, 4, 4, 4]),
    ],
)
def test_the_learner_of_ppo_gets_lives_as_episodes_and_whole_games_are_counted(
    engine: RLlibEngine, tmp_path: Path, training: dict[str, bool] | None, ends: tuple[int, ...], rewards: list[float]
) -> None:
    engine.build(game_task(tmp_path, "ppo", atari_training=training), None)
    found_ends, found_rewards = ends_and_rewards(engine, 16)
    assert found_rewards == rewards * 2
    assert [index for index, end in enumerate(found_ends[:8]) if end] == list(ends)
    # Over fragments that end in the middle of lives, too.
    for size in (3, 5, 1, 8, 12):
        engine.algorithm.env_runner_group.local_env_runner.sample(num_timesteps=2 * size, explore=True)
    finished = engine.algorithm.env_runner_group.local_env_runner.pop_finished_episodes()
    assert len(finished) >= 8
    assert set(finished) == {GAME}


@pytest.mark.parametrize("n_step", [1, 2])
def test_no_transition_of_dqn_looks_beyond_a_lost_life(engine: RLlibEngine, tmp_path: Path, n_step: int) -> None:
    engine.build(game_task(tmp_path, "dqn", n_step=n_step, gamma=0.5), None)
    runner = engine.algorithm.env_runner_group.local_env_runner
    sample = runner.sample_transitions(32, num_env_steps=0, num_episodes=0)
    first = slice(0, 16, 2) if n_step == 1 else slice(None)
    discounts, rewards = sample.transitions.discounts[first], sample.transitions.rewards[first]
    if n_step == 1:
        assert discounts.tolist() == [0.5, 0.5, 0.0, 0.5, 0.0, 0.5, 0.5, 0.0]
        assert rewards.tolist() == [1, -1, 1, 1, 1, 1, 1, 1]
    else:
        # The last two transitions of each life of two games, twice.
        assert (discounts == 0).sum() == 2 * 2 * 6
        assert set(rewards.tolist()) == {0.5, -0.5, 1.5, 1.0}
    assert sample.num_episodes == 4
    assert set(runner.pop_finished_episodes()) == {GAME}


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_what_is_reported_is_the_games_own_and_a_restored_trial_goes_on_alike(
    engine: RLlibEngine, tmp_path: Path, algorithm: str
) -> None:
    task = game_task(tmp_path, algorithm)
    progress = run_trial(task, engine)
    assert progress.training_return == progress.evaluation_return == GAME[0]
    checkpoint = tmp_path / progress.checkpoints[-1].path
    assert load_policy(checkpoint).env_args == {}
    engine.build(task, checkpoint)
    assert set(ends_and_rewards(engine, 8)[1]) == {1.0, -1.0} if algorithm == "ppo" else True
    assert set(engine.train_iteration().episodes) == {GAME}


@pytest.mark.skipif(needs_opencv, reason=NO_OPENCV)
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_the_preprocessed_game_trains_with_the_usual_network_and_travels_with_the_policy(
    engine: RLlibEngine, tmp_path: Path, algorithm: str
) -> None:
    args = {"atari": {"frame_skip": 4, "noop_max": 0, "screen_size": 84}, "frame_stack": 4}
    filters = ((32, 8, 4), (64, 4, 2), (64, 3, 1))
    progress = run_trial(game_task(tmp_path, algorithm, env_args=args, conv_filters=filters), engine)
    # The last step ends with the game, after two of its four frames.
    assert progress.training_return == progress.evaluation_return == 22.0
    policy = load_policy(tmp_path / progress.checkpoints[-1].path)
    assert (policy.env_args, policy.observation_space.shape) == (args, (84, 84, 4))
    assert policy.observation_space.dtype == np.uint8
    env = make_env(ID, policy.env_args)
    observation, _ = env.reset(seed=0)
    assert env.action_space.contains(policy.act(observation))
    assert evaluate_policy(policy, env_id=ID, env_args=policy.env_args, seeds=[1]).returns == (22.0,)
