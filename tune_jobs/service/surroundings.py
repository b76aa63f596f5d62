"""Where jobs run, as the operator has said."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from tune_jobs.service.logs import LogFormat


@dataclass(frozen=True)
class Surroundings:
    """Where jobs run."""

    working_folder: Path
    service_folder: Path
    address: str | None
    """The Ray cluster; None: this machine."""
    num_cpus: float
    """Infinite on a cluster, which shares its own among the trials of all sweeps."""
    modules: tuple[str, ...]
    """Modules that specs may name; the operator's choice."""
    log_format: LogFormat = "text"
    """Of what processes without a job say, on this one's standard error."""
    wait_for_nodes: float = 0.0
    """How many seconds a job waits for nodes of the cluster that can hold one trial, if it does not say it itself."""

    @property
    def unplanned_cpus(self) -> float:
        """CPUs that a sweep takes which was not planned here: all; of a cluster's, of which JSON has no number, one."""
        return self.num_cpus if math.isfinite(self.num_cpus) else 1.0
