"""Atari's preprocessing, on a game that needs no emulator and on the emulator's own, and what training alone sees."""

import importlib.util
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from atari_games import ID, NO_OPENCV, Game, needs_opencv, register

from policies.acting.evaluate import evaluate_policy
from policies.acting.policy import RandomPolicy
from policies.envs import modules as env_modules
from policies.envs.atari import AtariTraining
from policies.envs.make import check_env, make_env, make_vector_env
from policies.errors import EnvError, SpecError
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.memory import lowered_by_memory
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec

with_opencv = pytest.mark.skipif(needs_opencv, reason=NO_OPENCV)
NO_NOOPS = {"atari": {"noop_max": 0}}
NATURE = [[32, 8, 4], [64, 4, 2], [64, 3, 1]]


@pytest.fixture(autouse=True)
def _registered() -> None:
    register()


def spec(env: dict[str, Any], **more: Any) -> Any:
    return load_spec({"env": env, "algorithm": "ppo", **more})


# -- what is observed


@with_opencv
def test_a_step_is_four_frames_and_shows_the_brighter_of_the_last_two_as_a_small_grey_image_of_bytes() -> None:
    env = make_env(ID, NO_NOOPS)
    assert env.observation_space == gym.spaces.Box(0, 255, (84, 84, 1), np.uint8)
    env.reset()
    observation, reward, *_ = env.step(0)
    # Frames 3 and 4: each is bright where the other is not.
    assert (observation.dtype, observation.shape) == (np.uint8, (84, 84, 1))
    assert {int(observation[0, 0, 0]), int(observation[0, 83, 0])} == {103, 104}
    assert reward == 4.0


@with_opencv
def test_frames_are_stacked_along_the_channels() -> None:
    env = make_env(ID, {**NO_NOOPS, "frame_stack": 4})
    assert env.observation_space == gym.spaces.Box(0, 255, (84, 84, 4), np.uint8)
    env.reset()
    for _ in range(3):
        observation, *_ = env.step(0)
    assert observation[0, 0].tolist() == [0, 103, 107, 111]
    vectors = make_vector_env(ID, {**NO_NOOPS, "frame_stack": 4}, 2)
    assert vectors.single_observation_space == env.observation_space
    vectors.reset()
    for _ in range(3):
        seen, *_ = vectors.step(np.zeros(2, np.int64))
    assert np.array_equal(seen[1], observation)


@with_opencv
def test_a_game_begins_with_a_random_number_of_no_ops_that_follows_from_its_seed() -> None:
    env, game = make_env(ID, {"atari": {"noop_max": 9}}), None
    begins = []
    for seed in (*range(12), 3):
        env.reset(seed=seed)
        game = env.unwrapped
        begins.append(game.ale.frame)  # type: ignore[attr-defined]
    assert set(begins) <= set(range(1, 10))
    assert len(set(begins)) > 3
    assert begins[3] == begins[-1]


@with_opencv
def test_limits_count_env_steps_and_the_emulators_frames_become_some() -> None:
    assert check_env(ID, NO_NOOPS).max_episode_steps == 10
    assert check_env(ID, {**NO_NOOPS, "max_episode_steps": 3}).max_episode_steps == 3
    assert check_env(ID, {"atari": {"noop_max": 0, "frame_skip": 2}}).max_episode_steps == 20
    for env_args, steps in (({"max_episode_steps": 3}, 3), ({}, 8)):
        env = make_vector_env(ID, {**NO_NOOPS, **env_args}, 1)
        env.reset()
        ends = [bool(np.logical_or(*env.step(np.zeros(1, np.int64))[2:4])[0]) for _ in range(8)]
        assert ends.index(True) + 1 == steps


@with_opencv
def test_the_limit_of_the_registry_counts_env_steps_too() -> None:
    limited = "TestLimitedAtari-v0"
    register: Any = gym.register
    register(limited, Game, max_episode_steps=5)
    try:
        limits: list[tuple[dict[str, Any], int]] = [
            ({}, 5), ({"max_episode_steps": 7}, 7), ({"max_num_frames_per_episode": 8}, 2),
        ]  # fmt: skip
        for env_args, steps in limits:
            args = {**NO_NOOPS, **env_args}
            assert check_env(limited, args).max_episode_steps == steps
            env, vectors = make_env(limited, args), make_vector_env(limited, args, 1)
            env.reset()
            vectors.reset()
            ends = [env.step(0)[2:4] for _ in range(steps)]
            theirs = [vectors.step(np.zeros(1, np.int64))[2:4] for _ in range(steps)]
            assert ends == [(False, False)] * (steps - 1) + [(False, True)]
            assert [(bool(over[0]), bool(cut[0])) for over, cut in theirs] == ends
        # Without the preprocessing it is Gymnasium's own.
        assert check_env(limited, {}).max_episode_steps == 5
    finally:
        del gym.registry[limited]


