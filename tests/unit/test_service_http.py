"""The REST interface: submit, plan, list, change, and what it says to requests that are wrong."""

import dataclasses
import json
import re
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest
from databases import PostgreSQL, postgresql  # noqa: F401 (a fixture)
from fastapi.testclient import TestClient
from services import FAKE, client, service  # noqa: F401 (fixtures)
from sweep_folders import make_sweep_folder

from analysis.records import ReplicationRecord
from tune_jobs.service.config import Limits
from tune_jobs.service.database.opening import sqlite_url
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service
from tune_jobs.spec.file import preset_names

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of a new database; of SQLite, where a test asks for no other."""
    if getattr(request, "param", "sqlite") == "sqlite":
        return sqlite_url(tmp_path / "service.db")
    server: PostgreSQL = request.getfixturevalue("postgresql")
    return server.new_database()


# What is about requests is asked with one database; the queue's own tests have both.
with_both = pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)


@pytest.fixture
def finished(service: Service) -> str:
    """A completed sweep of 4 trials that was made from a terminal."""
    make_sweep_folder(Path(service.config.storage) / "done")
    return "done"


def submit(client: TestClient, **changes: Any) -> dict[str, Any]:
    answer = client.post("/api/v1/sweeps", json={"spec": FAKE} | changes)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def problem(answer: Any, status: int) -> dict[str, Any]:
    """The problem document of an answer."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    found: dict[str, Any] = answer.json()
    assert found["status"] == status
    assert found["detail"]
    return found


# -- submitting


@with_both
def test_a_sweep_is_written_and_waits(client: TestClient, service: Service) -> None:
    found = submit(client, name="mine", priority=3, note="why", tags=["x", "y"])
    assert found["sweep"] == "mine"
    assert found["job"]["state"] == "waiting"
    seen = client.get("/api/v1/sweeps/mine").json()
    told = (seen["state"], seen["owner"], seen["note"], seen["tags"], seen["num_trials"], seen["env"])
    assert told == ("created", "local", "why", ["x", "y"], 4, "CartPole-v1")
    assert seen["job"]["priority"] == 3
    assert service.storage.sweep("mine").read_record().state == "created"
    assert client.get("/api/v1/sweeps/mine/spec").json()["space"]["lr"]["loguniform"] == [1e-4, 1e-2]


def test_a_preset_and_a_text_are_sweeps_too(client: TestClient) -> None:
    assert submit(client, spec=None, preset="cartpole-ppo")["sweep"] == "cartpole-ppo"
    assert submit(client, spec=None, preset="cartpole-ppo")["sweep"] == "cartpole-ppo-2"
    text = "name: from-text\nenv: CartPole-v1\nalgorithm: dqn\n"
    assert submit(client, spec=None, text=text)["sweep"] == "from-text"


def test_overrides_act(client: TestClient) -> None:
    submit(client, name="mine", overrides=["num_samples=2", "stop.num_env_steps=5_000"])
    seen = client.get("/api/v1/sweeps/mine").json()
    assert (seen["num_trials"], seen["max_env_steps"]) == (2, 2 * 5_000)


