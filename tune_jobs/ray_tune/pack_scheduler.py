"""Lets Ray Tune run packs, of which each is one of its trials: what a pack does next, the driver of the packs says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ray.tune.schedulers import FIFOScheduler, TrialScheduler

from tune_jobs.ray_tune.pack_driver import PackDriver
from tune_jobs.training.pack_loop import MemberReport

if TYPE_CHECKING:
    from ray.tune.execution.tune_controller import TuneController
    from ray.tune.experiment import Trial


class PackScheduler(FIFOScheduler):  # type: ignore[misc]
    """The Tune scheduler that asks the driver of the packs what a pack does next."""

    def __init__(self, driver: PackDriver) -> None:
        super().__init__()
        self._driver = driver

    def on_trial_result(
        self,
        tune_controller: TuneController,
        trial: Trial,
        result: dict[str, Any],
    ) -> str:
        """Pass the reports to the driver, and return its decision; packs that would have nothing to do ask no more."""
        reports: Sequence[MemberReport] = result["reports"].report
        process = result["process"].report
        is_done = self._driver.take(
            str(trial.config["pack_id"]),
            reports,
            node=result["node"],
            pid=result["pid"],
            # Ray runs a process's calls in the order in which they were made: this one before the next step.
            tell=process.assign.remote,
        )
        for other in tune_controller.get_trials():
            # An autoscaler adds nodes for those that wait for one.
            if other.status == other.PENDING and self._driver.is_of_no_use(str(other.config["pack_id"])):
                tune_controller.stop_trial(other)
        return str(TrialScheduler.STOP if is_done else TrialScheduler.CONTINUE)
