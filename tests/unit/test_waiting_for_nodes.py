"""A sweep that waits for nodes: how long, what it says, and what it asks for; the cluster's answers are made here."""

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune import connected_ray
from tune_jobs.ray_tune.cluster import Connection
from tune_jobs.spec.file import load_spec
from tune_jobs.sweeps import waiting
from tune_jobs.sweeps.waiting import machine_that_fits

SPEC = load_spec(
    {
        "env": "CartPole-v1",
        "algorithm": "ppo",
        "engine": "rllib",
        "space": {"lr": {"grid": [1e-3, 2e-3]}},
        "resources": {"num_env_runners": 2},
    }
)


class Cluster:
    """What a cluster has, one answer after the other; and what it was asked for."""

    def __init__(self, *num_cpus: float) -> None:
        self.machines = [Machine(cpus, source="the cluster at auto", nodes=((cpus, 0.0),)) for cpus in num_cpus]
        self.asked: list[list[dict[str, float]]] = []
        self.connection = Connection("auto", is_client=False, machine=self.machines[0])

    def present(self, _: str) -> Machine:
        return self.machines.pop(0) if len(self.machines) > 1 else self.machines[0]

    @contextlib.contextmanager
    def asking(self, bundles: list[dict[str, float]]) -> Iterator[None]:
        self.asked.append(bundles)
        yield
        self.asked.append([])


def of(monkeypatch: pytest.MonkeyPatch, *num_cpus: float) -> Cluster:
    cluster = Cluster(*num_cpus)
    monkeypatch.setattr(connected_ray, "present_machine", cluster.present)
    monkeypatch.setattr(connected_ray, "asking_for", cluster.asking)
    monkeypatch.setattr(waiting, "_POLL_INTERVAL_S", 0.01)
    return cluster


def test_a_sweep_that_fits_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 3)
    assert machine_that_fits(SPEC, cluster.connection, 60, "mine", "none") is cluster.connection.machine
    assert cluster.asked == []


def test_without_the_option_the_plan_refuses_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 1, 3)
    assert machine_that_fits(SPEC, cluster.connection, 0, "mine", "none").num_cpus == 1


def test_it_begins_once_one_trial_fits_and_asks_for_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    @contextlib.contextmanager
    def working(name: str, what: str, progress: str) -> Iterator[None]:
        said.append(what)
        yield

    monkeypatch.setattr("tune_jobs.sweeps.live_view.working", working)
    cluster = of(monkeypatch, 1, 1, 2, 2, 3)
    assert machine_that_fits(SPEC, cluster.connection, 60, "mine", "auto").num_cpus == 3
    # One trial, and withdrawn at the end.
    assert cluster.asked == [[{"CPU": 1.0}, {"CPU": 1.0}, {"CPU": 1.0}], []]
    assert ["Missing: 2 CPUs" in text or "Missing: 1 CPU" in text for text in said] == [True, True]
    assert "for at most 60 s: One trial needs 3 CPUs" in said[0]


def test_the_limit_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 2)
    with pytest.raises(CannotRunError) as caught:
        machine_that_fits(SPEC, cluster.connection, 0.1, "mine", "none")
    error: Any = caught.value
    assert error.message.startswith("No node that one trial fits on joined within 0.1 s. One trial needs 3 CPUs")
    assert "forever" not in error.message
