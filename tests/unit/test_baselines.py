"""Baselines: they act, are written and read, and are played as trials, without learning anything."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

from policies.acting.baselines import ConstantPolicy, baseline_policy
from policies.acting.evaluate import Evaluator, evaluate_policy
from policies.acting.load import load_policy, policy_from_portable
from policies.acting.policy import RandomPolicy
from policies.envs.make import check_env
from policies.envs.own_actions import Numbers
from policies.errors import CheckpointError, SpecError
from policies.hyperparams import Algorithm, ConstantHyperparams, RandomHyperparams
from policies.portable.file import PolicyNetwork, PortablePolicy, read_policy, save_policy
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.store.progress import Progress
from tune_jobs.sweeps import verbs as sweeps
from tune_jobs.training.baseline import BaselineEngine
from tune_jobs.training.protocol import IterationStats, TrialTask
from tune_jobs.training.trial_loop import TrialLoop


def portable(env_id: str, hyperparams: ConstantHyperparams | RandomHyperparams | None = None) -> PortablePolicy:
    info = check_env(env_id, {})
    return baseline_policy(
        hyperparams or RandomHyperparams(),
        env_id=env_id,
        env_args={},
        observation_space=info.observation_space,
        action_space=info.action_space,
    )


# -- policies


def test_a_constant_policy_repeats_its_action_alone_and_in_batches() -> None:
    policy = ConstantPolicy.for_env("CartPole-v1", {}, 1)
    assert policy.act(np.zeros(4)) == 1
    assert cast("NDArray[Any]", policy.act(np.zeros((3, 4)))).tolist() == [1, 1, 1]
    box = ConstantPolicy.for_env("Pendulum-v1", {}, (-0.5,))
    action = box.act(np.zeros(3))
    assert cast("NDArray[Any]", action).dtype == np.float32
    assert cast("NDArray[Any]", action).tolist() == [-0.5]
    assert cast("NDArray[Any]", box.act(np.zeros((2, 3)))).tolist() == [[-0.5], [-0.5]]


@pytest.mark.parametrize(
    ("env_id", "action", "words"),
    [
        ("CartPole-v1", 2, "2 is none of the actions, which are the whole numbers 0 to 1"),
        ("CartPole-v1", -1, "-1 is none"),
        ("CartPole-v1", (1.0,), "which are the whole numbers 0 to 1"),
        ("Pendulum-v1", 0, "0 is none of the actions, each of which is a list of 1 number"),
        ("Pendulum-v1", (0.0, 1.0), "[0.0, 1.0] is none"),
        ("Pendulum-v1", (2.5,), "[2.5] is none of the actions, which lie in [-2.0] to [2.0]"),
        ("Pendulum-v1", (math.nan,), "[nan] is none"),
    ],
)
def test_an_action_that_the_env_does_not_have_is_refused(
    env_id: str, action: int | tuple[float, ...], words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        ConstantPolicy.for_env(env_id, {}, action)
    assert words in caught.value.message
    assert env_id in caught.value.message


def test_the_bounds_themselves_are_actions() -> None:
    space = gym.spaces.Box(-0.1, 0.1, (2,), np.float32)  # 0.1 in 32 bits is more than in 64
    assert (
        cast("NDArray[Any]", ConstantPolicy(space, space, (0.1, -0.1), env_id="x").act(np.zeros(2))).tolist()
        == space.high.tolist()[:1] + space.low.tolist()[1:]
    )


@pytest.mark.parametrize(
    ("env_id", "hyperparams"),
    [
        ("CartPole-v1", RandomHyperparams()),
        ("Pendulum-v1", RandomHyperparams()),
        ("CartPole-v1", ConstantHyperparams(action=1)),
        ("Pendulum-v1", ConstantHyperparams(action=[1.25])),
    ],
)
def test_a_baseline_survives_its_file(
    tmp_path: Path, env_id: str, hyperparams: ConstantHyperparams | RandomHyperparams
) -> None:
    saved = portable(env_id, hyperparams)
    save_policy(saved, tmp_path)
    loaded = load_policy(tmp_path)
    fresh = policy_from_portable(saved)
    assert type(loaded) is (ConstantPolicy if isinstance(hyperparams, ConstantHyperparams) else RandomPolicy)
    assert loaded.description == fresh.description
    seeds = range(5)
    assert evaluate_policy(loaded, env_id=env_id, seeds=seeds) == evaluate_policy(fresh, env_id=env_id, seeds=seeds)
    assert (env_id, read_policy(tmp_path).network.layers) == (loaded.env_id, ())


def test_random_play_is_the_random_policy_to_the_last_action() -> None:
    seeds = range(10)
    ours = evaluate_policy(policy_from_portable(portable("CartPole-v1")), env_id="CartPole-v1", seeds=seeds)
    assert ours == evaluate_policy(RandomPolicy.for_env("CartPole-v1"), env_id="CartPole-v1", seeds=seeds)


@pytest.mark.parametrize(
    "space",
    [gym.spaces.Box(0, 2, (1,), np.int64), gym.spaces.Dict(a=gym.spaces.Box(0, 2, (1,), np.uint8))],
    ids=["box", "dict"],
)
def test_random_play_takes_each_whole_number_as_often(space: gym.Space[Any]) -> None:
    made = Numbers(space)
    policy = RandomPolicy(gym.spaces.Box(-1, 1, (1,)), made, env_id="x", seed=3)
    drawn = [policy.act(np.zeros(1)) for _ in range(3_000)]
    assert all(action in space for action in drawn)
    values = [int((action["a"] if isinstance(action, dict) else action)[0]) for action in drawn]
    # Six standard deviations.
    assert np.bincount(values, minlength=3) == pytest.approx([1_000] * 3, abs=155)
    policy.reset(3)
    assert [policy.act(np.zeros(1)) for _ in range(50)] == drawn[:50]
    # The space that it was given draws by itself.
    made.seed(1)
    wanted = [made.sample().tolist() for _ in range(20)]
    made.seed(1)
    assert [(policy.act(np.zeros(1)), made.sample().tolist())[1] for _ in range(20)] == wanted


def test_random_numbers_that_need_not_be_whole_are_drawn_as_a_box_draws() -> None:
    space = gym.spaces.Box(-2, 3, (2, 2), np.float32)
    made = Numbers(space)
    for drawing in (made, space):
        drawing.seed(5)
    for _ in range(5):
        np.testing.assert_array_equal(made.sample().reshape(2, 2), space.sample())


def test_pushing_left_for_ever_fails_sooner_than_random_play() -> None:
    left, random = (
        evaluate_policy(policy, env_id="CartPole-v1", seeds=range(100)).mean_return
        for policy in (ConstantPolicy.for_env("CartPole-v1", {}, 0), RandomPolicy.for_env("CartPole-v1"))
    )
    assert left < 11
    assert 17 < random < 27


@pytest.mark.parametrize(
    ("network", "words"),
    [
        (PolicyNetwork("constant", (), action=7), "7 is none of the actions"),
        (PolicyNetwork("constant", ()), "None is none of the actions"),
        (PolicyNetwork("random", (), action=1), "has the action 1"),
    ],
)
def test_a_baseline_that_cannot_act_is_not_written(tmp_path: Path, network: PolicyNetwork, words: str) -> None:
    with pytest.raises(CheckpointError, match=words):
        save_policy(dataclasses.replace(portable("CartPole-v1"), network=network), tmp_path)


def test_layers_of_a_baseline_are_refused(tmp_path: Path) -> None:
    from policy_factory import make_portable

    layers = make_portable("CartPole-v1").network.layers
    with pytest.raises(CheckpointError, match="has 3 layers, but takes none"):
        save_policy(dataclasses.replace(portable("CartPole-v1"), network=PolicyNetwork("random", layers)), tmp_path)


# -- trials


def make_task(folder: Path, algorithm: Algorithm = "random", **changes: Any) -> TrialTask:
    values: dict[str, Any] = {
        "hyperparams": {"env_steps_per_iteration": 50},
        "env_id": "CartPole-v1",
        "stop": StopSpec(num_iterations=6),
        "evaluation": EvaluationSpec(every_iterations=3, num_episodes=2),
        "checkpoints": CheckpointSpec(every_iterations=2),
    } | changes
    return TrialTask(
        sweep_place=str(folder), trial_id="t0000", seed=5 * 1024, algorithm=algorithm, env_args={},
        evaluation_seeds=(1, 2), **values,
    )  # fmt: skip


def play(
    task: TrialTask, checkpoint: Path | None = None, iterations: int = 6
) -> tuple[BaselineEngine, list[IterationStats]]:
    engine = BaselineEngine()
    engine.build(task, checkpoint)
    stats = [engine.train_iteration() for _ in range(iterations)]
    return engine, stats


def run_trial(task: TrialTask) -> Progress:
    with Evaluator(task.env_id, task.env_args, task.evaluation_seeds) as evaluator:
        loop = TrialLoop(task, BaselineEngine(), evaluator)
        loop.open()
        while (progress := loop.advance(60.0)).status == "running":
            pass
    return progress


@pytest.mark.parametrize("num_envs", [1, 4])
def test_the_episodes_are_whole_and_their_steps_are_all_counted(tmp_path: Path, num_envs: int) -> None:
    task = make_task(tmp_path, hyperparams={"env_steps_per_iteration": 200, "num_envs": num_envs})
    _, stats = play(task, iterations=20)
    episodes = [episode for item in stats for episode in item.episodes]
    assert all(length == episode_return >= 8 for episode_return, length in episodes)
    total = stats[-1].num_env_steps
    assert total >= 20 * 200
    # What is not in a whole episode is in a running one; the steps that only reset are in none.
    assert 0 <= total - sum(length for _, length in episodes) < num_envs * 100
    assert 15 < np.mean([length for _, length in episodes]) < 30
    assert [item.learner for item in stats] == [{}] * 20


def test_the_same_seed_plays_the_same_episodes(tmp_path: Path) -> None:
    assert play(make_task(tmp_path))[1] == play(make_task(tmp_path))[1]
    other = dataclasses.replace(make_task(tmp_path), seed=6 * 1024)
    assert play(other)[1] != play(make_task(tmp_path))[1]


def test_the_actions_are_drawn_from_the_trials_seed(tmp_path: Path) -> None:
    engine, _ = play(make_task(tmp_path), iterations=0)
    expected = RandomPolicy.for_env("CartPole-v1", seed=5 * 1024)
    batch = np.zeros((64, 4))
    assert (
        cast("NDArray[Any]", engine._policy.act(batch)).tolist() == cast("NDArray[Any]", expected.act(batch)).tolist()
    )


def test_a_failure_penalty_never_shows_in_the_returns(tmp_path: Path) -> None:
    assert play(make_task(tmp_path, failure_penalty=-100.0))[1] == play(make_task(tmp_path))[1]


def test_constant_play_repeats_its_action(tmp_path: Path) -> None:
    engine, stats = play(make_task(tmp_path, "constant", hyperparams={"env_steps_per_iteration": 100, "action": 1}))
    assert engine.policy().network.action == 1
    assert {length for item in stats for _, length in item.episodes} <= {8, 9, 10, 11}


def test_a_restored_trial_goes_on_with_other_episodes(tmp_path: Path) -> None:
    engine, before = play(make_task(tmp_path), iterations=3)
    folder = tmp_path / "3"
    folder.mkdir()
    engine.save(folder)
    restored, after = play(make_task(tmp_path), checkpoint=folder, iterations=3)
    assert after[0].num_env_steps >= before[-1].num_env_steps + 50
    assert restored.policy().training["iteration"] == 6
    first = [episode for item in before for episode in item.episodes]
    assert [episode for item in after for episode in item.episodes][:2] != first[:2]
    (folder / "baseline.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"baseline\.json cannot be read"):
        BaselineEngine().build(make_task(tmp_path), folder)


def test_a_trial_ends_with_its_last_wanted_episode(tmp_path: Path) -> None:
    progress = run_trial(
        make_task(tmp_path, hyperparams={"env_steps_per_iteration": 8}, stop=StopSpec(num_episodes=12))
    )
    assert (progress.status, progress.num_episodes) == ("completed", 12)
    assert progress.stop_reason == "num_episodes 12 >= 12"
    assert progress.best_evaluation_return is not None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"source": "random"}, "no environment of its own"),
        ({"source": "constant"}, "no environment of its own"),
        ({"source": "constant", "env_id": "CartPole-v1", "action": 2}, "whole numbers 0 to 1"),
        ({"source": "constant", "env_id": "Pendulum-v1"}, "a list of 1 number"),
        ({"source": "random", "env_id": "CartPole-v1", "action": 1}, "only 'constant' takes one"),
        ({"source": "mysweep", "action": 1}, "only 'constant' takes one"),
    ],
)
def test_what_a_baseline_needs_is_asked_for(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(SpecError, match=words):
        sweeps.evaluate(**arguments)


@pytest.mark.parametrize(
    ("env", "changes", "words"),
    [
        ("CartPole-v1", {"hyperparams": {"action": 2}}, "hyperparams.action: 2 is none of the actions"),
        ("CartPole-v1", {"space": {"action": {"grid": [0, 1, 5]}}}, "space.action: 5 is none of the actions"),
        ("Pendulum-v1", {}, "hyperparams.action: 0 is none of the actions, each of which is a list of 1 number"),
        ("Pendulum-v1", {"hyperparams": {"action": [3.0]}}, "[-2.0] to [2.0]"),
        ("CartPole-v1", {"resources": {"num_env_runners": 1}}, "plays in one process"),
    ],
)
def test_a_plan_refuses_a_constant_action_that_the_env_does_not_have(
    env: str, changes: dict[str, dict[str, Any]], words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        make_plan(load_spec({"env": env, "algorithm": "constant", **changes}), Machine(4))
    assert words in caught.value.message
    if env == "Pendulum-v1":
        assert "--set hyperparams.action=[0.0]" in caught.value.hint


def test_of_searched_actions_no_fixed_one_is_proposed() -> None:
    given = {"env": "Pendulum-v1", "algorithm": "constant", "space": {"action": {"grid": [[0.5], [9.0]]}}}
    with pytest.raises(SpecError) as caught:
        make_plan(load_spec(given), Machine(4))
    assert caught.value.hint == "Let space.action give only actions that there are, such as [0.0]."
    with pytest.raises(SpecError, match="but also searched"):
        load_spec(given, ["hyperparams.action=[0.0]"])
    followed = load_spec(given, ["space.action={grid: [[0.5], [0.0]]}"])
    assert [trial.point["action"] for trial in make_plan(followed, Machine(4)).trials] == [[0.5], [0.0]]


def test_the_action_can_be_set_and_searched() -> None:
    spec = load_spec({"env": "CartPole-v1", "algorithm": "constant"}, ["hyperparams.action=1"])
    assert [trial.hyperparams["action"] for trial in make_plan(spec, Machine(1)).trials] == [1]
    both = load_spec({"env": "CartPole-v1", "algorithm": "constant", "space": {"action": {"grid": [0, 1]}}})
    assert [trial.point["action"] for trial in make_plan(both, Machine(1)).trials] == [0, 1]
    box = load_spec({"env": "Pendulum-v1", "algorithm": "constant"}, ["hyperparams.action=[-2.0]"])
    assert json.loads(json.dumps(make_plan(box, Machine(1)).to_json()))["trials"][0]["hyperparams"]["action"] == [-2.0]
