"""A sweep that waits for nodes: how long, what it says, and what it asks for; the cluster's answers are made here."""

import contextlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sweep_folders import make_sweep_folder

from analysis.waits import WaitRecord
from policies.errors import CannotRunError, SpecError
from tune_jobs.plan.concurrency import max_concurrent
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.plan.machine import Machine
from tune_jobs.process.interruption import taking_signals
from tune_jobs.ray_tune import autoscaler, connected_ray
from tune_jobs.ray_tune.autoscaler import NodeType
from tune_jobs.ray_tune.cluster import Connection
from tune_jobs.service.labels import Label
from tune_jobs.service.statuses import Statuses
from tune_jobs.service.summaries import summary
from tune_jobs.spec.file import load_spec
from tune_jobs.store.local_storage import LocalStorage
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps import attach, drive, verbs, waiting
from tune_jobs.sweeps.create import CreatedSweep, removed_if_not_begun, write_created
from tune_jobs.sweeps.status import status_of
from tune_jobs.sweeps.waiting import WaitEndedError, machine_that_fits

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
        self.before: Callable[[], object] = object
        """Called before each answer."""

    def present(self, _: str) -> Machine:
        self.before()
        return self.machines.pop(0) if len(self.machines) > 1 else self.machines[0]

    @contextlib.contextmanager
    def asking(self, bundles: list[dict[str, float]]) -> Iterator["Cluster"]:
        self.asked.append(bundles)
        try:
            yield self
        finally:
            self.asked.append([])

    def let_go(self) -> None:
        """As a group of resources that is not there yet."""


def of(monkeypatch: pytest.MonkeyPatch, *num_cpus: float) -> Cluster:
    cluster = Cluster(*num_cpus)
    monkeypatch.setattr(connected_ray, "present_machine", cluster.present)
    monkeypatch.setattr(connected_ray, "asking_for", cluster.asking)
    monkeypatch.setattr(autoscaler, "node_types", tuple)
    monkeypatch.setattr(waiting, "_POLL_INTERVAL_S", 0.01)
    return cluster


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """A sweep that was created, and not begun."""
    return SweepStore(Path(write_created(SPEC, "mine", "mine", str(tmp_path), "auto").place))


