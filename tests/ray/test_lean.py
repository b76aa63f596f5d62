"""What Ray Tune is spared, so that the driver's cost of a trial does not grow with their number."""

import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from ray.air.execution._internal import RayActorManager
from ray.tune import CheckpointConfig, PlacementGroupFactory
from ray.tune.execution.tune_controller import TuneController
from ray.tune.experiment import Experiment, Trial
from ray.tune.search import BasicVariantGenerator
from scripted_packs import make_sweep

from tune_jobs.ray_tune.lean import Sealed, lean_run
from tune_jobs.ray_tune.lost_nodes import NodeLosses
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.scheduling import EveryoneGoesOn
from tune_jobs.ray_tune.searcher import TrialsInOrder
from tune_jobs.ray_tune.trainable import TrialTrainable
from tune_jobs.ray_tune.tune_events import TrialEvents, trial_id_of
from tune_jobs.ray_tune.tune_scheduler import TuneScheduler
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper

pytestmark = pytest.mark.ray


class _NotLookedAt(list[Any]):
    """All trials of a sweep."""

    def __iter__(self) -> Iterator[Any]:
        raise AssertionError("looked at all trials")


def _trial(trial_id: str) -> Any:
    return types.SimpleNamespace(config={"trial_id": trial_id}, trial_id=trial_id, status=Trial.RUNNING)


def _events(folder: Path, num_trials: int) -> tuple[TrialEvents, RecordKeeper]:
    store = make_sweep(folder, num_trials)
    keeper = RecordKeeper(store, [f"t{i:04d}" for i in range(num_trials)], lambda record: None)
    losses = NodeLosses(lambda trial: 0, lambda error: None)
    return TrialEvents(store, keeper, 600.0, RayWatch({}, grace_s=1.0), losses), keeper


def test_a_paused_trial_is_noted_without_a_look_at_all_trials(tmp_path: Path) -> None:
    events, keeper = _events(tmp_path / "mine", 3)
    trials = [_trial(f"t{i:04d}") for i in range(2)]
    for trial in trials:
        events.on_trial_start(0, _NotLookedAt(), trial)
    events.on_step_end(1, _NotLookedAt())
    assert [keeper.record(f"t{i:04d}").status for i in range(3)] == ["running", "running", "pending"]
    trials[0].status = Trial.PAUSED
    events.on_step_end(2, _NotLookedAt())
    assert [keeper.record(f"t{i:04d}").status for i in range(3)] == ["paused", "running", "pending"]
    # It goes on, and is paused again.
    trials[0].status = Trial.RUNNING
    events.on_trial_start(3, _NotLookedAt(), trials[0])
    assert keeper.record("t0000").status == "running"
    trials[0].status = Trial.PAUSED
    events.on_step_end(4, _NotLookedAt())
    assert keeper.record("t0000").status == "paused"
    assert keeper.running == {"t0001"}


def test_a_report_is_passed_on_as_it_is_and_not_kept(tmp_path: Path) -> None:
    events, keeper = _events(tmp_path / "mine", 1)
    trial = _trial("t0000")
    events.on_trial_start(0, [], trial)
    progress = Progress(status="running", num_env_steps=7, evaluated=False)
    result = {"progress": Sealed(progress), "node": "here", "pid": 5}
    assert "num_env_steps" not in repr(result)
    events.on_trial_result(1, [], trial, result)
    assert keeper.record("t0000").num_env_steps == 7
    assert "progress" not in result


def test_tune_saves_no_trials_during_a_run_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    saved = []
    monkeypatch.setattr(TuneController, "checkpoint", lambda self, force=False, wait=False: saved.append((force, wait)))
    controller = TuneController.__new__(TuneController)
    controller._trials_to_cache, controller._trial_metadata = set(), {"t0000": "its state"}
    with lean_run():
        assert controller._get_trial_checkpoints() == {}
        controller.checkpoint()
        controller.checkpoint(force=True, wait=True)
    assert saved == [(True, True)]
    assert controller._get_trial_checkpoints() == {"t0000": "its state"}
    controller.checkpoint()
    assert saved == [(True, True), (False, False)]


def test_a_driver_that_waits_looks_twice_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = []
    monkeypatch.setattr(RayActorManager, "next", lambda self, timeout=None: waits.append(timeout))
    manager = RayActorManager.__new__(RayActorManager)
    monkeypatch.setattr(RayActorManager, "num_live_actors", 1)
    controller = mock.MagicMock(_actor_manager=manager)
    controller.is_finished.return_value = False

    def step_and_end() -> None:
        # Tune's own event, and its wait for processes that end.
        TuneController.step(controller)
        manager.next(timeout=1)

    with lean_run():
        step_and_end()
    step_and_end()
    assert waits == [0.5, 1, 0.1, 1]


def test_the_class_of_processes_is_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def ask(trial: Any) -> Any:
        asked.append(trial.trainable_name)
        return TrialTrainable

    monkeypatch.setattr(Trial, "get_trainable_cls", ask)
    trials = [Trial.__new__(Trial) for _ in range(3)]
    for trial in trials:
        trial.trainable_name = "TrialTrainable"
    with lean_run():
        assert [trial.get_trainable_cls() for trial in trials] == [TrialTrainable] * 3
    assert asked == ["TrialTrainable"]
    trials[0].get_trainable_cls()
    assert len(asked) == 2