@with_both
def test_a_request_that_is_repeated_makes_one_sweep(client: TestClient, service: Service) -> None:
    answers = [client.post("/api/v1/sweeps", json={"spec": FAKE}, headers={"Idempotency-Key": "k"}) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [201, 200]
    assert answers[0].json() == answers[1].json()
    assert len(service.storage.sweeps()) == 1
    other = client.post("/api/v1/sweeps", json={"preset": "cartpole-ppo"}, headers={"Idempotency-Key": "k"})
    assert "'k'" in problem(other, 422)["detail"]


@with_both
def test_of_equal_requests_at_once_one_makes_a_sweep(client: TestClient, service: Service) -> None:
    answers: list[int] = []

    def send() -> None:
        answer = client.post("/api/v1/sweeps", json={"spec": FAKE}, headers={"Idempotency-Key": "k"})
        answers.append(answer.status_code)

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [200, 200, 200, 201]
    assert len(service.storage.sweeps()) == len(service.queue.jobs()) == 1


def test_a_plan_writes_nothing(client: TestClient, service: Service) -> None:
    found = client.post("/api/v1/plans", json={"spec": FAKE}).json()
    assert found["plan"]["num_trials"] == 4
    assert found["spec"]["algorithm"] == "ppo"
    assert service.storage.sweeps() == []
    assert service.queue.jobs() == []


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "nothing": ({}, "exactly one|one of preset, text and spec"),
    "two": ({"preset": "cartpole-ppo", "spec": FAKE}, "one of preset, text and spec"),
    "unknown field": ({"spec": FAKE, "prioriti": 1}, "prioriti"),
    "unknown preset": ({"preset": "cartpol-ppo"}, "Did you mean 'cartpole-ppo'"),
    "a path for a preset": ({"preset": "/etc/passwd"}, "no preset '/etc/passwd'"),
    "no YAML": ({"text": "env: ["}, "line 1"),
    "a text that is no mapping": ({"text": "CartPole-v1"}, "no fields"),
    "an empty text": ({"text": ""}, "no fields"),
    "a path for a text": ({"text": "/etc/passwd"}, "no fields"),
    "YAML that makes objects": ({"text": "env: !!python/object/apply:os.system [id]"}, "python/object"),
    "unknown hyperparameter": ({"spec": FAKE | {"space": {"hiden_sizes": {"grid": [[1]]}}}}, "'hidden_sizes'"),
    "a module": ({"spec": FAKE | {"env": "os:X-v0"}}, "'os' is not allowed"),
    "an entry point": ({"spec": FAKE | {"env": "subprocess:Popen"}}, "'subprocess' is not allowed"),
    "an RLModule": ({"spec": FAKE | {"rl_module": "os:system"}}, "not allowed"),
    "unknown env": ({"spec": FAKE | {"env": "NoSuchEnv-v0"}}, "NoSuchEnv"),
    "no number": ({"spec": FAKE, "priority": "high"}, "priority"),
    "a priority out of range": ({"spec": FAKE, "priority": 10**9}, "priority"),
    "a name that is a path": ({"spec": FAKE, "name": "../x"}, r"\.\./x"),
    "a hidden name": ({"spec": FAKE, "name": ".service"}, "service"),
    "a long name": ({"spec": FAKE, "name": "x" * 5_000}, "name"),
    "too many trials": ({"spec": FAKE | {"num_samples": 20_000}}, "at most 10,000|20,000"),
    "an override of nothing": ({"spec": FAKE, "overrides": ["num_sample=3"]}, "num_sample"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("path", ["sweeps", "plans"])
def test_what_is_wrong_is_said_and_nothing_is_made(client: TestClient, service: Service, case: str, path: str) -> None:
    body, told = WRONG[case]
    found = problem(client.post(f"/api/v1/{path}", json=body), 422)
    assert re.search(told, json.dumps(found)), found
    assert service.queue.jobs() == []
    assert service.storage.sweeps() == []


@pytest.mark.parametrize("body", [b"", b"{", b"null", b"[]", b"\xff\xfe", b'{"spec": NaN}', b"[" * 50_000])
def test_bodies_that_are_none(client: TestClient, body: bytes) -> None:
    answer = client.post("/api/v1/sweeps", content=body, headers={"content-type": "application/json"})
    assert answer.status_code in (400, 413, 422), answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert client.get("/healthz").status_code == 200


def test_a_name_that_is_taken_is_refused(client: TestClient, finished: str, service: Service) -> None:
    for body in ({"spec": FAKE, "name": finished}, {"spec": FAKE | {"name": finished}}):
        answer = client.post("/api/v1/sweeps", json=body)
        assert "'done'" in problem(answer, 422)["detail"]
        assert client.post("/api/v1/plans", json=body).json() == answer.json()
    assert client.post("/api/v1/plans", json={"spec": FAKE, "default_name": finished}).status_code == 200
    assert service.queue.jobs() == []


def test_an_env_that_the_operator_does_not_allow(client: TestClient, service: Service) -> None:
    object.__setattr__(service.config, "envs", ("Acrobot-.*",))
    found = problem(client.post("/api/v1/sweeps", json={"spec": FAKE}), 422)
    assert "'CartPole-v1'" in found["detail"]
    assert client.post("/api/v1/plans", json={"spec": FAKE | {"env": "Acrobot-v1"}}).status_code == 200


def test_limits_of_a_person_and_a_sweep(client: TestClient, service: Service) -> None:
    object.__setattr__(service.config.limits, "sweeps", 1)
    object.__setattr__(service.config.limits, "env_steps", 10**6)
    spec = FAKE | {"stop": {"num_env_steps": 1_000}}
    too_long = FAKE | {"stop": {"num_env_steps": 10**6}}
    assert "1,000,000" in problem(client.post("/api/v1/sweeps", json={"spec": too_long}), 422)["detail"]
    submit(client, spec=spec)
    assert "1 sweeps" in problem(client.post("/api/v1/sweeps", json={"spec": spec}), 429)["detail"]


# -- looking


def test_lists_have_pages(client: TestClient, service: Service) -> None:
    for index in range(5):
        make_sweep_folder(Path(service.config.storage) / f"s{index}")
    names, cursor = [], None
    while True:
        query: dict[str, Any] = {"sort": "name", "order": "asc", "limit": 2} | (
            {} if cursor is None else {"cursor": cursor}
        )
        page = client.get("/api/v1/sweeps", params=query).json()
        names.append([item["name"] for item in page["sweeps"]])
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert names == [["s0", "s1"], ["s2", "s3"], ["s4"]]


@pytest.mark.parametrize("cursor", ["x", "!!!", "bnVsbA", "W10", "e30", "WzEsIDJd", "W3t9LCAiYSJd", "A" * 1_999])
def test_a_cursor_of_another_list_is_refused(client: TestClient, finished: str, cursor: str) -> None:
    assert "cursor" in problem(client.get("/api/v1/sweeps", params={"cursor": cursor, "sort": "name"}), 422)["detail"]


def test_lists_are_filtered(client: TestClient, finished: str) -> None:
    submit(client, name="mine", tags=["x"])
    for query, names in (
        ({"state": "completed"}, ["done"]),
        ({"state": "created"}, ["mine"]),
        ({"owner": "local"}, ["mine"]),
        ({"tag": "x"}, ["mine"]),
        ({"search": "DON"}, ["done"]),
        ({"search": "cartpole"}, ["mine", "done"]),
        ({"state": "running"}, []),
    ):
        found = client.get("/api/v1/sweeps", params=query).json()["sweeps"]
        assert sorted(item["name"] for item in found) == sorted(names), query


def test_trials_are_sorted_by_score_or_by_a_hyperparameter(client: TestClient, finished: str) -> None:
    page = client.get("/api/v1/sweeps/done/trials", params={"limit": 2}).json()
    assert [(row["trial_id"], row["score"]) for row in page["trials"]] == [("t0003", 36.0), ("t0002", 26.0)]
    rest = client.get("/api/v1/sweeps/done/trials", params={"limit": 2, "cursor": page["next_cursor"]}).json()
    assert [row["trial_id"] for row in rest["trials"]] == ["t0001", "t0000"]
    assert rest["next_cursor"] is None
    rates = [
        row["point"]["lr"]
        for row in client.get("/api/v1/sweeps/done/trials", params={"sort": "lr", "order": "asc"}).json()["trials"]
    ]
    assert rates == sorted(rates)
    assert client.get("/api/v1/sweeps/done/trials", params={"status": "failed"}).json()["trials"] == []


def test_one_trial_its_iterations_and_its_log(client: TestClient, finished: str) -> None:
    assert client.get("/api/v1/sweeps/done/trials/t0003").json()["score"] == 36.0
    rows = client.get("/api/v1/sweeps/done/trials/t0003/iterations", params={"after": 4}).json()
    assert [(row["iteration"], row["evaluation_return"]) for row in rows] == [(5, 35.0), (6, 36.0)]
    assert "episode_returns" not in rows[0]
    assert "text" in client.get("/api/v1/sweeps/done/trials/t0003/log").json()


@pytest.mark.parametrize("path", [
    "sweeps/none", "sweeps/none/trials", "sweeps/none/spec", "sweeps/done/trials/t9999",
    "sweeps/done/trials/t9999/log", "sweeps/done/trials/t9999/iterations", "sweeps/done/trials/..%2f..%2fsweep.json",
    "sweeps/.service", "sweeps/.service/trials", "sweeps/%2e%2e", "sweeps/..%2fdone", "sweeps/done%00", "nothing",
])  # fmt: skip
def test_what_is_not_there(client: TestClient, finished: str, path: str) -> None:
    problem(client.get(f"/api/v1/{path}"), 404)


def test_a_damaged_sweep_is_named_and_hides_no_other(client: TestClient, finished: str, service: Service) -> None:
    make_sweep_folder(Path(service.config.storage) / "bad")
    (Path(service.config.storage) / "bad" / "sweep.json").write_text("{")
    names = [item["name"] for item in client.get("/api/v1/sweeps").json()["sweeps"]]
    assert names == ["done"]
    assert "sweep.json" in problem(client.get("/api/v1/sweeps/bad"), 500)["detail"]


def test_presets_schema_and_who_asks(client: TestClient) -> None:
    assert [item["name"] for item in client.get("/api/v1/presets").json()] == preset_names()
    assert "space" in client.get("/api/v1/schema").json()["properties"]
    assert client.get("/api/v1/me").json()["role"] == "admin"


def test_ready_says_what_is_missing(client: TestClient, service: Service) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}
    # The fixture's queue stands still.
    answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["status"]) == (503, "not ready")
    assert answer.json()["problems"] == ["The queue is not run."]


