"""What training alone sees of games with lives, in packs: the same as of a vector environment for one trial."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from atari_games import ID, NO_OPENCV, Game, needs_opencv, register

from policies.envs import modules as env_modules
from policies.envs.make import make_vector_env
from policies.hyperparams import DQNHyperparams, make_hyperparams
from policies.packed.dqn.n_step import StackedNStep
from policies.packed.envs.make import make_packed_envs
from policies.packed.envs.vector import EnvKind, PackedEnvs, Step
from policies.packed.inputs import Inputs
from policies.packed.ppo.gae import advantages_and_targets
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.training.packed import PackedEngine
from tune_jobs.training.protocol import TrialTask

BOTH = {"terminal_on_life_loss": True, "clip_rewards": True}
IN_PROCESSES = "atari_games:Game"
"""The game without a registry entry, so that other processes find it: it has no limit."""
WHOLE = (24.0, 8)
"""The return and the env steps of a game, whatever is done: seven steps of 4, and one of -4."""
no_emulator = importlib.util.find_spec("ale_py") is None or needs_opencv


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    register()
    monkeypatch.setattr(env_modules, "_allowed", {"atari_games"})


@pytest.fixture
def made() -> Iterator[list[PackedEnvs]]:
    envs: list[PackedEnvs] = []
    yield envs
    for one in envs:
        one.close()


def packed(made: list[PackedEnvs], kind: EnvKind, training: dict[str, bool] | None, num_envs: int = 2) -> PackedEnvs:
    env_id = ID if kind == "scalar" else IN_PROCESSES
    made.append(make_packed_envs(env_id, {}, num_envs, kind=kind, num_processes=2, atari_training=training))
    return made[-1]


def steps(envs: PackedEnvs, num: int) -> list[Step]:
    return [envs.step(np.zeros(len(envs.observations), np.int64)) for _ in range(num)]


# -- the environments


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_a_lost_life_is_the_learners_end_and_rewards_are_signs(made: list[PackedEnvs], kind: EnvKind) -> None:
    envs = packed(made, kind, BOTH)
    envs.add("t0000", 0)
    envs.add("t0001", 5)
    done = steps(envs, 9)
    for row in range(4):
        # Lives end at frames 10, 20 and 30, in the 3rd, 5th and 8th step; the next game begins in the 8th, too.
        assert [int(one.rewards[row]) for one in done] == [1, -1, 1, 1, 1, 1, 1, 1, 1]
        assert [int(one.own_rewards[row]) for one in done] == [4, -4, 4, 4, 4, 4, 4, 4, 4]
        assert [at for at, one in enumerate(done) if one.lost_lives is not None and one.lost_lives[row]] == [2, 4]
        assert [at for at, one in enumerate(done) if one.terminated[row]] == [7]
        assert [at for at, one in enumerate(done) if one.is_last[row]] == [2, 4, 7]


@pytest.mark.parametrize("clip", [True, False])
def test_each_of_the_two_can_be_left_out(made: list[PackedEnvs], clip: bool) -> None:
    envs = packed(made, "scalar", {"terminal_on_life_loss": not clip, "clip_rewards": clip})
    envs.add("t0000", 0)
    done = steps(envs, 3)
    assert [one.rewards[0] for one in done] == ([1, -1, 1] if clip else [4, -4, 4])
    assert [bool(one.is_last[0]) for one in done] == [False, False, not clip]
    assert (done[0].lost_lives is None) is clip


def test_an_environment_without_a_view_of_its_own_is_as_it_was(made: list[PackedEnvs]) -> None:
    envs = packed(made, "scalar", None)
    envs.add("t0000", 0)
    done = steps(envs, 8)
    assert all(one.lost_lives is None and one.rewards is one.own_rewards for one in done)
    assert [bool(one.is_last[0]) for one in done] == [False] * 7 + [True]


@pytest.mark.parametrize("kind", ["scalar", "processes"])
def test_lives_stay_with_their_games_when_members_come_go_and_are_rearranged(
    made: list[PackedEnvs], kind: EnvKind
) -> None:
    envs = packed(made, kind, BOTH)
    envs.add("t0000", 0)
    steps(envs, 1)
    envs.add("t0001", 1)
    steps(envs, 1)
    envs.add("t0002", 2)
    envs.arrange(["t0002", "t0000", "t0001"])
    # Of the third step of t0000, the second of t0001 and the first of t0002, that of t0000 loses a life.
    (step,) = steps(envs, 1)
    assert step.lost_lives is not None
    assert step.lost_lives.tolist() == [False, False, True, True, False, False]
    envs.remove("t0000")
    (step,) = steps(envs, 1)
    assert step.lost_lives is not None
    assert step.lost_lives.tolist() == [False, False, True, True]
    (step,) = steps(envs, 1)
    assert step.lost_lives is not None
    assert step.lost_lives.tolist() == [True, True, False, False]


def test_a_life_lost_by_the_no_ops_of_a_reset_is_no_end(
    made: list[PackedEnvs], monkeypatch: pytest.MonkeyPatch
) -> None:
    envs = make_packed_envs(ID, {"max_episode_steps": 2}, 1, kind="scalar", atari_training=BOTH)
    made.append(envs)
    envs.add("t0000", 0)
    steps(envs, 1)
    reset = Game.reset

    def reset_and_lose_two(self: Any, **kwargs: Any) -> Any:
        result = reset(self, **kwargs)
        self.ale.frame = 21
        return result

    monkeypatch.setattr(Game, "reset", reset_and_lose_two)
    # Its limit ends a game of three lives, and one of one life begins.
    ending, after = steps(envs, 2)
    assert ending.truncated.tolist() == [True]
    for one in (ending, after):
        assert one.lost_lives is not None
        assert one.lost_lives.tolist() == [False]


def test_a_member_that_fails_has_no_lost_lives(made: list[PackedEnvs], monkeypatch: pytest.MonkeyPatch) -> None:
    envs = packed(made, "scalar", BOTH, num_envs=1)
    envs.add("t0000", 0)
    envs.add("t0001", 1)
    steps(envs, 2)
    step = Game.step
    games: list[Any] = []

    def fail_in_the_first(self: Any, action: Any) -> Any:
        games.append(self)
        if self is games[0]:
            self.ale.frame += 9
            raise RuntimeError("broken")
        return step(self, action)

    monkeypatch.setattr(Game, "step", fail_in_the_first)
    (done,) = steps(envs, 1)
    assert list(envs.errors) == ["t0000"]
    assert done.lost_lives is not None
    assert done.lost_lives.tolist() == [False, True]
    (done,) = steps(envs, 1)
    assert done.lost_lives is not None
    assert done.lost_lives.tolist() == [False, False]


@pytest.mark.skipif(no_emulator, reason="Atari's emulator is not installed (pip install 'tune-jobs[atari]')")
def test_a_game_of_the_emulator_loses_the_same_lives_as_in_a_vector_of_its_own(made: list[PackedEnvs]) -> None:
    args = {"atari": {}, "repeat_action_probability": 0.0}
    single: Any = make_vector_env("ALE/Breakout-v5", args, 1, atari_training=BOTH)
    envs = make_packed_envs("ALE/Breakout-v5", args, 1, kind="scalar", atari_training=BOTH)
    made.append(envs)
    envs.add("t0000", 3)
    observations, _ = single.reset(seed=3)
    assert np.array_equal(observations, envs.observations)
    rng, lost = np.random.default_rng(0), 0
    for _ in range(600):
        action = rng.integers(0, 4, 1)
        step = envs.step(action)
        observations, rewards, terminated, _, _ = single.step(action)
        assert np.array_equal(observations, step.final_observations)
        assert step.lost_lives is not None
        assert (rewards[0], single.own_rewards[0]) == (step.rewards[0], step.own_rewards[0])
        assert (single.lost_lives[0], terminated[0]) == (step.lost_lives[0], step.terminated[0])
        lost += int(step.lost_lives[0])
        if terminated[0]:
            break
    assert (lost, bool(terminated[0])) == (4, True)


# -- what is learnt from it


@pytest.mark.parametrize("n_step", [1, 2])
def test_no_transition_of_dqn_looks_beyond_a_lost_life(made: list[PackedEnvs], n_step: int) -> None:
    envs = packed(made, "scalar", BOTH, num_envs=1)
    envs.add("t0000", 0)
    rows = StackedNStep(1, Inputs.of(envs.observation_space), n_step)
    settings = make_hyperparams("dqn", {"gamma": 0.5, "n_step": n_step, "conv_filters": ((2, 32, 32),)})
    assert isinstance(settings, DQNHyperparams)
    rows.add_member("t0000", settings)
    found = []
    for _ in range(16):
        observations = envs.observations.reshape(1, -1)
        found += list(rows.rows(["t0000"], observations, np.zeros(1, np.int64), *steps(envs, 1)))
    made_of = np.concatenate([np.asarray(each).reshape(-1, each.shape[-1]) for each in found])
    rewards, discounts = made_of[:, -2].tolist(), made_of[:, -1].tolist()
    if n_step == 1:
        assert discounts == [0.5, 0.5, 0.0, 0.5, 0.0, 0.5, 0.5, 0.0] * 2
        assert rewards == [1, -1, 1, 1, 1, 1, 1, 1] * 2
    else:
        # The last two transitions of each life of two games.
        assert discounts.count(0.0) == 2 * 2 * 3
        assert set(rewards) == {0.5, -0.5, 1.5, 1.0}


@pytest.fixture
def engine() -> Iterator[PackedEngine]:
    engine = PackedEngine("scalar")
    yield engine
    engine.close()


def task(algorithm: str, training: dict[str, bool] | None, **hyperparams: Any) -> TrialTask:
    own: dict[str, Any] = {"conv_filters": ((2, 32, 32),), "hidden_sizes": (4,), "num_envs": 2}
    sizes = (
        {"train_batch_size": 32, "minibatch_size": 16, "num_epochs": 1}
        if algorithm == "ppo"
        else {"train_batch_size": 8, "learning_starts": 8, "env_steps_per_iteration": 32, "replay_capacity": 64}
    )
    return TrialTask(
        sweep_place=".",
        trial_id=f"{algorithm}-{training}-{hyperparams}",
        seed=0,
        algorithm=algorithm,
        hyperparams=own | sizes | hyperparams,
        env_id=ID,
        env_args={},
        stop=StopSpec(),
        evaluation=EvaluationSpec(),
        checkpoints=CheckpointSpec(),
        evaluation_seeds=(0,),
        atari_training=training,
    )


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_episodes_are_whole_games_of_the_games_own_rewards(engine: PackedEngine, algorithm: str) -> None:
    trial = task(algorithm, BOTH)
    engine.add(trial, None)
    for _ in range(2):
        stats = engine.train_iteration()[trial.trial_id]
        assert not isinstance(stats, Exception)
        assert stats.episodes == (WHOLE,) * 4


@pytest.fixture
def learnt(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What PPO computes advantages from, stack by stack."""
    seen: list[dict[str, Any]] = []

    def spy(rewards: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append({"rewards": rewards.copy(), **kwargs})
        return advantages_and_targets(rewards, *args, **kwargs)

    monkeypatch.setattr("policies.packed.ppo.stack.advantages_and_targets", spy)
    return seen


def test_advantages_of_ppo_end_with_a_life(learnt: list[dict[str, Any]], engine: PackedEngine) -> None:
    engine.add(task("ppo", BOTH), None)
    engine.train_iteration()
    ends = [2, 4, 7, 10, 12, 15]
    for name in ("terminated", "ended"):
        assert np.flatnonzero(learnt[0][name][:, 1]).tolist() == ends
    assert learnt[0]["rewards"][:, 0].tolist() == [1, -1, 1, 1, 1, 1, 1, 1] * 2


def test_trials_that_see_a_game_differently_are_not_stepped_together(
    learnt: list[dict[str, Any]], engine: PackedEngine
) -> None:
    for training in (BOTH, None):
        engine.add(task("ppo", training), None)
    found = engine.train_iteration()
    assert len(found) == 2
    assert all(not isinstance(one, Exception) and one.episodes == (WHOLE,) * 4 for one in found.values())
    assert [one["rewards"][0, 0] for one in learnt] == [1, 4]


@pytest.mark.skipif(needs_opencv, reason=NO_OPENCV)
def test_stacked_frames_of_a_preprocessed_game_go_on_over_a_lost_life(made: list[PackedEnvs]) -> None:
    args = {"atari": {"noop_max": 0}, "frame_stack": 4}
    envs = make_packed_envs(ID, args, 1, kind="scalar", atari_training=BOTH)
    made.append(envs)
    envs.add("t0000", 0)
    third, fourth = steps(envs, 4)[2:]
    assert third.lost_lives is not None
    assert third.lost_lives[0]
    assert fourth.observations[0, 0, 0].tolist()[:3] == third.observations[0, 0, 0].tolist()[1:]
