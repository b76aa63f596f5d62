"""Both engines learn actions of each kind, and of those that are allowed; policies give what the env itself takes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import pytest
from test_learning_from_spaces import NUM_ITERATIONS, SEEDS, VALUES
from trials import make_task, run_trial, train_pack

from policies.acting.evaluate import Evaluator
from policies.acting.load import load_policy
from policies.errors import EnvError
from tune_jobs.spec.sections import EvaluationSpec, StopSpec

if TYPE_CHECKING:
    from policies.acting.policy import Policy
    from tune_jobs.training.protocol import TrialTask

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

NUM_STEPS = 16
# Of 16. Who gets one of two parts right and guesses the other has 12; who draws among the allowed values of a choice
# has less than 8 for it, and who tries a forbidden one fails.
LEARNED = 14.0
REPLIES = [
    "multi-discrete", "multi-binary", "tuple of choices", "dict of choices", "matrix", "whole numbers",
    "dict of numbers",
]  # fmt: skip
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    **{kind: ("TestReply-v0", {"kind": kind}) for kind in REPLIES},
    "mask in a dict": ("TestForbidding-v0", {}),
    "mask in infos": ("TestForbidding-v0", {"place": "info", "action_mask": "action_mask"}),
    "mask of a method": ("TestForbidding-v0", {"place": "method"}),
    "mask of two choices": ("TestForbidding-v0", {"num_choices": 2}),
    "mask before frames": ("TestForbidding-v0", {"frame_stack": 2}),
}
FOR_DQN = ["mask in a dict", "mask in infos"]
PAIRS = [("ppo", case) for case in CASES] + [("dqn", case) for case in FOR_DQN]


def task_of(folder: Path, algorithm: str, case: str, seed: int = 0) -> TrialTask:
    env_id, env_args = CASES[case]
    return make_task(
        folder, algorithm, **VALUES[algorithm], normalize_observations=case == "mask in infos",
        trial_id=f"t{seed:04d}", seed=1024 * (seed + 1), env_id=env_id, env_args=env_args,
        stop=StopSpec(num_iterations=NUM_ITERATIONS), evaluation_seeds=SEEDS,
        evaluation=EvaluationSpec(every_iterations=NUM_ITERATIONS, num_episodes=len(SEEDS)),
    )  # fmt: skip


def return_in_the_envs_own_terms(policy: Policy, case: str) -> float:
    """A mean return, from the environment as its author registered it: no wrapper of ours."""
    env_id, env_args = CASES[case]
    ours = {name: value for name, value in env_args.items() if name not in ("action_mask", "frame_stack")}
    env, total = gym.make(env_id, **ours), 0.0
    inner: Any = env.unwrapped
    for seed in SEEDS:
        observation, info = env.reset(seed=seed)
        for _ in range(NUM_STEPS):
            mask = inner.action_masks() if ours.get("place") == "method" else info.get("action_mask")
            observation, reward, _, _, info = env.step(policy.act(observation, mask))
            total += float(reward)
    return total / len(SEEDS)


def check(policy: Policy, case: str) -> None:
    env_id, env_args = CASES[case]
    if "frame_stack" not in env_args:
        assert return_in_the_envs_own_terms(policy, case) >= LEARNED
    with Evaluator(env_id, env_args, SEEDS) as evaluator:
        assert evaluator.run(policy).mean_return >= LEARNED


@pytest.mark.parametrize(("algorithm", "case"), PAIRS)
def test_a_pack_learns_it(algorithm: str, case: str, tmp_path: Path) -> None:
    tasks = [task_of(tmp_path, algorithm, case, seed) for seed in range(2)]
    for policy in train_pack(tasks, tmp_path, NUM_ITERATIONS):
        check(policy, case)


@pytest.mark.parametrize(
    ("algorithm", "case"),
    [("ppo", "tuple of choices"), ("ppo", "mask of two choices"), ("ppo", "dict of numbers"), ("dqn", "mask in infos")],
)
def test_a_trial_of_rllibs_learns_it(algorithm: str, case: str, tmp_path: Path) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    engine = RLlibEngine()
    progress = run_trial(task_of(tmp_path, algorithm, case), engine)
    engine.close()
    assert progress.status == "completed", progress
    checkpoint = tmp_path / progress.checkpoints[-1].path
    check(load_policy(checkpoint), case)
    if case == "mask of two choices":
        from tune_jobs.training.registry import engine_of_checkpoint, restore_checkpoint

        # RLlib's own files hold the spaces too. A restore compares the weights.
        restored = restore_checkpoint(checkpoint, engine_of_checkpoint(checkpoint))
        restored.train()
        assert [return_ for return_, _ in restored.env_runner.pop_finished_episodes()]
        restored.stop()


FORBIDS_ALL = (
    r"TestForbidding-v0 raised an error in step\(\): ValueError: the environment gave \[0, 0, 0, 0\] as "
    r"observation\['action_mask'\] after env step 2 of an episode, which forbids every action"
)


def task_gone_wrong(folder: Path) -> TrialTask:
    return make_task(folder, "ppo", env_id="TestForbidding-v0", env_args={"goes_wrong": "nothing"}, **VALUES["ppo"])


def test_a_mask_that_forbids_everything_fails_the_member_of_a_pack_with_the_step(tmp_path: Path) -> None:
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine()
    engine.add(task_gone_wrong(tmp_path), None)
    (found,) = engine.train_iteration().values()
    assert isinstance(found, EnvError)
    assert re.search(FORBIDS_ALL, found.message)
    engine.close()


def test_a_mask_that_forbids_everything_fails_a_trial_of_rllibs_with_the_step(tmp_path: Path) -> None:
    from tune_jobs.training.rllib import RLlibEngine

    engine = RLlibEngine()
    engine.build(task_gone_wrong(tmp_path), None)
    with pytest.raises(EnvError, match=FORBIDS_ALL):
        engine.train_iteration()
    engine.close()
