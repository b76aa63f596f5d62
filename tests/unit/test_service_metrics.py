"""What Prometheus is told: over real HTTP, read by Prometheus' own parser, with bounded labels that name nobody."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fastapi.testclient import TestClient
from live_service import Live, live, serving, wait_until  # noqa: F401 (fixture)
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families
from service_access import bearer, make_token
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sqlalchemy import Engine
from sqlalchemy.exc import OperationalError
from sweep_folders import make_sweep_folder

from tune_jobs.service import supervisor as module
from tune_jobs.service.database.opening import open_database, sqlite_url
from tune_jobs.service.service import Service
from tune_jobs.service.state_metrics import EnvSteps
from tune_jobs.service.telling import COMMAND, WAITS_S, Teller

# ruff: noqa: F811 - fixtures are named as arguments

OWNER = "annabella"


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    """One kind of database is enough here."""
    return sqlite_url(tmp_path / "service.db")


class Scrape:
    """The samples of one answer."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.families = {family.name: family for family in text_string_to_metric_families(text)}
        self.samples = [sample for family in self.families.values() for sample in family.samples]

    def value(self, name: str, **labels: str) -> float:
        (found,) = [
            s.value for s in self.samples if s.name == f"tune_jobs_{name}" and s.labels.items() >= labels.items()
        ]
        return found

    def of(self, name: str) -> list[Any]:
        return [sample for sample in self.samples if sample.name == f"tune_jobs_{name}"]


def scrape(at: Live) -> Scrape:
    answer = httpx2.get(f"{at.url}/metrics", timeout=30)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    return Scrape(answer.text)


def test_sweeps_and_trials_are_counted_by_their_states(live: Live) -> None:
    assert scrape(live).value("sweeps", state="completed") == 0
    make_sweep_folder(live.storage / "done")
    store = make_sweep_folder(live.storage / "other")
    store.write_record(store.read_record().model_copy(update={"state": "created"}))
    (live.storage / "damaged").mkdir()
    (live.storage / "damaged" / "sweep.json").write_text("{")
    found = scrape(live)
    assert {s.labels["state"]: s.value for s in found.of("sweeps")} == {
        "created": 1, "running": 0, "interrupted": 0, "completed": 1,
    }  # fmt: skip
    assert found.value("trials", status="completed") == 8
    assert len(found.of("trials")) == 6
    assert found.value("sweeps_unreadable") == 1
    assert found.value("build_info", version="0.1.0") == 1
    assert found.value("database_up") == 1
    assert "process_resident_memory_bytes" in found.families


def test_env_steps_count_from_the_begin_of_the_service_and_never_go_back(live: Live) -> None:
    make_sweep_folder(live.storage / "old")
    assert scrape(live).value("env_steps_total") == 0
    store = make_sweep_folder(live.storage / "new")
    store.write_record(store.read_record().model_copy(update={"created_at": time.time() + 1}))
    steps = sum(trial.num_env_steps for trial in store.read_trials())
    assert steps > 0
    assert scrape(live).value("env_steps_total") == steps
    assert scrape(live).value("env_steps_total") == steps
    store.delete()
    assert scrape(live).value("env_steps_total") == steps


def test_steps_of_a_sweep_that_came_and_went_between_two_scrapes_count(client: TestClient, service: Service) -> None:
    """It was trained by a job, or from a terminal."""
    expected = 0
    for name in ("queued", "terminal"):
        store = make_sweep_folder(Path(service.config.storage) / name)
        store.write_record(store.read_record().model_copy(update={"created_at": time.time() + 1}))
        expected += sum(trial.num_env_steps for trial in store.read_trials())
    job, _ = service.queue.begin("queued", "drive", {}, owner=OWNER, num_cpus=1.0)
    service.supervisor._finish(job, "completed")
    service.storage.sweep("queued").delete()
    assert client.delete("/api/v1/sweeps/terminal").status_code == 204
    assert Scrape(client.get("/metrics").text).value("env_steps_total") == expected > 0