@with_opencv
def test_films_are_as_fast_as_the_game_is() -> None:
    env = make_env(ID, {"atari": {"frame_skip": 4}}, render_mode="rgb_array")
    assert env.metadata["render_fps"] == 15
    env.reset()
    assert np.asarray(env.render()).shape == (210, 160, 3)


# -- what training alone sees: no emulator and no OpenCV are needed for it


def test_training_sees_a_lost_life_as_an_end_and_the_signs_of_rewards() -> None:
    env = make_vector_env(ID, {}, 2, atari_training={"terminal_on_life_loss": True, "clip_rewards": True})
    assert isinstance(env, AtariTraining)
    env.reset()
    seen = []
    for _ in range(10):
        _, rewards, terminated, _, _ = env.step(np.zeros(2, np.int64))
        assert env.lost_lives is not None
        seen.append((rewards[1], env.own_rewards[1], bool(env.lost_lives[1]), bool(terminated[1])))
    # Lives end at frames 10, 20 and 30, in the 3rd, 5th and 8th step; the 9th step only resets.
    assert seen == [
        (1, 4, False, False), (-1, -4, False, False), (1, 4, True, False), (1, 4, False, False), (1, 4, True, False),
        (1, 4, False, False), (1, 4, False, False), (1, 4, False, True), (0, 0, False, False), (1, 4, False, False),
    ]  # fmt: skip


def test_a_life_lost_by_the_no_ops_of_a_reset_is_no_end() -> None:
    env = make_vector_env(ID, {}, 1, atari_training={"terminal_on_life_loss": True, "clip_rewards": False})
    env.reset()
    for _ in range(8):
        _, _, terminated, _, _ = env.step(np.zeros(1, np.int64))
    assert terminated[0]
    game: Any = env.unwrapped.envs[0].unwrapped
    reset = game.reset

    def reset_and_lose_all_but_one(**kwargs: Any) -> Any:
        result = reset(**kwargs)
        game.ale.frame = 21
        return result

    # As many lives as there were when the last one was lost, and one fewer.
    env._lives[:] = 2  # type: ignore[attr-defined]
    game.reset = reset_and_lose_all_but_one
    env.step(np.zeros(1, np.int64))
    assert env.lost_lives is not None  # type: ignore[attr-defined]
    assert not env.lost_lives.any()  # type: ignore[attr-defined]


@pytest.mark.parametrize("clip", [True, False])
def test_each_of_the_two_can_be_left_out(clip: bool) -> None:
    env: Any = make_vector_env(ID, {}, 1, atari_training={"terminal_on_life_loss": not clip, "clip_rewards": clip})
    env.reset()
    lost = []
    for _ in range(3):
        _, rewards, *_ = env.step(np.zeros(1, np.int64))
        lost.append(env.lost_lives is not None and bool(env.lost_lives[0]))
    assert rewards[0] == (1 if clip else 4)
    assert any(lost) is not clip


@with_opencv
def test_evaluations_play_whole_games_for_the_games_own_rewards() -> None:
    wanted = spec({"id": ID, "atari": {"noop_max": 0}, "frame_stack": 4}, hyperparams={"conv_filters": NATURE})
    args = wanted.env.wrapped_args
    info = check_env(ID, args)
    policy = RandomPolicy(info.observation_space, info.action_space, env_id=ID, env_args=args)
    episodes = evaluate_policy(policy, env_id=ID, env_args=args, seeds=[1, 2])
    # 30 frames, four of which cost 1: a step that ends the game is cut short.
    assert (episodes.returns, episodes.lengths) == ((22.0, 22.0), (8, 8))


# -- sweep files


def test_true_is_the_standard_and_a_mapping_changes_it() -> None:
    assert spec({"id": ID, "atari": True}).env.wrapped_args == {
        "atari": {"frame_skip": 4, "noop_max": 30, "screen_size": 84}
    }
    made = spec({"id": ID, "atari": {"frame_skip": 2, "clip_rewards": False}}).env.atari
    assert made.frames["frame_skip"] == 2
    assert made.training == {"terminal_on_life_loss": True, "clip_rewards": False}
    for off in (False, None):
        assert spec({"id": ID, "atari": off}).env.wrapped_args == {}
    # Versions without the field read sweeps that don't use it.
    assert "atari" not in spec({"id": ID}).model_dump(mode="json")["env"]
    assert "atari" in spec({"id": ID, "atari": True}).model_dump(mode="json")["env"]


