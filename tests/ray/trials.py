"""Single trials without Ray Tune: what several test modules here run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policies.acting.evaluate import Evaluator
from policies.acting.load import load_policy
from policies.acting.policy import Policy
from policies.portable.file import save_policy
from tune_jobs.spec.sections import CheckpointSpec, EvaluationSpec, StopSpec
from tune_jobs.store.progress import Progress
from tune_jobs.training.protocol import TrainingEngine, TrialTask

TRIAL_SEED = 9 * 1024
SMALL: dict[str, dict[str, Any]] = {
    "ppo": {"hidden_sizes": (8,), "train_batch_size": 128, "minibatch_size": 64, "num_epochs": 2, "num_envs": 4},
    "dqn": {
        "hidden_sizes": (8,),
        "env_steps_per_iteration": 60,
        "learning_starts": 30,
        "train_batch_size": 16,
        "train_freq": 1,
        "updates_per_env_step": 1.0,
    },
}


def make_task(folder: str | Path, algorithm: str = "ppo", **changes: Any) -> TrialTask:
    """A trial of a few iterations; hyperparameters by name, other fields of `TrialTask` too."""
    fields = {name: changes.pop(name) for name in list(changes) if name in TrialTask.__dataclass_fields__}
    return TrialTask(
        **{
            "sweep_place": str(folder),
            "trial_id": "t0000",
            "seed": TRIAL_SEED,
            "algorithm": algorithm,
            "hyperparams": {**SMALL[algorithm], **changes},
            "env_id": "CartPole-v1",
            "env_args": {},
            "stop": StopSpec(num_iterations=2),
            "evaluation": EvaluationSpec(every_iterations=1, num_episodes=2),
            "checkpoints": CheckpointSpec(every_iterations=1, keep=5),
            "evaluation_seeds": (1, 2),
            **fields,
        }
    )


def run_trial(task: TrialTask, engine: TrainingEngine) -> Progress:
    """Run a trial to its end; the engine keeps the Algorithm."""
    from tune_jobs.training.trial_loop import TrialLoop

    with Evaluator(task.env_id, task.env_args, task.evaluation_seeds) as evaluator:
        loop = TrialLoop(task, engine, evaluator)
        loop.open()
        while (progress := loop.advance(60.0)).status == "running":
            pass
    return progress


def fill_replay(algorithm: Any, num_env_steps: int) -> None:
    """Let a DQN Algorithm sample without learning, of weights or statistics."""
    goal = algorithm.num_env_steps + num_env_steps
    while algorithm.num_env_steps < goal:
        algorithm._sample()
        algorithm._new_observations.clear()


def train_pack(tasks: Sequence[TrialTask], folder: Path, num_iterations: int) -> list[Policy]:
    """Train trials as one pack, none of which may fail, and return their policies, each read from its file."""
    from tune_jobs.training.packed import PackedEngine

    engine = PackedEngine()
    for task in tasks:
        engine.add(task, None)
    for _ in range(num_iterations):
        for stats in engine.train_iteration().values():
            assert not isinstance(stats, Exception), stats
    for task in tasks:
        save_policy(engine.policy(task.trial_id), folder / task.trial_id)
    engine.close()
    return [load_policy(folder / task.trial_id) for task in tasks]
