"""A service over an object store that hangs, is away or refuses: who asks is told so soon, and nobody else waits."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from anyio.to_thread import current_default_thread_limiter
from fastapi.testclient import TestClient
from s3_faults import Faults, faults, url  # noqa: F401 (fixtures)
from services import FAKE

from tests.narrowing import present
from tune_jobs.service import service as module
from tune_jobs.service import storage_health
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service
from tune_jobs.store import patience
from tune_jobs.store.objects import bucket
from tune_jobs.store.objects.url import ObjectUrl

# ruff: noqa: F811 - fixtures are named as arguments
# Half of it is what may pass until all have been told: far more than sixty requests take on a machine that does much
# else (10 s were seen), and far less than a store that was waited for would take.
HANG_S = 60.0
SWEEP_PATHS = ["/api/v1/sweeps", "/api/v1/sweeps/mine", "/api/v1/sweeps/mine/trials", "/api/v1/events"]


@pytest.fixture
def service(tmp_path: Path, url: ObjectUrl, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    """A service over a bucket, with a sweep that waits; its queue stands still."""
    for of in (bucket, patience):
        monkeypatch.setattr(of, "ANSWER_S", 1.0)
    monkeypatch.setattr(patience, "_AGAIN_S", 0.5)
    monkeypatch.setattr(patience.AWAY, "_known", {})
    monkeypatch.setattr(storage_health, "_EVERY_S", 0.5)
    config = ServiceConfig(storage=str(url.parent), own_folder=tmp_path / "own", spare_idle_s=0.0)
    with module.opened(config) as made:
        made.supervisor.close()
        yield made


@pytest.fixture
def client(service: Service, faults: Faults) -> Iterator[TestClient]:
    with TestClient(make_app(service), base_url="http://127.0.0.1:8265", raise_server_exceptions=False) as made:
        answer = made.post("/api/v1/sweeps", json={"spec": FAKE, "name": "mine"})
        assert answer.status_code == 201, answer.text
        assert made.get("/api/v1/sweeps").json()["sweeps"][0]["name"] == "mine"
        yield made
        faults.clear()


@pytest.fixture
def hangs(faults: Faults) -> Iterator[Callable[[], None]]:
    """The store answers nothing from its call on, for HANG_S or until the test ends, whichever is first."""
    over = threading.Event()

    def begin() -> None:
        faults.rule("before", times=10_000, then=lambda: over.wait(HANG_S))

    yield begin
    over.set()


def until_it_is_back(client: TestClient) -> None:
    deadline = time.monotonic() + 20
    while client.get("/api/v1/sweeps/mine").status_code != 200:
        assert time.monotonic() < deadline
        time.sleep(0.2)


def test_while_all_threads_wait_for_the_store_who_needs_none_is_answered(
    client: TestClient, faults: Faults, monkeypatch: pytest.MonkeyPatch
) -> None:
    for of in (bucket, patience):
        monkeypatch.setattr(of, "ANSWER_S", 100.0)
    answering = threading.Event()
    faults.rule("before", times=10_000, then=lambda: answering.wait(90))

    def num_free() -> float:
        limiter = current_default_thread_limiter()
        return limiter.total_tokens - limiter.borrowed_tokens

    with ThreadPoolExecutor(61) as pool:
        asked = [pool.submit(client.get, "/api/v1/sweeps/mine") for _ in range(60)]
        try:
            deadline = time.monotonic() + 60
            while present(client.portal).call(num_free):
                assert time.monotonic() < deadline, "requests do not wait in threads"
                time.sleep(0.01)
            assert pool.submit(client.get, "/healthz").result(20).status_code == 200
            assert not any(item.done() for item in asked)
        finally:
            faults.clear()
            answering.set()
        for item in asked:
            item.result()


@pytest.mark.parametrize("how", ["hangs", "is away"])
def test_a_store_that_does_not_answer_is_told_soon_and_known_to_be_away(
    client: TestClient, faults: Faults, hangs: Callable[[], None], how: str
) -> None:
    if how == "hangs":
        hangs()
    else:
        faults.away()
    with ThreadPoolExecutor(60) as pool:
        began = time.monotonic()
        # More than there are threads for requests.
        answers = list(pool.map(client.get, SWEEP_PATHS * 15))
        assert time.monotonic() - began < HANG_S / 2
    for answer in answers:
        assert answer.status_code == 503, answer.text
        assert answer.headers["Retry-After"] == "5"
        assert answer.headers["Content-Type"] == "application/problem+json"
        told = answer.json()
        said = "there was no answer in time" if how == "hangs" else "the connection was refused"
        assert said in told["detail"], told
        assert "is reached from this machine" in told["hint"]
        assert told["error"] == "CannotRunError"
    # It is known to be away by now: whoever asks does not wait, nor do those who need no store.
    began = time.monotonic()
    with ThreadPoolExecutor(60) as pool:
        for answer in pool.map(client.get, ["/api/v1/sweeps", "/api/v1/jobs"] * 30):
            assert answer.status_code in (503, 200)
    assert time.monotonic() - began < HANG_S / 2
    assert client.get("/readyz").status_code == 503
    time.sleep(0.6)
    assert "The storage can't be reached." in client.get("/readyz").json()["problems"]
    faults.clear()
    if how == "is away":
        faults.back()
    until_it_is_back(client)
    assert [item["name"] for item in client.get("/api/v1/sweeps").json()["sweeps"]] == ["mine"]
    time.sleep(0.6)
    assert "The storage can't be reached." not in client.get("/readyz").json()["problems"]


def test_a_store_that_refuses_is_no_damaged_sweep(client: TestClient, faults: Faults) -> None:
    faults.rule("status", status=403, body="<Error><Code>InvalidAccessKeyId</Code></Error>", times=10_000)
    for path in SWEEP_PATHS:
        answer = client.get(path)
        assert answer.status_code == 503, path
        assert answer.headers["Retry-After"] == "60"
        assert "status code: 403" in answer.json()["detail"]


def test_a_list_of_which_a_sweep_was_not_read_is_an_error(client: TestClient, faults: Faults) -> None:
    # The first look is that of the listing, the second one that of the sweep.
    faults.rule("status", kinds="HEAD", keys="mine/sweep.json$", skip=1, times=10_000)
    assert client.get("/api/v1/sweeps").status_code == 503


def test_a_sweep_is_not_made_nor_deleted_while_the_store_hangs(
    client: TestClient, faults: Faults, hangs: Callable[[], None]
) -> None:
    hangs()
    began = time.monotonic()
    assert client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "other"}).status_code == 503
    assert client.delete("/api/v1/sweeps/mine").status_code == 503
    assert time.monotonic() - began < HANG_S / 2
    faults.clear()
    until_it_is_back(client)
    assert client.get("/api/v1/sweeps/other").status_code == 404
    assert client.post("/api/v1/sweeps", json={"spec": FAKE, "name": "other"}).status_code == 201
    assert [job["sweep"] for job in client.get("/api/v1/jobs?state=waiting").json()] == ["mine", "other"]
    for name in ("mine", "other"):
        assert client.post(f"/api/v1/sweeps/{name}/stop").is_success
        answer = client.delete(f"/api/v1/sweeps/{name}?force=true")
        assert answer.status_code == 204, answer.text
        assert client.get(f"/api/v1/sweeps/{name}").status_code == 404
    assert client.get("/api/v1/sweeps").json()["sweeps"] == []