@pytest.mark.parametrize(
    ("env", "words"),
    [
        ({"atari": True, "pixels": True}, r"env\.pixels: true cannot be used with env\.atari"),
        ({"atari": True, "own_process": True}, r"env\.own_process: true cannot be used with env\.atari"),
        ({"atari": True, "failure_penalty": -1}, r"env\.failure_penalty: -1 cannot be used with env\.atari"),
        ({"atari": {"frame_skips": 4}}, r"env\.atari.*frame_skips"),
        ({"atari": {"frame_skip": 0}}, r"env\.atari.*frame_skip"),
        ({"atari": "yes"}, r"env\.atari"),
    ],
)
def test_what_contradicts_itself_is_refused_with_its_place(env: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=f"(?s){words}"):
        spec({"id": ID, **env})


@pytest.mark.parametrize(
    ("env_id", "args", "words"),
    [
        ("CartPole-v1", {"atari": {}}, r"CartPole-v1 has env\.atari, but is no game of the Arcade"),
        (ID, {"atari": {}, "frameskip": 4}, r"'frameskip' of TestAtari-v0 is 4.*skipped twice"),
        (ID, {"atari": {}, "obs_type": "ram"}, r"'obs_type' of TestAtari-v0 is 'ram'.*observes the screen, not"),
        (ID, {"atari": {"frame_skip": "4"}}, r"atari is \{'frame_skip': '4'\}.*whole numbers"),
        (ID, {"atari": True}, r"atari is True; it must be a mapping"),
    ],
)
def test_what_is_no_game_or_skips_twice_is_refused(env_id: str, args: dict[str, Any], words: str) -> None:
    for make in (make_env, lambda env_id, args: make_vector_env(env_id, args, 2)):
        with pytest.raises(EnvError, match=words):
            make(env_id, args)


def test_it_is_a_field_of_the_env_and_not_an_argument() -> None:
    with pytest.raises(SpecError, match=r"env\.args\.atari is True.*not an argument"):
        make_plan(spec({"id": ID, "args": {"atari": True}}), Machine(num_cpus=2))


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    with pytest.raises(EnvError, match=r"env\.atari needs OpenCV") as caught:
        make_env(ID, NO_NOOPS)
    assert "tune-jobs[atari]" in caught.value.hint


def test_without_the_emulator_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from policies.envs import plugins

    for env_id in [one for one in gym.registry if one.startswith("ALE/") or "NoFrameskip-v" in one]:
        monkeypatch.delitem(gym.registry, env_id)
    monkeypatch.setattr(plugins, "_REGISTER_WHEN_IMPORTED", {})
    plugins.load_env_plugins.cache_clear()
    try:
        for env_id in ("ALE/Pong-v5", "PongNoFrameskip-v4"):
            with pytest.raises(EnvError, match="Arcade Learning Environment, which is not installed") as caught:
                check_env(env_id, {})
            assert "pip install 'tune-jobs[atari]'" in caught.value.hint
    finally:
        plugins.load_env_plugins.cache_clear()


# -- the emulator itself

ale = pytest.mark.skipif(
    importlib.util.find_spec("ale_py") is None or needs_opencv,
    reason="Atari's emulator is not installed (pip install 'tune-jobs[atari]')",
)


@ale
def test_games_of_the_emulator_are_found_and_preprocessed() -> None:
    info = check_env("ALE/Pong-v5", {"atari": {}, "frame_stack": 4}, "dqn")
    assert info.observation_space == gym.spaces.Box(0, 255, (84, 84, 4), np.uint8)
    assert (info.action_space.n, info.max_episode_steps) == (6, 27_000)  # type: ignore[attr-defined]
    env: Any = make_env("ALE/Pong-v5", {"atari": {}})
    assert (env.unwrapped._frameskip, env.unwrapped._obs_type) == (1, "grayscale")
    # Sticky actions are the emulator's own default, and an argument of the game.
    assert env.unwrapped.ale.getFloat("repeat_action_probability") == 0.25
    env = make_env("ALE/Pong-v5", {"atari": {}, "repeat_action_probability": 0.0})
    assert env.unwrapped.ale.getFloat("repeat_action_probability") == 0.0


@ale
def test_a_game_is_the_same_by_itself_and_in_a_vector_with_and_without_preprocessing() -> None:
    for args in ({}, {"atari": {}, "frame_stack": 4}):
        one, many = make_env("ALE/Breakout-v5", args), make_vector_env("ALE/Breakout-v5", args, 2)
        assert many.single_observation_space == one.observation_space
        assert not check_env("ALE/Breakout-v5", args).has_vector_entry_point
        mine, _ = one.reset(seed=3)
        theirs, _ = many.reset(seed=3)
        for action in (1, 2, 3, 0, 2):
            assert np.array_equal(mine, theirs[0])
            mine, *_ = one.step(action)
            theirs, *_ = many.step(np.full(2, action))