def test_what_was_seen_earlier_and_comes_later_counts_nothing_twice(client: TestClient, service: Service) -> None:
    store = make_sweep_folder(Path(service.config.storage) / "new")
    store.write_record(store.read_record().model_copy(update={"created_at": time.time() + 1}))
    trial = store.trial("t0001").read_record()
    store.trial("t0001").write_record(trial.model_copy(update={"num_env_steps": trial.num_env_steps - 100}))
    before = service.statuses.see("new")
    store.trial("t0001").write_record(trial)
    store.write_record(store.read_record())
    after = service.statuses.see("new")
    assert after.status.num_env_steps == before.status.num_env_steps + 100
    steps = EnvSteps(began_at=0.0)
    for item in (after, before, after):
        steps.saw(item)
    assert steps.total == after.status.num_env_steps


def test_a_sweep_that_could_not_be_read_for_a_while_counts_once(live: Live) -> None:
    store = make_sweep_folder(live.storage / "new")
    record = store.read_record().model_copy(update={"created_at": time.time() + 1})
    store.write_record(record)
    before = scrape(live).value("env_steps_total")
    assert before > 0
    (store.folder / "sweep.json").write_text("{")
    assert scrape(live).value("sweeps_unreadable") == 1
    store.write_record(record)
    assert scrape(live).value("env_steps_total") == before
    assert isinstance(EnvSteps().total, int)


def test_the_queue_is_counted_by_state_and_verb_and_nobody_is_named(live: Live) -> None:
    queue = live.service.queue
    for name in ("a", "b"):
        queue.begin(name, "drive", {}, owner=OWNER, num_cpus=1.5)
    queue.begin("c", "extend", {}, owner="bob", num_cpus=1.0)
    assert queue.claim(2.0) is not None
    ended, _ = queue.begin("d", "retry", {}, owner="carl")
    queue.end(ended.id, "stopped")
    found = scrape(live)
    assert {(s.labels["state"], s.labels["verb"]): s.value for s in found.of("jobs") if s.value} == {
        ("running", "drive"): 1, ("waiting", "drive"): 1, ("waiting", "extend"): 1,
    }  # fmt: skip
    assert (found.value("queue_owners"), found.value("cpus_used"), found.value("drivers")) == (2, 1.5, 0)
    assert 0 < found.value("queue_oldest_wait_seconds") < 60
    live.get("/sweeps", params={"owner": OWNER})
    assert OWNER not in scrape(live).text


def test_jobs_that_end_and_drivers_that_live_are_counted(client: TestClient, service: Service) -> None:
    text = client.get("/metrics").text
    assert Scrape(text).value("jobs_ended_total", verb="drive", outcome="completed") == 0
    spec = FAKE | {"hyperparams": {}}
    assert client.post("/api/v1/sweeps", json={"spec": spec, "name": "mine"}).status_code == 201
    store = service.storage.sweep("mine")
    record = store.read_record()
    store.write_record(record.model_copy(update={"spec": record.spec | {"hyperparams": {"seconds": 1.0}}}))
    # The fixture's queue stands still: it is looked at by hand.
    service.supervisor._look()
    wait_until(lambda: Scrape(client.get("/metrics").text).value("drivers") == 1)

    def ended() -> float:
        service.supervisor._look()
        return Scrape(client.get("/metrics").text).value("jobs_ended_total", verb="drive", outcome="completed")

    wait_until(ended, 60)
    assert Scrape(client.get("/metrics").text).value("drivers") == 0


def test_a_driver_that_died_is_counted(client: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_wait_s", lambda _: 0.0)
    monkeypatch.setattr(module, "MAX_ATTEMPTS", 2)
    assert client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "mine"}).status_code == 201
    store = service.storage.sweep("mine")
    record = store.read_record()
    spec = record.spec | {"hyperparams": {"seconds": 0, "exit": True}}
    store.write_record(record.model_copy(update={"spec": spec}))

    def died() -> float:
        service.supervisor._look()
        return Scrape(client.get("/metrics").text).value("jobs_ended_total", verb="drive", outcome="failed")

    wait_until(died, 60)
    assert Scrape(client.get("/metrics").text).value("driver_deaths_total") == 2