def test_a_sweep_that_fits_does_not_wait(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    cluster = of(monkeypatch, 3)
    assert machine_that_fits(store, cluster.connection, 60, progress="none") is cluster.connection.machine
    assert cluster.asked == []


def test_without_the_option_the_plan_refuses_the_cluster(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    cluster = of(monkeypatch, 1, 3)
    assert machine_that_fits(store, cluster.connection, 0, progress="none").num_cpus == 1


def test_it_begins_once_one_trial_fits_and_asks_for_no_more(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    said: list[str] = []
    waits: list[WaitRecord | None] = []

    @contextlib.contextmanager
    def working(name: str, what: str, progress: str) -> Iterator[None]:
        said.append(what)
        waits.append(store.read_record().waiting)
        yield

    monkeypatch.setattr("tune_jobs.sweeps.live_view.working", working)
    cluster = of(monkeypatch, 1, 1, 2, 2, 3)
    assert machine_that_fits(store, cluster.connection, 60, progress="auto").num_cpus == 3
    # One trial, and withdrawn at the end.
    assert cluster.asked == [[{"CPU": 1.0}, {"CPU": 1.0}, {"CPU": 1.0}], []]
    assert [text.rpartition("Missing: ")[2] for text in said] == ["2 CPUs", "1 CPU"]
    assert re.search(r"since \d\d:\d\d:\d\d, until \d\d:\d\d:\d\d at the latest: One trial needs 3 CPUs", said[0])
    first, second = waits
    assert first is not None
    assert second is not None
    assert first.since == second.since
    assert first.until == pytest.approx(first.since + 60)
    assert first.resources == {"CPU": 3.0}
    assert (first.lacking, second.lacking) == tuple(text.partition("latest: ")[2] + "." for text in said)
    assert store.read_record().waiting is None


def test_who_has_the_storage_alone_sees_for_what_it_waits(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    cluster = of(monkeypatch, 1, 1, 3)
    told: list[dict[str, str]] = []
    shown: list[Any] = []

    def look() -> None:
        status = status_of(store, store.read_record(), store.read_trials())
        told.append(status.facts())
        look = attach._Look(store)
        look.update()
        told.append({"attach": look.monitor.phase})
        seen = Statuses(LocalStorage(store.folder.parent)).see("mine")
        shown.append(summary(seen, Label(owner=None, note="", tags=()), None))

    cluster.before = look
    with store.lock():
        machine_that_fits(store, cluster.connection, 60, progress="none")
    facts, attached = told[:2]
    assert facts["waits for"].startswith("nodes with room for one trial (3 CPUs), since ")
    assert re.search(r" UTC \([01] s\), at most (1 min 0|59|60) s more\. One trial needs 3 CPUs", facts["waits for"])
    assert facts["time left"] == "not known while it waits for nodes"
    assert attached["attach"].startswith("waiting for nodes with room for one trial (3 CPUs)")
    assert shown[0].waiting.resources == {"CPU": 3.0}
    facts = status_of(store, store.read_record(), store.read_trials()).facts()
    assert "waits for" not in facts


def test_the_limit_ends_the_wait_and_the_sweep_is_kept(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    cluster = of(monkeypatch, 2)
    created = CreatedSweep("mine", store.place)
    with pytest.raises(CannotRunError) as caught, removed_if_not_begun(created):
        machine_that_fits(store, cluster.connection, 0.1, progress="none")
    error: Any = caught.value
    assert error.message.startswith("No node that one trial fits on joined within 0.1 s. One trial needs 3 CPUs")
    assert "forever" not in error.message
    assert f"`tune-jobs resume {store.place} --address auto --wait-for-nodes SECONDS`" in error.hint
    status = status_of(store, store.read_record(), store.read_trials())
    assert status.state == "created"
    assert ", in vain. One trial needs 3 CPUs" in status.facts()["waited for"]
    assert status.waits_for is None
    assert "tune-jobs resume mine" in status.facts()["time left"]
    # The next one forgets it.
    assert machine_that_fits(store, of(monkeypatch, 3).connection, 60, progress="none").num_cpus == 3
    assert store.read_record().waiting is None


SMALL = NodeType("small", 1, 0, 5)


@pytest.mark.parametrize(
    ("changes", "types", "known"),
    [
        (
            {},
            (SMALL._replace(most=1), NodeType("idle", 0, 0, 9)),
            "small (1 CPU, 1 at most), idle (no CPUs, 9 at most)",
        ),
        ({"num_cpus": 8}, (SMALL, NodeType("large", 4, 1, 1_000)), "large (4 CPUs and 1 GPU, 1,000 at most)"),
        ({"num_gpus": 1}, (SMALL,), "small (1 CPU, 5 at most)"),
    ],
    ids=["too few nodes", "too small nodes", "no GPUs"],
)
def test_what_no_node_of_the_autoscaler_can_ever_hold_is_refused_at_once(
    monkeypatch: pytest.MonkeyPatch,
    store: SweepStore,
    changes: dict[str, Any],
    types: tuple[NodeType, ...],
    known: str,
) -> None:
    if changes:
        spec = load_spec({**SPEC.model_dump(exclude_unset=True), "resources": changes})
        store.write_record(store.read_record().model_copy(update={"spec": spec.model_dump(mode="json")}))
    cluster = of(monkeypatch, 1)
    monkeypatch.setattr(autoscaler, "node_types", lambda: types)
    with pytest.raises(CannotRunError) as caught, removed_if_not_begun(CreatedSweep("mine", store.place)):
        machine_that_fits(store, cluster.connection, 3, progress="none")
    assert re.search(r"needs \d .*With all nodes that its autoscaler may add it would not fit", caught.value.message)
    assert known in caught.value.message
    assert "forever" not in caught.value.message
    assert "resources.num_cpus" in caught.value.hint
    # Nothing was asked for, and nothing is left.
    assert cluster.asked == []
    assert not store.folder.exists()


def test_what_fits_on_nodes_of_the_autoscaler_is_waited_for(monkeypatch: pytest.MonkeyPatch, store: SweepStore) -> None:
    cluster = of(monkeypatch, 1, 3)
    # Each env runner may be on a node of its own.
    monkeypatch.setattr(autoscaler, "node_types", lambda: (SMALL._replace(most=2),))
    assert machine_that_fits(store, cluster.connection, 60, progress="none").num_cpus == 3


def test_another_error_leaves_nothing_of_a_new_sweep(store: SweepStore) -> None:
    with pytest.raises(CannotRunError), removed_if_not_begun(CreatedSweep("mine", store.place)):
        raise CannotRunError("The nodes cannot take part.")
    assert not store.folder.exists()


def test_a_sweep_that_is_asked_to_stop_or_interrupted_does_not_wait_on(
    monkeypatch: pytest.MonkeyPatch, store: SweepStore
) -> None:
    cluster = of(monkeypatch, 2)
    cluster.before = store.request_stop
    with pytest.raises(WaitEndedError):
        machine_that_fits(store, cluster.connection, 3, progress="none")
    assert cluster.asked[-1] == []

    def interrupt() -> None:
        raise KeyboardInterrupt

    cluster.before = interrupt
    store.clear_stop_request()
    with taking_signals() as interruption:
        with pytest.raises(WaitEndedError):
            machine_that_fits(store, cluster.connection, 3, progress="none")
        assert interruption.came


def test_there_is_nothing_to_wait_for_without_a_cluster(tmp_path: Path, store: SweepStore) -> None:
    why = r"--wait-for-nodes 600 .* no address names one"
    with pytest.raises(SpecError, match=why):
        verbs.launch(SPEC, name="other", storage=tmp_path, wait_for_nodes=600)
    with pytest.raises(SpecError, match=why):
        verbs.resume(store.place, wait_for_nodes=600)
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]
    assert store.read_record().state == "created"


class Group:
    """A placement group of Ray, which waits until its resources are there."""

    def __init__(self, bundles: list[dict[str, float]], strategy: str) -> None:
        self.bundles, self.strategy, self.is_removed = bundles, strategy, False

    def ready(self) -> str:
        return "ready"


def test_resources_are_let_go_once_they_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Group] = []
    are_there = False

    def make(bundles: list[dict[str, float]], strategy: str) -> Group:
        made.append(Group(bundles, strategy))
        return made[-1]

    monkeypatch.setattr(connected_ray, "placement_group", make)
    monkeypatch.setattr(connected_ray, "remove_placement_group", lambda group: setattr(group, "is_removed", True))
    monkeypatch.setattr("ray.wait", lambda refs, timeout: (refs, []) if are_there else ([], refs))
    with connected_ray.asking_for([{"CPU": 2.0}]) as asked:
        asked.let_go()
        assert [(group.bundles, group.is_removed) for group in made] == [([{"CPU": 2.0}], False)]
        are_there = True
        asked.let_go()
        assert made[0].is_removed
    with contextlib.suppress(RuntimeError), connected_ray.asking_for([{"CPU": 2.0}]):
        raise RuntimeError
    assert made[1].is_removed


def node(cpus: float, *, alive: bool = True) -> dict[str, Any]:
    return {"Alive": alive, "Resources": {"CPU": cpus, "memory": 4e9} if cpus else {"memory": 1e9}}


def test_nodes_that_join_are_counted_and_those_that_left_are_not(
    monkeypatch: pytest.MonkeyPatch, store: SweepStore
) -> None:
    tables = [[node(0)], [node(0), node(4, alive=False), node(2)], [node(0), node(4, alive=False), node(2), node(1)]]
    cluster = of(monkeypatch, 0)
    monkeypatch.undo()
    monkeypatch.setattr("ray.nodes", lambda: tables.pop(0) if len(tables) > 1 else tables[0])
    monkeypatch.setattr(connected_ray, "asking_for", cluster.asking)
    monkeypatch.setattr(autoscaler, "node_types", tuple)
    monkeypatch.setattr(waiting, "_POLL_INTERVAL_S", 0.01)
    with connected_ray.of_a_sweep():
        connection = Connection("auto", is_client=False, machine=connected_ray.cluster_machine("the cluster"))
        machine = machine_that_fits(store, connection, 60, progress="none")
    assert (machine.num_cpus, machine.nodes) == (3, ((0, 0), (2, 0), (1, 0)))
    assert [len(bundles) for bundles in cluster.asked] == [3, 0]


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


@pytest.mark.parametrize(
    ("changes", "slots", "more"),
    [
        ({}, 12, 0),
        ({}, 5, 2),
        ({"resources": {"max_concurrent": 10}}, 5, 1),
        ({"resources": {"max_concurrent": 9}}, 5, 0),
        ({"search": {"type": "tpe"}}, 5, 0),
    ],
    ids=["none waits", "those that wait", "as many as the user lets", "not half a pack", "a search keeps its number"],
)
def test_packs_may_begin_on_nodes_that_join(tmp_path: Path, changes: dict[str, Any], slots: int, more: int) -> None:
    space = {"lr": {"loguniform": [1e-3, 1e-2]}}
    given = {**SPEC.model_dump(exclude_unset=True), "engine": "auto", "resources": {}, "space": space, **changes}
    store = make_sweep_folder(tmp_path / "mine")
    spec = load_spec({**given, "num_samples": 12}).model_dump(mode="json")
    store.write_record(store.read_record().model_copy(update={"spec": spec}))
    names = tuple(f"t{index:04d}" for index in range(12))
    plan = PackPlan(1, slots, 1.0, 0.0, names, "scalar", None, 0)
    assert drive.packs_for_more_nodes(store, plan) == more
    assert drive.packs_for_more_nodes(store, None) == 0
