"""What Tune counts as a failure: not the loss of a node, unless there is nothing but losses."""

from __future__ import annotations

import socket
import types
from collections.abc import Iterator
from typing import Any

import pytest
import ray
from ray.air.execution._internal import RayActorManager
from ray.exceptions import ActorUnavailableError, OutOfMemoryError, RayActorError, RayTaskError
from ray.tune.experiment import Trial
from tune_trial import TuneTrial

from tune_jobs.ray_tune.failures import describe_failure
from tune_jobs.ray_tune.lost_nodes import DrainNotice, NodeLeavesError, NodeLosses, node_that_left

pytestmark = pytest.mark.ray

HERE, THERE = "aa" * 28, "bb" * 28
DIED = ActorUnavailableError("connection reset", bytes.fromhex("cc" * 16))


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch, listener: socket.socket) -> dict[str, Any]:
    """A node where the actor was, as Ray tells of it; it can be changed."""
    node = {
        "NodeID": THERE, "Alive": True, "NodeManagerAddress": "127.0.0.1",
        "NodeManagerPort": listener.getsockname()[1], "actors": THERE, "draining": {},
    }  # fmt: skip
    context = types.SimpleNamespace(get_node_id=lambda: HERE)
    monkeypatch.setattr(ray, "get_runtime_context", lambda: context)
    monkeypatch.setattr(ray, "nodes", lambda: [node])
    monkeypatch.setattr(ray.util, "get_node_ip_address", lambda: "10.0.0.7")
    state = types.SimpleNamespace(get_draining_nodes=lambda: node["draining"])
    known = types.SimpleNamespace(actors=lambda actor_id: {"Address": {"NodeID": node["actors"]}}, state=state)
    monkeypatch.setattr(ray._private, "state", known)
    return node


def test_an_actor_that_died_on_a_node_that_answers_has_failed(nodes: dict[str, Any]) -> None:
    assert node_that_left(DIED) == ""
    assert node_that_left(RayTaskError("step", "a traceback", ValueError("broke"))) == ""
    assert node_that_left(None) == ""


@pytest.mark.parametrize("how", ["dead", "silent"])
def test_an_actor_on_a_node_that_is_gone_has_not(nodes: dict[str, Any], listener: socket.socket, how: str) -> None:
    if how == "dead":
        nodes["Alive"] = False
    else:
        # Ray takes a while to find out.
        listener.close()
    words = "Node 127.0.0.1 (bbbbbbbb) was lost."
    assert node_that_left(DIED) == words
    # One of its own that a trial waited for.
    assert node_that_left(RayTaskError("step", "a traceback", DIED)) == words
    # The driver's own node: then Ray has died.
    nodes["actors"] = HERE
    assert node_that_left(DIED) == ""


def test_a_process_learns_that_its_node_is_drained(nodes: dict[str, Any]) -> None:
    now = 0.0
    notice = DrainNotice(lambda: now)
    assert not notice.came
    nodes["draining"] = {HERE: 0}
    # Ray is not asked at each step.
    assert not notice.came
    now = 3.0
    assert notice.came
    assert (
        node_that_left(RayTaskError("step", "a traceback", notice.error())) == "Node 10.0.0.7 (aaaaaaaa) was drained."
    )
    assert isinstance(notice.error(), NodeLeavesError)


def test_losses_are_not_counted_until_there_is_nothing_else(nodes: dict[str, Any]) -> None:
    seen: list[BaseException] = []
    checkpoints, trial = iter([0, 0, 3, 3, 3, 3, 3, 3]), TuneTrial()
    losses = NodeLosses(lambda trial: next(checkpoints), seen.append)
    original = Trial.handle_error
    with losses.not_counted():
        Trial.handle_error(trial, ValueError("broke"))
        assert (trial.run_metadata.num_failures, losses.take(trial)) == (1, "")
        nodes["Alive"] = False
        for _ in range(7):
            Trial.handle_error(trial, DIED)
            assert (trial.run_metadata.num_failures, losses.take(trial)) == (1, "Node 127.0.0.1 (bbbbbbbb) was lost.")
        # The sixth in a row without a new checkpoint: it may be the cause.
        Trial.handle_error(trial, DIED)
        assert (trial.run_metadata.num_failures, losses.take(trial)) == (2, "")
    assert len(seen) == 9
    assert Trial.handle_error is original


def test_what_tune_keeps_no_error_of_is_told_too(nodes: dict[str, Any]) -> None:
    trial, losses = TuneTrial(), NodeLosses(lambda trial: 0, lambda error: None)
    said = "1 worker(s) were killed due to the node running low on memory. Memory on the node (IP: 127.0.0.1, ID: aa) "
    with losses.not_counted():
        Trial.handle_error(trial, ValueError("broke"))
        Trial.handle_error(
            trial, OutOfMemoryError(f"{said}was 6.32GB used / 23.54GB limit (0.26)\nOOM kill reason: ...")
        )
    assert trial.run_metadata.num_failures == 2
    assert describe_failure(losses.error_of(trial), "the log", timeout_s=1.0, what="pack") == (
        "Ray ended the process of the pack, as its node ran low on memory (6.32GB of 23.54GB were used).\nthe log"
    )


def test_an_actor_that_is_ended_for_its_memory_ends_no_run() -> None:
    told: list[Exception] = []
    actor = types.SimpleNamespace(actor_id=1, _on_error=lambda actor, error: told.append(error))
    task = types.SimpleNamespace(_tracked_actor=actor, _on_error=None)
    manager = types.SimpleNamespace(_failed_actor_ids=set(), _cleanup_actor=lambda tracked_actor: None)
    lack = OutOfMemoryError("was 1GB used / 2GB limit")
    with pytest.raises(RuntimeError):
        RayActorManager._actor_task_failed(manager, task, lack)
    with NodeLosses(lambda trial: 0, lambda error: None).not_counted():
        RayActorManager._actor_task_failed(manager, task, lack)
    assert all(isinstance(error, RayActorError) for error in told)
    assert "1GB of 2GB" in describe_failure(told[-1], "", timeout_s=1.0)