# -- changing


@with_both
def test_priority_note_and_tags_are_changed(client: TestClient) -> None:
    submit(client, name="mine", note="before", tags=["x"])
    found = client.patch("/api/v1/sweeps/mine", json={"priority": 7, "tags": []}).json()
    assert (found["job"]["priority"], found["note"], found["tags"]) == (7, "before", [])


def test_a_waiting_sweep_is_cancelled(client: TestClient) -> None:
    submit(client, name="mine")
    assert client.post("/api/v1/sweeps/mine/stop").json()[0]["outcome"] == "cancelled"
    assert "neither waits nor runs" in problem(client.post("/api/v1/sweeps/mine/stop"), 409)["detail"]
    assert client.post("/api/v1/sweeps/mine/resume").status_code == 202


def test_a_finished_sweep_is_extended_and_replicated_in_turn(client: TestClient, finished: str) -> None:
    extended = client.post("/api/v1/sweeps/done/extend", json={"num_samples": 3}).json()
    assert (extended["verb"], extended["arguments"]) == ("extend", {"to_num_samples": 5})
    # Said again, it is three more.
    again = client.post("/api/v1/sweeps/done/extend", json={"num_samples": 3}).json()
    assert again["arguments"] == {"to_num_samples": 8}
    raced = client.post("/api/v1/sweeps/done/replicate", json={"top": 2}).json()
    assert raced["arguments"] == {"top": 2, "seeds": 5}
    assert "that job already" in problem(client.post("/api/v1/sweeps/done/replicate", json={"top": 2}), 409)["detail"]