@ale
def test_lives_of_the_emulator_are_counted() -> None:
    training = {"terminal_on_life_loss": True, "clip_rewards": True}
    env: Any = make_vector_env("ALE/Breakout-v5", {"atari": {}}, 2, atari_training=training)
    env.reset(seed=0)
    rng, lost, ended = np.random.default_rng(0), 0, 0
    for _ in range(600):
        _, rewards, terminated, truncated, _ = env.step(rng.integers(0, 4, 2))
        lost += int(env.lost_lives[0])
        ended += int(terminated[0] or truncated[0])
        assert set(rewards) <= {-1.0, 0.0, 1.0}
        if ended:
            break
    # Five lives: four are lost, and the game ends with the last.
    assert (lost, ended) == (4, 1)


@ale
def test_a_limit_in_the_registry_counts_env_steps_of_the_emulator() -> None:
    limited = "TestLimitedPong-v0"
    gym.register(limited, "ale_py.env:AtariEnv", kwargs={"game": "pong", "frameskip": 4}, max_episode_steps=40)
    try:
        args = {"atari": {"noop_max": 0}}
        assert check_env(limited, args).max_episode_steps == 40
        env, vectors = make_env(limited, args), make_vector_env(limited, args, 1)
        env.reset(seed=0)
        vectors.reset(seed=0)
        assert [env.step(0)[3] for _ in range(40)].index(True) == 39
        assert [bool(vectors.step(np.zeros(1, np.int64))[3][0]) for _ in range(40)].index(True) == 39
    finally:
        del gym.registry[limited]


@ale
def test_a_game_with_continuous_actions_begins_without_no_ops() -> None:
    args: dict[str, Any] = {"atari": {}, "continuous": True}
    for make in (check_env, lambda env_id, args: make_vector_env(env_id, args, 2)):
        with pytest.raises(EnvError, match=r"env\.atari begins a game with no-ops, up to 30, which") as caught:
            make("ALE/Pong-v5", args)
        assert "Set env.atari.noop_max: 0" in caught.value.hint
    info = check_env("ALE/Pong-v5", {**args, **NO_NOOPS})
    assert info.action_space.shape == (3,)


# -- the plan


@with_opencv
def test_the_plan_knows_what_replayed_images_take_and_runs_fewer_trials_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(env_modules, "_allowed", {"atari_games"})
    wanted = load_spec(
        {
            "env": {"id": "atari_games:Game", "atari": True, "frame_stack": 4},
            "algorithm": "dqn",
            "hyperparams": {"conv_filters": NATURE, "hidden_sizes": [512], "replay_capacity": 100_000},
            "seeds_per_point": 4,
        }
    )

    def planned(memory_bytes: float, **more: Any) -> tuple[int, str]:
        made = make_plan(wanted, Machine(num_cpus=4, memory_bytes=memory_bytes, **more))
        return made.max_concurrent, " ".join(made.notes)

    # 100,000 transitions of two images of 84 x 84 x 4 bytes: 5.6 GB.
    at_once, notes = planned(64e9)
    assert at_once == 4
    why = "a network makes 9,342,976 multiplications for an image of 84 x 84 x 4"
    faster = "and without a GPU packs are the faster engine up to 300,000"
    assert notes == f"No trial is packed, RLlib trains them all: {why}, {faster}."
    at_once, notes = planned(25e9)
    assert at_once == 2
    assert "2 trials instead of 4 run at once: one trial may take 5.7 GB of memory, and half of what" in notes
    at_once, notes = planned(8e9)
    assert at_once == 1
    assert "Trials run one at a time: one trial may take 5.7 GB of memory, more than half of what this machine" in notes
    # On a cluster trials may begin on nodes that join: it is only said.
    at_once, notes = planned(25e9, nodes=((4.0, 0.0),))
    assert at_once == 4
    assert "set resources.max_concurrent" in notes


@pytest.mark.parametrize(("algorithm", "name"), [("dqn", "replay_capacity"), ("ppo", "train_batch_size")])
def test_what_lowers_the_memory_of_a_trial_is_a_hyperparameter_that_it_has(algorithm: Any, name: str) -> None:
    machine = Machine(num_cpus=4, memory_bytes=8e9)
    _, (note,) = lowered_by_memory(machine, 5e9, 4, cpus=1.0, algorithm=algorithm)
    assert note.endswith(f"; hyperparams.{name} is what lowers it.")