def test_requests_are_timed_by_the_path_as_it_is_declared(live: Live) -> None:
    make_sweep_folder(live.storage / "secretive")
    live.get("/sweeps/secretive")
    live.get("/sweeps/secretive/trials/t0000")
    live.get("/sweeps/missing")
    live.get("/nowhere/secretive")
    httpx2.get(f"{live.url}/api/v1/me", headers={"Host": "evil.example"})
    httpx2.request("BREW", f"{live.url}/api/v1/me")
    found = scrape(live)
    count = "http_request_duration_seconds_count"
    assert found.value(count, route="/api/v1/sweeps/{name}", status="2xx", method="GET") == 1
    assert found.value(count, route="/api/v1/sweeps/{name}", status="4xx") == 1
    assert found.value(count, route="/api/v1/sweeps/{name}/trials/{trial_id}") == 1
    # No such path, and a host that is not the service's.
    assert found.value(count, route="none", method="GET", status="4xx") == 2
    assert found.value(count, method="other") == 1
    assert "secretive" not in found.text
    assert "missing" not in found.text
    took = found.value("http_request_duration_seconds_sum", route="/api/v1/sweeps/{name}", status="2xx")
    assert 0 < took < 30


def test_a_stream_counts_when_it_begins_and_its_watcher_while_it_lasts(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with live.events("/sweeps/done/events") as reader:
        wait_until(lambda: reader.events)
        found = scrape(live)
        assert found.value("event_streams") == 1
        assert found.value("event_streams_limit") == live.service.config.limits.watchers
        assert found.value("http_request_duration_seconds_count", route="/api/v1/sweeps/{name}/events") == 1
    wait_until(lambda: scrape(live).value("event_streams") == 0)


def test_a_token_is_needed_where_one_is_and_a_viewers_is_enough(tmp_path: Path) -> None:
    storage = tmp_path / "sweeps"
    secret = make_token(storage, "prometheus", "viewer")
    with serving(storage, require_token=True) as at:
        assert httpx2.get(f"{at.url}/metrics").status_code == 401
        answer = httpx2.get(f"{at.url}/metrics", headers=bearer(secret))
        found = Scrape(answer.text)
        assert found.value("http_request_duration_seconds_count", route="none", status="4xx") == 1
        assert "prometheus" not in {value for sample in found.samples for value in sample.labels.values()}


def test_openmetrics_is_told_to_who_asks_for_it(live: Live) -> None:
    # As Prometheus 3 asks.
    accept = "application/openmetrics-text;version=1.0.0;q=0.5,text/plain;version=0.0.4;q=0.3,*/*;q=0.1"
    answer = httpx2.get(f"{live.url}/metrics", headers={"Accept": accept})
    assert answer.headers["content-type"].startswith("application/openmetrics-text")
    families: Any = openmetrics.text_string_to_metric_families(answer.text)  # type: ignore[no-untyped-call]
    assert "tune_jobs_sweeps" in {family.name for family in families}


def test_without_its_database_the_rest_is_told(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    def away() -> None:
        raise OperationalError("SELECT", {}, Exception("gone"))

    monkeypatch.setattr(live.service.queue, "load", away)
    found = scrape(live)
    assert found.value("database_up") == 0
    assert "_created" not in found.text
    assert found.of("jobs") == []
    assert len(found.of("sweeps")) == 4


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    made = open_database(sqlite_url(tmp_path / "service.db"))
    yield made
    made.dispose()


def test_each_attempt_to_tell_something_is_counted(engine: Engine) -> None:
    told: list[tuple[str, str]] = []
    at = 1_000_000.0
    targets = [COMMAND + '["false"]', COMMAND + '["true"]', "http://127.0.0.1:1/hook"]
    teller = Teller(engine, targets, on_attempt=lambda kind, delivery: told.append((kind, delivery)), now=lambda: at)
    assert teller.waiting() == 0
    teller.tell("sweep.ended", {})
    assert teller.waiting() == 3
    teller.send_due()
    assert sorted(told) == [("command", "arrived"), ("command", "failed"), ("webhook", "failed")]
    assert teller.waiting() == 2
    for wait_s in WAITS_S:
        at += wait_s
        teller.send_due()
    assert teller.waiting() == 0
    assert sorted(told[-2:]) == [("command", "given_up"), ("webhook", "given_up")]