def test_how_many_trials_an_extended_sweep_will_have_is_planned_not_guessed(service: Service) -> None:
    spec = {"space": {"lr": {"uniform": [1e-4, 1e-2]}, "gamma": {"grid": [0.9, 0.99]}}, "seeds_per_point": 3}
    store = make_sweep_folder(Path(service.config.storage) / "done", iterations=1, num_samples=2, **spec)
    replication = ReplicationRecord(num_points=4, points=(0, 1, 1))
    store.write_record(store.read_record().model_copy(update={"replications": (replication,)}))
    # As a sweep is whose driver was killed while it wrote its trials.
    for trial in store.read_trials()[1:]:
        shutil.rmtree(store.folder / "trials" / trial.trial_id)
    extend = {"num_samples": 3}
    # Five samples for each of two values, with three seeds, and three more.
    for limit, status in ((32, 422), (33, 202)):
        limited = dataclasses.replace(service, config=dataclasses.replace(service.config, limits=Limits(trials=limit)))
        with TestClient(make_app(limited), base_url="http://127.0.0.1:8265") as asking:
            answer = asking.post("/api/v1/sweeps/done/extend", json=extend)
        assert answer.status_code == status, answer.text
        if status == 422:
            assert "would have 33 trials; here a sweep may have at most 32" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("action", "body", "num_trials"),
    [
        ("extend", {"num_samples": 3}, 10),
        ("trials", {"point": {"lr": 0.005}}, 6),
        # Two settings are all that there are.
        ("replicate", {"top": 5, "seeds": 4}, 12),
    ],
)
def test_what_is_added_stays_within_the_limits(
    service: Service, finished: str, action: str, body: dict[str, Any], num_trials: int
) -> None:
    spec = service.statuses.see(finished).status.sweep.spec
    each = spec["stop"]["num_env_steps"] - 1 + 2 * spec["hyperparams"].get("train_batch_size", 4_000)

    def asked(**limits: int) -> Any:
        limited = dataclasses.replace(service, config=dataclasses.replace(service.config, limits=Limits(**limits)))
        with TestClient(make_app(limited), base_url="http://127.0.0.1:8265") as asking:
            return asking.post(f"/api/v1/sweeps/{finished}/{action}", json=body)

    told = problem(asked(trials=num_trials - 1), 422)["detail"]
    assert f"would have {num_trials} trials" in told
    told = problem(asked(env_steps=1), 422)["detail"]
    most = int(told.split("might train ")[1].split()[0].replace(",", ""))
    assert num_trials * spec["stop"]["num_env_steps"] <= most <= num_trials * each
    problem(asked(env_steps=most - 1), 422)
    assert asked(trials=num_trials, env_steps=most).status_code == 202


