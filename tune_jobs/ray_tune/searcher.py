"""Choose points when trials start, and a Ray Tune searcher that starts a sweep's trials one by one."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ray.tune.experiment import Experiment, Trial
from ray.tune.search import BasicVariantGenerator, Searcher

from analysis.numbering import drawn_index
from analysis.records import SweepRecord, TrialRecord
from policies.hyperparams import Hyperparams
from tune_jobs.plan.points import point_hyperparams
from tune_jobs.search.history import History
from tune_jobs.search.proposal import propose_point
from tune_jobs.search.rungs import ReadCurves
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.transitions import begun, with_point


class PointChooser:
    """Chooses the point of a trial that has none when it is about to start, also for the other seeds of that point.

    Args:
        spec: The sweep.
        sweep: Its record, which has the points that somebody chose: they are not drawn.
        records: Returns the newest records of all trials.
        change: Changes a trial's record, on disk too.
        curves: As for `History`.
    """

    def __init__(
        self,
        spec: SweepSpec,
        sweep: SweepRecord,
        records: Callable[[], Sequence[TrialRecord]],
        change: Callable[[str, Callable[[TrialRecord], TrialRecord]], None],
        curves: ReadCurves | None = None,
    ) -> None:
        self._spec, self._sweep = spec, sweep
        self._history = History(spec, curves=curves)
        self._given: set[str] = set()
        self._records = records
        self._change = change

    def prepare(self, name: str) -> None:
        """Ensure that a trial, which is about to start, has a point.

        Raises:
            SpecError: No valid point was found.
        """
        self._given.add(name)
        # A trial that was given to a process counts as running, though it may not have reported yet.
        records = [
            begun(record, time.time()) if record.status == "pending" and record.trial_id in self._given else record
            for record in self._records()
        ]
        record = next(record for record in records if record.trial_id == name)
        if not record.has_point:
            self._choose(record.point_index, records)

    def _choose(self, point_index: int, records: Sequence[TrialRecord]) -> None:
        spec = self._spec
        known = [record for record in records if record.point_index == point_index and record.has_point]
        if known:
            # Another seed has a point already: the driver was killed before it could write it to this trial's record.
            self._write(point_index, records, known[0].point)
            return
        drawn = drawn_index(point_index, self._sweep.chosen_points)
        point = propose_point(
            spec, records, drawn, lambda point: self._hyperparams(point, point_index), self._sweep.prior,
            history=self._history,
        )  # fmt: skip
        self._write(point_index, records, point)

    def _hyperparams(self, point: Mapping[str, Any], point_index: int) -> Hyperparams:
        return point_hyperparams(self._spec, point, point_index, self._sweep.replications)

    def _write(self, point_index: int, records: Sequence[TrialRecord], point: dict[str, Any]) -> None:
        hyperparams = self._hyperparams(point, point_index).model_dump(mode="json")
        for record in records:
            if record.point_index == point_index and not record.has_point:
                self._change(record.trial_id, lambda known: with_point(known, point, hyperparams))


class TrialsInOrder(BasicVariantGenerator):  # type: ignore[misc]
    """Gives Tune the trials in their order.

    Tune's own (2.60) copies the ids of all trials at the start, parses a command line for each trial and copies its
    settings some times, which takes it longer than all that is done here with a trial. It is a `BasicVariantGenerator`
    because Tune asks only that one for more than one trial at a time.

    Args:
        trial_ids: The trials to run.
        max_concurrent: How many Tune may know at once that have not ended; 0: any number.
    """

    def __init__(self, trial_ids: Sequence[str], max_concurrent: int) -> None:
        super().__init__(max_concurrent=max_concurrent)
        self._waiting = deque(trial_ids)
        self._experiment: Experiment | None = None
        self._num_begun = 0

    @property
    def total_samples(self) -> int:
        """How many trials there are."""
        return self._num_begun + len(self._waiting)

    def add_configurations(self, experiments: Sequence[Experiment]) -> None:
        """Take the settings that all trials share."""
        (self._experiment,) = experiments

    def next_trial(self) -> Trial | None:
        """Return the next trial; None: there is none, or as many as may be have not ended."""
        if self.is_finished() or 0 < self.max_concurrent <= len(self._live_trials):
            return None
        if not self._waiting:
            self.set_finished()
            return None
        assert self._experiment is not None
        spec = self._experiment.spec
        trial = Trial(
            spec["run"],
            config={**spec["config"], "trial_id": self._waiting.popleft()},
            trial_id=f"{self._num_begun:05d}",
            experiment_tag=str(self._num_begun),
            placement_group_factory=spec["resources_per_trial"],
            stopping_criterion=spec.get("stop"),
            checkpoint_config=spec["checkpoint_config"],
            export_formats=spec["export_formats"],
            trial_name_creator=spec["trial_name_creator"],
            trial_dirname_creator=spec["trial_dirname_creator"],
            max_failures=spec["max_failures"],
            storage=spec["storage"],
        )
        self._num_begun += 1
        self._live_trials.add(trial.trial_id)
        return trial

    def save_to_dir(self, dirpath: str, session_str: str) -> None:
        """Do nothing, because Tune's state is only a cache."""


class PointSearcher(Searcher):  # type: ignore[misc]
    """The Tune searcher that returns the trials in order, each with a point.

    Tune asks only when a trial can start (`max_concurrent_trials`), so every choice knows all trials that have ended.

    Args:
        trial_ids: The trials to run.
        chooser: Chooses their points.
    """

    def __init__(self, trial_ids: Sequence[str], chooser: PointChooser) -> None:
        super().__init__()
        self._waiting = deque(trial_ids)
        self._chooser = chooser

    def suggest(self, trial_id: str) -> dict[str, Any] | str:  # noqa: ARG002 - Tune's own id
        """Return the next trial's config for `TrialTrainable`."""
        if not self._waiting:
            return str(Searcher.FINISHED)
        name = self._waiting.popleft()
        self._chooser.prepare(name)
        return {"trial_id": name}

    def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:  # noqa: FBT001, FBT002 - Tune's signature
        """Do nothing, because the records say how a trial ended."""

    def save_to_dir(self, checkpoint_dir: str, session_str: str = "default") -> None:
        """Do nothing, because Tune's state is only a cache."""
