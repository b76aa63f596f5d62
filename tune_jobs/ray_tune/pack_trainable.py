"""The Ray Tune Trainable of a pack: one process that trains many trials at once, for as long as there are any.

Tune gives it a sweep's place and a pack id. It reads in its assignment which trials to train; after its first report
the driver tells it, before the next step, as a storage may be far away. The trials themselves are in the storage, so a
pack that is started again continues from what its members left there.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import IO, TYPE_CHECKING, Any

import ray
from ray import tune

from policies.acting.evaluate import Evaluator
from policies.envs.faults import note_signals
from policies.envs.modules import allow_modules
from tune_jobs.ray_tune.joined_nodes import refusal
from tune_jobs.ray_tune.lean import Sealed
from tune_jobs.ray_tune.lost_nodes import DrainNotice, NodeRefusedError
from tune_jobs.ray_tune.trainable import (
    REPORT_INTERVAL_S,
    TaskReader,
    TrialLog,
    end_with_driver,
    look_in_folders,
    owner_of_run,
    this_node,
    watchdog,
)
from tune_jobs.store.contract import Assignment
from tune_jobs.store.opening import open_sweep
from tune_jobs.training.pack_loop import PackLoop
from tune_jobs.training.protocol import PackEngine, TrialTask
from tune_jobs.training.registry import make_pack_engine

if TYPE_CHECKING:
    from policies.acting.evaluate import Episodes
    from policies.acting.policy import Policy

_READ_AT_ONCE = 16


class PackTrainable(tune.Trainable):  # type: ignore[misc]
    """Runs a pack; `config` holds `sweep_place`, `pack_id`, `engine`, `env_kind` and `num_env_processes`."""

    _refusal: NodeRefusedError | None = None

    def setup(self, config: dict[str, Any]) -> None:
        """Remember the pack; it is built in the first step, so that every error is raised there."""
        self._config = config
        self._log = TrialLog()
        self._engine: PackEngine | None = None
        self._evaluator: Evaluator | None = None
        self._loop: PackLoop | None = None
        self._told: Assignment | None = None
        self._first: Future[tuple[Assignment, dict[str, TrialTask]]] | None = None
        # Meanwhile other things are done that wait for the storage, or need none.
        self._ahead = ThreadPoolExecutor(1, "ahead")
        self._reading = self._ahead.submit(TaskReader, config["sweep_place"])
        look_in_folders(config)
        self._refusal = refusal(config)
        if self._refusal is not None:
            return
        self._files = open_sweep(config["sweep_place"]).pack(config["pack_id"])
        run = owner_of_run(config)
        self._owner = self._files.take(run)
        end_with_driver(config, self._owner)
        note_signals()
        self._file: IO[bytes] = self._log.open(self._files.log_path)
        self._files.begin_log()
        self._node = this_node()
        self._notice = DrainNotice()
        self._this = ray.get_runtime_context().current_actor

    def assign(self, assignment: Assignment) -> None:
        """Take from the driver which trials the pack has to train; it is in the storage, too, or will be."""
        self._told = assignment

    def step(self) -> dict[str, Any]:
        """Remove members that shall end, add new ones, and train until there is something to decide.

        Raises:
            Exception: An error of no single member; it is in the pack's log too.
            NodeLeavesError: The node is taken away; the members are saved.
            NodeRefusedError: The node joined later, and can't take part; nothing was begun.
        """
        if self._refusal is not None:
            raise self._refusal
        try:
            if self._loop is None:
                self._loop = self._open()
            if self._notice.came:
                # Before any member is built: Ray may still start a process on a node that it drains.
                self._leave(self._loop)
            self._arrange(self._loop)
            reports = self._loop.advance(REPORT_INTERVAL_S, until_evaluated=self._is_scheduled)
        except Exception:
            traceback.print_exc()
            raise
        # The driver decides when there is nothing left to do.
        return {"done": False, "reports": Sealed(reports), "process": Sealed(self._this), "node": self._node}

    def _leave(self, loop: PackLoop) -> None:
        """Save the members and end the pack here, as the node is taken away."""
        loop.save()
        raise self._notice.error()

    def make_engine(self) -> PackEngine:
        """Make the engine of this pack."""
        config = self._config
        return make_pack_engine(
            config["engine"], env_kind=config["env_kind"], num_env_processes=config["num_env_processes"]
        )

    def evaluate(self, evaluator: Evaluator, policies: Sequence[Policy]) -> Sequence[Episodes | Exception]:
        """Return the greedy episodes of each policy, or the error that prevented them."""
        from policies.packed.evaluation import evaluate_many

        return evaluate_many(evaluator, policies)

    def _open(self) -> PackLoop:
        self._reader = reader = self._reading.result()
        spec = reader.spec
        self._first = self._ahead.submit(self._read)
        allow_modules(reader.sweep.allowed_modules)
        # A population is compared where its members wait, and at no other evaluation.
        self._is_scheduled = spec.scheduler.type != "none" and not spec.scheduler.is_population
        self._engine = self.make_engine()
        with watchdog(spec.iteration_timeout_s, self._file):
            self._evaluator = Evaluator(spec.env.id, spec.env.wrapped_args, reader.sweep.evaluation_seeds)
        return PackLoop(
            self._engine,
            self._evaluator,
            self.evaluate,
            stop_requested=reader.store.stop_requested,
            max_retries=spec.max_retries,
            watch=functools.partial(watchdog, file=self._file),
            under=self._owner,
        )

    def _arrange(self, loop: PackLoop) -> None:
        """Add and remove members so that they are those assigned, and open those again that go on from a copy.

        Raises:
            OwnershipLostError: Another process runs this pack by now, and reads the same assignment.
        """
        first, self._first = self._first, None
        with self._owner.held():
            assignment, known = (self._told or self._files.read(), {}) if first is None else first.result()
        for trial_id in loop.trial_ids:
            if trial_id not in assignment.trial_ids:
                loop.end(trial_id)
        changed = [name for name in loop.trial_ids if assignment.num_changes.get(name, 0) > loop.num_changes(name)]
        new = [trial_id for trial_id in assignment.trial_ids if trial_id not in loop.trial_ids]
        if new or changed:
            tasks = known or self._tasks([*changed, *new])
            for trial_id in changed:
                loop.reopen(tasks[trial_id])
            for trial_id in new:
                loop.add(tasks[trial_id], assignment.num_failures.get(trial_id, 0))
        loop.hold(assignment.hold_at)

    def _read(self) -> tuple[Assignment, dict[str, TrialTask]]:
        """Read the first assignment, and what its trials are."""
        assignment = self._files.read()
        return assignment, self._tasks(assignment.trial_ids)

    def _tasks(self, trial_ids: Sequence[str]) -> dict[str, TrialTask]:
        # Side by side, as a store may be far away.
        with ThreadPoolExecutor(max(1, min(len(trial_ids), _READ_AT_ONCE))) as pool:
            return dict(zip(trial_ids, pool.map(self._reader.read, trial_ids), strict=True))

    def cleanup(self) -> None:
        """Free everything, as the process may end."""
        if self._engine is not None:
            self._engine.close()
        if self._evaluator is not None:
            self._evaluator.close()
        self._ahead.shutdown(wait=False)
        self._log.close()