def test_actions_that_cannot_be(client: TestClient, finished: str) -> None:
    problem(client.post("/api/v1/sweeps/done/retry"), 409)
    problem(client.post("/api/v1/sweeps/done/extend", json={"num_samples": 0}), 422)
    problem(client.post("/api/v1/sweeps/done/extend", json={"num_samples": 100_000}), 422)
    problem(client.post("/api/v1/sweeps/done/replicate", json={"top": 1}), 422)
    problem(client.post("/api/v1/sweeps/none/resume"), 404)
    submit(client, name="grid", spec=FAKE | {"space": {"lr": {"grid": [1e-3, 1e-2]}}, "num_samples": 1})
    problem(client.post("/api/v1/sweeps/grid/extend", json={"num_samples": 1}), 422)


@with_both
def test_a_finished_sweep_is_deleted(client: TestClient, finished: str, service: Service) -> None:
    assert client.delete("/api/v1/sweeps/done").status_code == 204
    assert not (Path(service.config.storage) / "done").exists()
    problem(client.get("/api/v1/sweeps/done"), 404)
    assert client.get("/api/v1/sweeps").json()["sweeps"] == []


def test_what_waits_or_has_not_finished_is_not_deleted(client: TestClient, service: Service) -> None:
    submit(client, name="mine")
    assert "waits or runs" in problem(client.delete("/api/v1/sweeps/mine"), 409)["detail"]
    client.post("/api/v1/sweeps/mine/stop")
    assert "not finished" in problem(client.delete("/api/v1/sweeps/mine"), 409)["detail"]
    assert client.delete("/api/v1/sweeps/mine?force=true").status_code == 204
    assert submit(client, name="mine")["sweep"] == "mine"


@with_both
def test_a_database_that_is_gone_is_said(client: TestClient, service: Service, finished: str) -> None:
    with service.engine.begin() as connection:
        connection.exec_driver_sql("DROP TABLE jobs")
    answer = client.get("/api/v1/sweeps/done")
    assert "database" in problem(answer, 503)["detail"]
    assert answer.headers["retry-after"] == "5"
    assert client.get("/healthz").status_code == 200
