"""A service's queue in a process of its own, to be killed."""

import functools
import sys
import threading
from pathlib import Path

from tune_jobs.service import supervisor
from tune_jobs.service.database.opening import open_database
from tune_jobs.service.job_files import SERVICE_FOLDER
from tune_jobs.service.queue import Queue
from tune_jobs.service.spare import Driver
from tune_jobs.service.supervisor import Supervisor
from tune_jobs.service.surroundings import Surroundings
from tune_jobs.store.opening import open_storage


def main(folder: Path, url: str, beat: Path) -> None:
    """Run the queue until killed, and say each moment that it lives."""
    # Two on one folder would be no test of a restart, as `service.opened` refuses the second.
    supervisor.TICK_S, supervisor.MAX_ATTEMPTS = 0.02, 1_000
    supervisor._wait_s = lambda num_deaths: 0.0 * num_deaths
    made = Supervisor(
        Queue(open_database(url)), open_storage(folder),
        Surroundings(folder, folder / SERVICE_FOLDER, None, 2.0, ()),
        spare_idle_s=600.0, make_driver=functools.partial(Driver, module="fake_driver"),
    )  # fmt: skip
    made.start()
    while True:
        beat.touch()
        threading.Event().wait(0.05)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
