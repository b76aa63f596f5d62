"""A sweep folder as a run leaves it, in a second and without Ray: fakes for the training, the real files."""

import contextlib
import dataclasses
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, FakeEvaluator, make_task

from analysis.best_records import CandidateRecord, ChoiceRecord
from analysis.selection import policy_candidates
from policies.acting.evaluate import Evaluator
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store import sweep_store, trial_store
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.adding import add_what_is_missing
from tune_jobs.sweeps.drive import write_new
from tune_jobs.training.trial_loop import TrialLoop

MACHINE = Machine(num_cpus=4, source="this machine")
SPEC: dict[str, Any] = {
    "env": {"id": "CartPole-v1"},
    "algorithm": "ppo",
    "space": {"lr": {"uniform": [1e-4, 1e-2]}},
    "num_samples": 2,
    "seeds_per_point": 2,
    "engine": "rllib",
    "evaluation": {"every_iterations": 1, "num_episodes": 2},
    # Its trials ended by a rule that is not in here, and where they are resumed a race would train real ones.
    "confirm": "none",
}


_templates: list[Path] = []


@pytest.fixture(scope="session", autouse=True)
def sweep_template(guard: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A sweep folder that three hundred tests copy, made before any of them has replaced anything."""
    folder = tmp_path_factory.mktemp("template") / "template"
    make_sweep_folder(folder)
    _templates.append(folder)
    yield
    _templates.clear()


def make_sweep_folder(folder: Path, iterations: int = 6, **spec: Any) -> SweepStore:
    """A completed sweep of 4 trials; trial i's checkpoint of iteration n scored 10 i + n.

    The points are {t0000, t0001} and {t0002, t0003}; t0003 wins with its last checkpoint.
    """
    store = SweepStore(folder)
    store.create()
    if _templates and (iterations, spec) == (6, {}):
        shutil.copytree(_templates[0], folder, dirs_exist_ok=True)
        record = store.read_record()
        store.write_record(record.model_copy(update={"name": store.name, "spec": record.spec | {"name": store.name}}))
        return store
    made = SweepSpec.model_validate(SPEC | spec)
    plan = make_plan(made, MACHINE)
    write_new(store, made, plan, None)
    for trial in plan.trials:
        train(store, trial.trial_id, iterations)
    record = store.read_record()
    changes = {"state": "completed", "started_at": 1.0, "ended_at": 2.0, "created_at": 0.0, "git_commit": None}
    store.write_record(record.model_copy(update=changes))
    return store


def chosen(store: SweepStore, trial_id: str = "t0003", iteration: int = 6) -> dict[str, Any]:
    """What the record of a best policy says of one that was chosen among all checkpoints that there are now."""
    known = [item.checkpoint for item in policy_candidates(store.read_trials())]
    winner = store.trial(trial_id).checkpoint(iteration)
    candidates = tuple(
        CandidateRecord(checkpoint=each, point={}, num_episodes=2, score=0.0, rejected_in=None if each == winner else 1)
        for each in sorted(known, key=lambda each: each != winner)
    )
    choice = ChoiceRecord(candidates=candidates, num_known=len(known), num_evaluation_episodes=2)
    return {"checkpoint": winner, "choice": choice}


def extend_by_leaders(store: SweepStore) -> None:
    """Add a point whose trials t0004 and t0005 score 400 and more, as `extend --no-finish` leaves a sweep of 4."""
    record = store.read_record()
    spec = stored_spec(record).model_copy(update={"num_samples": 3})
    plan = add_what_is_missing(store, record, spec, MACHINE, None)
    for trial in plan.trials[4:]:
        train(store, trial.trial_id, 6, scores=lambda iteration: 400.0 + iteration)
    store.write_record(store.read_record().model_copy(update={"state": "completed"}))


@contextlib.contextmanager
def kept_before_each_write(store: SweepStore, into: Path) -> Iterator[list[Path]]:
    """Copy a sweep's folder before each of its records is written: what a kill at that moment would leave.

    Args:
        store: The sweep.
        into: A folder for the copies.

    Yields:
        The copies so far, each in a folder of its own, under the sweep's name.
    """
    write = sweep_store.write_atomic  # type: ignore[attr-defined]
    left: list[Path] = []

    def watched(path: Path, data: str) -> None:
        left.append(shutil.copytree(store.folder, into / f"killed-{len(left)}" / store.name))
        write(path, data)

    with pytest.MonkeyPatch.context() as patch:
        for module in (sweep_store, trial_store):
            patch.setattr(module, "write_atomic", watched)
        yield left


def train(
    store: SweepStore,
    trial_id: str,
    iterations: int,
    engine: FakeEngine | None = None,
    scores: Callable[[int], float] | None = None,
) -> None:
    """Run a trial to its end, and write its record as its driver does.

    Args:
        store: The sweep.
        trial_id: The trial.
        iterations: How many it has.
        engine: What trains it; None: policies that hardly differ.
        scores: What the policy of each iteration scores; None: as `make_sweep_folder` says.
    """
    known = store.trial(trial_id).read_record()
    task = make_task(
        store.folder, stop={"num_iterations": iterations}, evaluation={"every_iterations": 1},
        checkpoints={"every_iterations": 2, "keep": 2},
    )  # fmt: skip
    task = dataclasses.replace(task, trial_id=trial_id, seed=known.seed)
    evaluator = FakeEvaluator(scores or (lambda iteration: 10.0 * known.index + iteration))
    loop = TrialLoop(task, engine or FakeEngine(), cast("Evaluator", evaluator), FakeClock(0.001))
    loop.open()
    while (progress := loop.advance(1e9)).status == "running":
        pass
    store.trial(trial_id).write_record(
        known.model_copy(
            update={
                "status": progress.status, "stop_reason": progress.stop_reason,
                "num_iterations": progress.num_iterations, "num_env_steps": progress.num_env_steps,
                "num_episodes": progress.num_episodes, "time_s": 1.0,
                "training_return": progress.training_return, "evaluation_return": progress.evaluation_return,
                "best_evaluation_return": progress.best_evaluation_return, "best_iteration": progress.best_iteration,
                "checkpoints": progress.checkpoints, "started_at": 1.0, "ended_at": 2.0,
            }
        )
    )  # fmt: skip
