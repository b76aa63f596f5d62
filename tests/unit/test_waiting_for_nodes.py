"""A sweep that waits for nodes: how long, what it says, and what it asks for; the cluster's answers are made here."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError
from tune_jobs.plan.concurrency import max_concurrent
from tune_jobs.plan.machine import Machine
from tune_jobs.ray_tune import connected_ray
from tune_jobs.ray_tune.cluster import Connection
from tune_jobs.spec.file import load_spec
from tune_jobs.sweeps import drive, waiting
from tune_jobs.sweeps.interrupted import SweepInterrupted
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
        try:
            yield
        finally:
            self.asked.append([])


def of(monkeypatch: pytest.MonkeyPatch, *num_cpus: float) -> Cluster:
    cluster = Cluster(*num_cpus)
    monkeypatch.setattr(connected_ray, "present_machine", cluster.present)
    monkeypatch.setattr(connected_ray, "asking_for", cluster.asking)
    monkeypatch.setattr(waiting, "_POLL_INTERVAL_S", 0.01)
    return cluster


def test_a_sweep_that_fits_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 3)
    assert machine_that_fits(SPEC, cluster.connection, 60, name="mine", progress="none") is cluster.connection.machine
    assert cluster.asked == []


def test_without_the_option_the_plan_refuses_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 1, 3)
    assert machine_that_fits(SPEC, cluster.connection, 0, name="mine", progress="none").num_cpus == 1


def test_it_begins_once_one_trial_fits_and_asks_for_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    @contextlib.contextmanager
    def working(name: str, what: str, progress: str) -> Iterator[None]:
        said.append(what)
        yield

    monkeypatch.setattr("tune_jobs.sweeps.live_view.working", working)
    cluster = of(monkeypatch, 1, 1, 2, 2, 3)
    assert machine_that_fits(SPEC, cluster.connection, 60, name="mine", progress="auto").num_cpus == 3
    # One trial, and withdrawn at the end.
    assert cluster.asked == [[{"CPU": 1.0}, {"CPU": 1.0}, {"CPU": 1.0}], []]
    assert ["Missing: 2 CPUs" in text or "Missing: 1 CPU" in text for text in said] == [True, True]
    assert "for at most 60 s: One trial needs 3 CPUs" in said[0]


def test_the_limit_ends_the_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 2)
    with pytest.raises(CannotRunError) as caught:
        machine_that_fits(SPEC, cluster.connection, 0.1, name="mine", progress="none")
    error: Any = caught.value
    assert error.message.startswith("No node that one trial fits on joined within 0.1 s. One trial needs 3 CPUs")
    assert "forever" not in error.message


def test_a_sweep_that_is_asked_to_stop_does_not_wait_on(monkeypatch: pytest.MonkeyPatch) -> None:
    cluster = of(monkeypatch, 2)
    asked = iter([False, False, True])
    with pytest.raises(SweepInterrupted):
        machine_that_fits(SPEC, cluster.connection, 3, name="mine", progress="none", stop_requested=lambda: next(asked))
    assert cluster.asked[-1] == []


def node(cpus: float, *, alive: bool = True) -> dict[str, Any]:
    return {"Alive": alive, "Resources": {"CPU": cpus, "memory": 4e9} if cpus else {"memory": 1e9}}


def test_nodes_that_join_are_counted_and_those_that_left_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = [[node(0)], [node(0), node(4, alive=False), node(2)], [node(0), node(4, alive=False), node(2), node(1)]]
    monkeypatch.setattr("ray.nodes", lambda: tables.pop(0) if len(tables) > 1 else tables[0])
    asked: list[list[dict[str, float]]] = []
    monkeypatch.setattr(connected_ray, "_request", asked.append)
    monkeypatch.setattr(waiting, "_POLL_INTERVAL_S", 0.01)
    with connected_ray.of_a_sweep():
        connection = Connection("auto", is_client=False, machine=connected_ray.cluster_machine("the cluster"))
        machine = machine_that_fits(SPEC, connection, 60, name="mine", progress="none")
    assert (machine.num_cpus, machine.nodes) == (3, ((0, 0), (2, 0), (1, 0)))
    assert [len(bundles) for bundles in asked] == [3, 0]


@pytest.mark.parametrize(
    ("changes", "at_once"),
    [({}, 6), ({"resources": {"num_env_runners": 2, "max_concurrent": 4}}, 4), ({"search": {"type": "tpe"}}, 1)],
    ids=["all that are left", "as many as the user lets", "a search keeps its number"],
)
def test_trials_may_begin_on_nodes_that_join(tmp_path: Path, changes: dict[str, Any], at_once: int) -> None:
    space = {"lr": {"loguniform": [1e-3, 1e-2]}}
    spec = load_spec({**SPEC.model_dump(exclude_unset=True), "space": space, "num_samples": 12, **changes})
    now = max_concurrent(spec, Machine(3, source="the cluster at auto", nodes=((3.0, 0.0),)), 12)
    assert now == 1
    store = make_sweep_folder(tmp_path / "mine")
    store.write_record(store.read_record().model_copy(update={"spec": spec.model_dump(mode="json")}))
    assert drive.most_at_once(store, now, num_trials=6) == at_once