def test_a_process_is_not_asked_for_what_no_report_says() -> None:
    actor, trial = mock.MagicMock(), Trial.__new__(Trial)
    trial.temporary_state, trial._default_result_or_future = types.SimpleNamespace(), None
    trial.trial_id, trial.run_metadata = "00000", types.SimpleNamespace(last_result={})
    with lean_run():
        trial.set_ray_actor(actor)
        assert trial.temporary_state.ray_actor is actor
        # What Tune tells of a trial that is ended before its first report.
        assert trial.last_result == {"trial_id": "00000"}
        trial.set_ray_actor(None)
    assert trial.temporary_state.ray_actor is None
    assert not actor.get_auto_filled_metrics.remote.called
    trial.set_ray_actor(actor)
    assert actor.get_auto_filled_metrics.remote.called


class _Actors:
    """Tune's processes: those of `starting` are being started, the others wait for a place."""

    def __init__(self, starting: set[str]) -> None:
        self._starting = starting

    def is_actor_started(self, actor: str) -> bool:
        return actor in self._starting


class _Controller:
    """What is asked of Tune's controller; `actors` are the trials with a process, or the wish for one."""

    def __init__(self, statuses: dict[str, str], actors: set[str], starting: set[str]) -> None:
        self._actor_manager = _Actors(starting)
        self._live = {_Hashed(name, status) for name, status in statuses.items()}
        self._trial_to_actor = {trial: trial.trial_id for trial in self._live if trial.trial_id in actors}

    def get_trials(self) -> Any:
        raise AssertionError("looked at all trials")

    def get_live_trials(self) -> set[Any]:
        return self._live


class _Hashed:
    def __init__(self, name: str, status: str) -> None:
        self.config, self.trial_id, self.status = {"trial_id": name}, name, status


@pytest.mark.parametrize(
    ("statuses", "starting", "chosen"),
    [
        # As in Ray's own: the first that waits, and paused ones only where none waits.
        ("t0009 PENDING, t0010 PENDING, t0001 PAUSED", "", "t0009"),
        ("t9999 PENDING, t10000 PENDING", "", "t9999"),
        ("t0002 PAUSED, t0001 PAUSED, t0000 RUNNING", "", "t0001"),
        ("t0000 RUNNING", "", None),
        # Not those for which a process is being started: another's would be taken for it, and its own be ended.
        ("t0000 RUNNING, t0001 PENDING, t0002 PENDING", "t0001", "t0002"),
        ("t0000 PAUSED, t0001 PENDING", "t0001", None),
    ],
)
def test_a_trial_whose_process_is_being_started_is_not_chosen(statuses: str, starting: str, chosen: str | None) -> None:
    known = {name: getattr(Trial, status) for name, status in (one.split() for one in statuses.split(", "))}
    waiting = {name for name, status in known.items() if status == Trial.PENDING}
    controller: Any = _Controller(known, waiting, {starting})
    trial = TuneScheduler(EveryoneGoesOn()).choose_trial_to_run(controller)
    assert (None if trial is None else trial.config["trial_id"]) == chosen


def _experiment(folder: Path) -> Experiment:
    return Experiment(
        "run", TrialTrainable, config={"sweep_place": "somewhere", "run": "1 token"},
        resources_per_trial=PlacementGroupFactory([{"CPU": 2}, {"CPU": 1}]), storage_path=str(folder), max_failures=3,
        num_samples=2, trial_name_creator=trial_id_of, trial_dirname_creator=trial_id_of,
        checkpoint_config=CheckpointConfig(checkpoint_frequency=0, checkpoint_at_end=False),
    )  # fmt: skip


def test_trials_are_as_those_of_tunes_own_generator(tmp_path: Path) -> None:
    names, experiment = ["t0003", "t0004"], _experiment(tmp_path)
    ours = TrialsInOrder(names, 0)
    ours.add_configurations([experiment])
    experiment.spec["config"]["trial_id"] = None
    theirs = BasicVariantGenerator([{"trial_id": name} for name in names])
    theirs.add_configurations([experiment])
    for name in names:
        expected, found = vars(theirs.next_trial()), vars(ours.next_trial())
        assert found["config"] == {"sweep_place": "somewhere", "run": "1 token", "trial_id": name}
        assert expected.keys() == found.keys()
        different = {key for key in expected if not _same(expected[key], found[key])}
        assert different == {"trial_id"}


def _same(one: Any, other: Any) -> bool:
    if type(one) is not type(other) or one == other:
        return bool(one == other)
    parts, others = getattr(one, "__dict__", {}), getattr(other, "__dict__", {})
    return bool(parts) and parts.keys() == others.keys() and all(_same(parts[key], others[key]) for key in parts)


def _next(searcher: TrialsInOrder) -> Any:
    trial = searcher.next_trial()
    assert trial is not None
    return trial


def test_as_many_trials_as_may_be_are_known_at_once(tmp_path: Path) -> None:
    searcher = TrialsInOrder(["t0000", "t0001", "t0002"], 2)
    searcher.add_configurations([_experiment(tmp_path)])
    assert searcher.total_samples == 3
    first, second = _next(searcher), _next(searcher)
    assert searcher.next_trial() is None
    assert not searcher.is_finished()
    searcher.on_trial_complete(first.trial_id)
    third = _next(searcher)
    assert [trial_id_of(trial) for trial in (first, second, third)] == ["t0000", "t0001", "t0002"]
    assert len({trial.trial_id for trial in (first, second, third)}) == 3
    searcher.on_trial_complete(second.trial_id, error=True)
    assert searcher.next_trial() is None
    assert searcher.is_finished()
    assert searcher.total_samples == 3
