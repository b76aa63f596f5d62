"""Whether a sweep has a best policy to give or to play, and what is answered where it has none."""

from __future__ import annotations

from policies.errors import NotFoundError
from tune_jobs.service.service import Service
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.current_best import has_best_to_show


def has_best(service: Service, sweep: Sweep) -> bool:
    """Whether a sweep has a best policy to show; see `has_best_to_show`."""
    seen = service.statuses.see(sweep.name)
    return has_best_to_show(sweep, seen.status.sweep, seen.trials.records)


def no_best(sweep: Sweep) -> NotFoundError:
    """Return the error for a sweep that has none."""
    if sweep.has_best():
        return NotFoundError(
            f"The best policy of sweep {sweep.name} was chosen before the sweep was trained on.",
            "Resume it: then one is chosen anew.",
        )
    if sweep.read_record().state == "completed" and not sweep.is_driven():
        return NotFoundError(
            f"Sweep {sweep.name} has ended, and has no best policy.",
            "Resume it: then one is chosen, or it is said why not.",
        )
    return NotFoundError(f"Sweep {sweep.name} has no best policy yet.", "It is chosen when the sweep has ended.")
