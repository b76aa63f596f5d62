"""What a measured sweep tells."""

from __future__ import annotations

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Driven:
    """What driving a sweep took."""

    num_trials: int
    statuses: dict[str, int]
    num_reports: int
    run_cpu_s: float
    """Of the driver, from the moment Ray is joined until the last record is written."""
    run_wall_s: float
    launch_cpu_s: float
    """Of the driver, from the call to its return: with the plan, the new sweep's records and the connection to Ray."""
    launch_wall_s: float
    peak_bytes: int
    work_s: float
    """Sum of what the trials trained."""
    num_env_steps: int = 0
    training_s: float = 0.0
    """From the first trial's start to the last one's end."""
    daemons_cpu_s: dict[str, float] = dataclasses.field(default_factory=dict)
    """Of the cluster's other processes while it was driven, by kind."""
    num_requests: dict[str, int] = dataclasses.field(default_factory=dict)
    """That the object store got, by method; empty: the sweep was in a folder."""

    def as_json(self) -> dict[str, Any]:
        """As plain data."""
        return dataclasses.asdict(self)

    @property
    def launch_ms_a_trial(self) -> float:
        """CPU milliseconds of the driver a trial, everything included."""
        return 1e3 * self.launch_cpu_s / self.num_trials

    @property
    def run_ms_a_trial(self) -> float:
        """CPU milliseconds of the driver a trial, from joining Ray to the last record."""
        return 1e3 * self.run_cpu_s / self.num_trials

    @property
    def env_steps_per_s(self) -> float:
        """Of all trials, while any trains."""
        return self.num_env_steps / self.training_s

    @property
    def reports_a_trial(self) -> float:
        """Reports a trial."""
        return self.num_reports / self.num_trials
