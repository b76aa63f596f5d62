"""Watching a policy play over HTTP: events in order, what can't be played, and that a player ends with its watcher."""

import asyncio
import contextlib
import json
import os
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
import uvicorn
from fastapi.testclient import TestClient
from services import client, postgresql, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from policies.envs.modules import ENVIRONMENT_VARIABLE
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http import play_routes
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments

PIPES: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "start_new_session": True}


@pytest.fixture
def database_url(tmp_path: Path) -> str:
    return sqlite_url(tmp_path / "service.db")


@pytest.fixture(autouse=True)
def finished(service: Service) -> None:
    make_sweep_folder(Path(service.config.storage) / "done")


def events(text: str) -> list[tuple[str, dict[str, Any]]]:
    found = []
    for block in text.strip().split("\n\n"):
        kind, data = block.split("\n")
        found.append((kind.removeprefix("event: "), json.loads(data.removeprefix("data: "))))
    return found


def test_an_episode_from_its_beginning_to_its_end(client: TestClient) -> None:
    answer = client.get("/api/v1/sweeps/done/play", params={"trial": "t0003", "seed": 5, "speed": 10})
    assert answer.headers["content-type"].startswith("text/event-stream")
    (first, info), *steps, (last, end) = events(answer.text)
    assert (first, info["env_id"], info["seed"], info["is_drawn"]) == ("info", "CartPole-v1", 5, True)
    assert {kind for kind, _ in steps} == {"step"}
    assert [step["num_env_steps"] for _, step in steps] == list(range(len(steps)))
    assert all(step["picture"] for _, step in steps)
    assert (last, end["total"], end["over"]) == ("end", steps[-1][1]["total"], True)


def test_an_episode_goes_on_from_a_step(client: TestClient) -> None:
    query: dict[str, Any] = {"trial": "t0003", "seed": 5, "speed": 10}
    _, *whole = events(client.get("/api/v1/sweeps/done/play", params=query).text)
    (first, info), *rest = events(client.get("/api/v1/sweeps/done/play", params=query | {"start": 4}).text)
    assert (first, info["actions"]["names"]) == ("info", ["push left", "push right"])
    assert rest == whole[4:]
    assert rest[-1][1]["ended_by"] == "terminated"


def test_a_random_policy_beside_it(client: TestClient) -> None:
    answer = client.get("/api/v1/sweeps/done/play", params={"random": True, "speed": 10})
    (_, info), *_, (last, _) = events(answer.text)
    assert (info["description"], last) == ("random policy", "end")


@pytest.mark.parametrize(("query", "status", "told"), [
    ({"trial": "t9999"}, 404, "t9999"),
    ({"trial": "../../x"}, 404, "x"),
    ({"trial": "t0003", "iteration": 1}, 404, "it has those of iterations"),
    ({}, 404, "no best policy"),
    ({"trial": "t0003", "seed": -1}, 422, "seed"),
    ({"trial": "t0003", "speed": 0}, 422, "speed"),
    ({"trial": "t0003", "start": 10_001}, 422, "start"),
])  # fmt: skip
def test_what_cannot_be_played(client: TestClient, query: dict[str, Any], status: int, told: str) -> None:
    answer = client.get("/api/v1/sweeps/done/play", params=query)
    assert answer.status_code == status, answer.text
    assert told in answer.text


def test_no_more_are_played_than_the_limit_allows(client: TestClient, service: Service) -> None:
    object.__setattr__(service.config.limits, "players", 0)
    assert client.get("/api/v1/sweeps/done/play", params={"trial": "t0003"}).status_code == 429


def test_an_env_that_fails_is_said(client: TestClient, service: Service) -> None:
    record = service.storage.sweep("done").read_record()
    spec = record.spec | {"env": {"id": "Acrobot-v1", "args": {}}}
    service.storage.sweep("done").write_record(record.model_copy(update={"spec": spec}))
    answer = client.get("/api/v1/sweeps/done/play", params={"trial": "t0003"})
    ((kind, told),) = events(answer.text)
    assert kind == "problem"
    assert "Acrobot-v1" in told["detail"]


MARKED = """\
from pathlib import Path
from gymnasium.envs.classic_control import CartPoleEnv

Path(__file__).with_name("imported").touch()

class Pole(CartPoleEnv):
    pass
"""


