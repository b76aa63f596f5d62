"""`tune-jobs serve` whose clock runs fast and whose drivers train nothing; all else is the real one's."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable

from tune_jobs.service import service
from tune_jobs.service.spare import Driver
from tune_jobs.service.supervisor import Supervisor

SPEED = "TUNE_JOBS_SIMULATED_SPEED"


def main() -> None:
    """Serve."""
    from tune_jobs.cli.commands import main as run

    speed = float(os.environ[SPEED])
    for name in ("time", "monotonic"):
        clock: Callable[[], float] = getattr(time, name)
        setattr(time, name, functools.partial(_fast, clock, clock(), speed))
    made = functools.partial(Supervisor, make_driver=functools.partial(Driver, module="fake_driver"))
    setattr(service, "Supervisor", made)  # noqa: B010 (mypy knows a class by this name)
    run()


def _fast(clock: Callable[[], float], begin: float, speed: float) -> float:
    return begin + speed * (clock() - begin)


if __name__ == "__main__":
    main()
