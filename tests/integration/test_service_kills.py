"""Service, drivers and database are killed at random moments: nothing is lost, and nothing is run twice.

The processes are real ones; sweeps only wait (`fake_driver`). `make kills` does it a hundred times.
"""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from databases import PostgreSQL, postgresql  # noqa: F401 (a fixture)
from fake_driver import JOURNAL
from sqlalchemy.exc import SQLAlchemyError
from synthetic_sweep import make_sweep_record

from policies.errors import CannotRunError
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.job_files import SERVICE_FOLDER
from tune_jobs.service.jobs import Job
from tune_jobs.service.queue import Queue
from tune_jobs.store.sweep_store import SweepStore

NUM_KILLS = int(os.environ.get("TUNE_JOBS_NUM_KILLS", "6"))
NUM_SWEEPS = 4 + NUM_KILLS // 2
PATIENCE_S = 120.0
HERE = Path(__file__).parent


class Place:
    """A storage folder, a service that is started again whenever it dies, and what it wrote."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder / "sweeps", url
        (self.folder / SERVICE_FOLDER).mkdir(parents=True)
        self.beat, self.log = folder / "beat", folder / "log"
        self.service: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        path = os.pathsep.join([str(HERE.parent / "unit"), str(HERE.parents[1])])
        with self.log.open("ab") as log:
            self.service = subprocess.Popen(
                [sys.executable, str(HERE / "service_process.py"), str(self.folder), self.url, str(self.beat)],
                env=os.environ | {"PYTHONPATH": path}, stdout=log, stderr=log,
            )  # fmt: skip

    def kill(self) -> None:
        if self.service is not None:
            self.service.kill()
            self.service.wait()

    def start_again(self) -> None:
        """Start the service if it could not begin while the database was away, as whoever looks after it does."""
        if self.service is None or self.service.poll() is not None:
            self.start()

    def queue(self) -> Queue:
        return Queue(open_database(self.url))

    def jobs(self) -> list[Job]:
        """All jobs; none while the database is away."""
        with contextlib.suppress(CannotRunError, SQLAlchemyError):
            return self.queue().jobs()
        return []

    def submit(self, name: str, seconds: float) -> None:
        store = SweepStore(self.folder / name)
        store.create()
        record = make_sweep_record(name, "ppo", "CartPole-v1", [], 1)
        spec = record.spec | {"hyperparams": {"seconds": seconds}}
        store.write_record(record.model_copy(update={"state": "created", "spec": spec}))
        self.queue().begin(name, "drive", {}, owner=f"owner {len(name) % 3}", num_cpus=1.0)

    def journal(self) -> list[dict[str, Any]]:
        with contextlib.suppress(FileNotFoundError):
            return [json.loads(line) for line in (self.folder / SERVICE_FOLDER / JOURNAL).read_text().splitlines()]
        return []

    def drivers(self) -> list[int]:
        """Processes that have begun a sweep, and live."""
        alive = []
        for line in self.journal():
            with contextlib.suppress(OSError):
                if b"fake_driver" in Path(f"/proc/{line['pid']}/cmdline").read_bytes():
                    alive.append(line["pid"])
        return sorted(set(alive))

    def said(self) -> str:
        return self.log.read_text()[-3_000:] if self.log.exists() else ""


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Place]:
    if request.param == "sqlite":
        (tmp_path / "database").mkdir()
        url = sqlite_url(tmp_path / "database" / "service.db")
    else:
        server: PostgreSQL = request.getfixturevalue("postgresql")
        url = server.new_database()
    made = Place(tmp_path, url)
    yield made
    made.kill()
    for pid in made.drivers():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_whoever_is_killed_each_sweep_runs_to_its_end_once(place: Place, request: pytest.FixtureRequest) -> None:
    rng = random.Random(int(time.time()))
    for index in range(NUM_SWEEPS):
        place.submit(f"s{'x' * (index % 3)}{index}", rng.uniform(0.0, 1.5))
    place.start()
    server = request.getfixturevalue("postgresql") if place.url.startswith("postgresql") else None
    victims: Counter[str] = Counter()
    kinds = ["service", "driver"] + (["database"] if server else [])
    # About as many of each, in any order.
    for victim in rng.sample([kinds[index % len(kinds)] for index in range(NUM_KILLS)], NUM_KILLS):
        time.sleep(rng.uniform(0.05, 0.8))
        kill_one(victim, place, server, rng)
        victims[victim] += 1
        place.start_again()
    jobs = all_ended(place, victims)
    assert victims["service"]
    # Nothing is lost: each sweep was done, and said to be.
    assert len(jobs) == NUM_SWEEPS
    assert {job.outcome for job in jobs} == {"completed"}, f"{jobs}\n{place.said()}"
    assert {SweepStore(place.folder / job.sweep).read_record().state for job in jobs} == {"completed"}
    # Nothing runs twice: two at once would have met at the sweep's lock too, and one of the jobs would have failed.
    told = defaultdict(list)
    for line in place.journal():
        told[line["sweep"]].append(line)
    for lines in told.values():
        check_that_one_ran_at_a_time(lines)


def kill_one(victim: str, place: Place, server: PostgreSQL | None, rng: random.Random) -> None:
    """Kill the service, a driver or the database, and start again what does not start by itself."""
    if victim == "service":
        place.kill()
        time.sleep(rng.uniform(0.0, 0.5))
        place.start()
    elif victim == "database" and server is not None:
        server.kill()
        time.sleep(rng.uniform(0.0, 0.5))
        server.start()
    elif drivers := place.drivers():
        with contextlib.suppress(ProcessLookupError):
            os.kill(rng.choice(drivers), signal.SIGKILL)


def all_ended(place: Place, victims: Counter[str]) -> list[Job]:
    """All jobs, when each has ended."""
    deadline = time.monotonic() + PATIENCE_S
    while not (jobs := place.jobs()) or any(job.state != "ended" for job in jobs):
        assert time.monotonic() < deadline, f"{jobs}\n{victims}\n{place.said()}"
        place.start_again()
        time.sleep(0.1)
    return jobs


def check_that_one_ran_at_a_time(lines: list[dict[str, Any]]) -> None:
    """Check what drivers wrote of one sweep: who ends it is who began it last, and the last one ended it."""
    assert lines[-1]["what"] == "end"
    running = None
    for line in lines:
        if line["what"] == "begin":
            assert running != line["pid"]
            running = line["pid"]
        else:
            assert line["pid"] == running