@pytest.fixture
def imported(service: Service, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What is there once the module is imported that the record of a sweep allows, and names as its env's."""
    folder = service.config.working_folder
    (folder / "play_marked.py").write_text(MARKED)
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    record = service.storage.sweep("done").read_record()
    spec = record.spec | {"env": {"id": "play_marked:Pole", "args": {}}}
    changes = {"spec": spec, "allowed_modules": ("play_marked",)}
    service.storage.sweep("done").write_record(record.model_copy(update=changes))
    return folder / "imported"


@pytest.mark.parametrize("query", [{"trial": "t0003"}, {"random": True}])
def test_what_a_record_allows_is_not_imported(client: TestClient, imported: Path, query: dict[str, Any]) -> None:
    answer = client.get("/api/v1/sweeps/done/play", params=query | {"speed": 10})
    assert answer.status_code == 422, answer.text
    assert "would import the Python module 'play_marked', which this service does not allow" in answer.json()["detail"]
    assert "`serve --allow-module play_marked`" in answer.json()["hint"]
    assert not imported.exists()


def test_what_the_operator_allows_is_played(client: TestClient, service: Service, imported: Path) -> None:
    object.__setattr__(service.config, "modules", ("play_marked",))
    answer = client.get("/api/v1/sweeps/done/play", params={"random": True, "speed": 10})
    assert [kind for kind, _ in events(answer.text)][-1] == "end", answer.text
    assert imported.exists()


@pytest.mark.parametrize("random", [False, True])
def test_a_module_of_a_network_is_needed_by_its_policy_alone(
    client: TestClient, service: Service, *, random: bool
) -> None:
    record = service.storage.sweep("done").read_record()
    changes = {"spec": record.spec | {"rl_module": "play_nets:Net"}, "allowed_modules": ("play_nets",)}
    service.storage.sweep("done").write_record(record.model_copy(update=changes))
    query: dict[str, Any] = {"random": True} if random else {"trial": "t0003"}
    answer = client.get("/api/v1/sweeps/done/play", params=query | {"speed": 10})
    assert (answer.status_code, "play_nets" in answer.text) == ((200, False) if random else (422, True))


def test_a_module_that_only_a_record_allows_is_not_given_to_the_player(service: Service) -> None:
    object.__setattr__(service.config, "modules", ("of_the_operator",))
    record = service.storage.sweep("done").read_record()
    service.storage.sweep("done").write_record(record.model_copy(update={"allowed_modules": ("of_the_record",)}))
    request, _ = play_routes._request(service, "done", "t0003", None, False)
    assert request["modules"] == ["of_the_operator"]


def test_of_many_that_come_at_once_only_as_many_are_played_as_may(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def slow(*_: Any, **__: Any) -> Any:
        # As on a busy machine, where a process takes a while to begin.
        begun.append(len(play_routes._playing))
        await asyncio.sleep(0.2)
        return await begin("false", **PIPES)

    async def ask_for_ten() -> list[int]:
        transport = httpx2.ASGITransport(make_app(service))
        async with httpx2.AsyncClient(transport=transport, base_url="http://127.0.0.1:8265") as asking:
            path = "/api/v1/sweeps/done/play?trial=t0003&speed=10"
            return [answer.status_code for answer in await asyncio.gather(*(asking.get(path) for _ in range(10)))]

    begun: list[int] = []
    begin = asyncio.create_subprocess_exec
    monkeypatch.setattr(asyncio, "create_subprocess_exec", slow)
    assert sorted(asyncio.run(ask_for_ten())) == [200] * 4 + [429] * 6
    assert len(begun) == 4
    # All places are free again.
    assert not play_routes._playing
    assert sorted(asyncio.run(ask_for_ten()))[:4] == [200] * 4


@pytest.fixture
def url(service: Service) -> Iterator[str]:
    """The address of a real server."""
    server = uvicorn.Server(uvicorn.Config(make_app(service), port=0, log_level="error"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join()


def test_a_player_ends_with_its_watcher(url: str) -> None:
    with urllib.request.urlopen(f"{url}/api/v1/sweeps/done/play?trial=t0003&speed=0.1", timeout=60) as answer:
        assert answer.readline() == b"event: info\n"
        (episode,) = play_routes._playing
        pid = episode.pid
        assert pid is not None
    deadline = time.monotonic() + 30
    with contextlib.suppress(ProcessLookupError):
        while True:
            os.kill(pid, 0)
            assert time.monotonic() < deadline, "the player lives on"
            time.sleep(0.05)
    assert not play_routes._playing
