"""What Ray Tune is told of a trial that another process has, or whose paused checkpoint is damaged."""

import json
import pickle
import types
from pathlib import Path

import pytest
from ray.exceptions import RayTaskError
from scripted_packs import make_sweep

from policies.errors import CannotRunError, CheckpointError
from tune_jobs.ray_tune.failures import going_on
from tune_jobs.ray_tune.lost_nodes import NodeLosses
from tune_jobs.ray_tune.processes import RayWatch
from tune_jobs.ray_tune.run_trials import RunJob, run_trials
from tune_jobs.ray_tune.trainable import TrialTrainable, watchdog
from tune_jobs.ray_tune.tune_events import TrialEvents
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.record_keeper import RecordKeeper

pytestmark = pytest.mark.ray


def tune_trial(trial_id: str) -> types.SimpleNamespace:
    """As Tune shows its callbacks one."""
    return types.SimpleNamespace(config={"trial_id": trial_id}, trial_id=trial_id)


@pytest.mark.parametrize("timeout_s", [1e9, 1e10, 1e300])
def test_a_limit_of_any_size_can_be_watched(tmp_path: Path, timeout_s: float) -> None:
    with (tmp_path / "log").open("wb") as file, watchdog(timeout_s, file):
        pass


@pytest.mark.parametrize("event", ["on_trial_recover", "on_trial_error"])
def test_a_trial_that_another_process_has_is_not_counted_as_failed(tmp_path: Path, event: str) -> None:
    store = make_sweep(tmp_path / "mine", 2)
    keeper = RecordKeeper(store, ["t0000", "t0001"], lambda record: None)
    # Of a Ray that lives: no part of it is silent.
    losses = NodeLosses(lambda trial: 0, lambda error: None)
    events = TrialEvents(store, keeper, 600.0, RayWatch({}, grace_s=1.0), losses)
    for trial_id, cause in (("t0000", OwnershipLostError("taken")), ("t0001", ValueError("broke"))):
        keeper.started(trial_id)
        losses._errors[trial_id] = RayTaskError("step", "a traceback", cause)
        getattr(events, event)(0, [], tune_trial(trial_id))
    assert (keeper.record("t0000").status, keeper.record("t0000").num_failures) == ("paused", 0)
    assert keeper.record("t0000").error is None
    assert keeper.record("t0001").num_failures == 1


@pytest.mark.parametrize("is_stopped", [False, True])
def test_a_scheduler_may_end_a_trial_that_was_to_be_tried_again(tmp_path: Path, is_stopped: bool) -> None:
    store = make_sweep(tmp_path / "mine", 1)
    keeper = RecordKeeper(store, ["t0000"], lambda record: None)
    losses = NodeLosses(lambda trial: 0, lambda error: None)
    events = TrialEvents(store, keeper, 600.0, RayWatch({}, grace_s=1.0), losses)
    keeper.started("t0000")
    keeper.failed("t0000", "it broke", retried=True)
    if is_stopped:
        store.request_stop()
    events.on_trial_complete(0, [], tune_trial("t0000"))
    assert keeper.record("t0000").status == ("pending" if is_stopped else "stopped")


def test_a_driver_of_a_run_that_is_over_touches_nothing(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 1)
    run = store.take()
    store.take()
    store.tune_folder.mkdir()

    def everything() -> dict[Path, bytes | None]:
        return {path: path.read_bytes() if path.is_file() else None for path in store.folder.rglob("*")}

    before = everything()
    with pytest.raises(OwnershipLostError):
        run_trials(RunJob(store.place, ("t0000",), 1.0, 0.0, 1, run=run.token), lambda record: None)
    assert everything() == before


@pytest.mark.parametrize(("damaged", "fits"), [((), False), (("000004",), False), (("000006",), True)])
def test_a_pause_at_a_checkpoint_that_was_set_aside_is_gone_on_from(
    tmp_path: Path, damaged: tuple[str, ...], fits: bool
) -> None:
    store = make_sweep(tmp_path / "mine", 1)
    pointer = tmp_path / "pointer.json"
    pointer.write_text(json.dumps({"trial_id": "t0000", "iteration": 6}))
    for name in damaged:
        (store.trial("t0000").folder / "damaged" / name).mkdir(parents=True)
    trainable = TrialTrainable.__new__(TrialTrainable)
    trainable._trial = (store.place, "t0000")
    if fits:
        trainable.load_checkpoint(str(tmp_path))
    else:
        # Gone for no known reason: it must not begin anew in silence.
        with pytest.raises(CheckpointError, match="was paused at iteration 6"):
            trainable.load_checkpoint(str(tmp_path))


def test_a_pause_goes_from_node_to_node_without_a_folder_of_tunes(tmp_path: Path) -> None:
    """Tune's is one of the driver's machine, where the sweep is in an object store."""
    store = make_sweep(tmp_path / "mine", 1)
    here, there = TrialTrainable.__new__(TrialTrainable), TrialTrainable.__new__(TrialTrainable)
    for trainable in (here, there):
        trainable._trial, trainable._refusal, trainable._loop = (store.place, "t0000"), None, None
        trainable._local_ip = "127.0.0.1"
    # It has no method: nothing is carried by it.
    here._storage, here._last_result = object(), {"training_iteration": 4}
    saved = here.save()
    assert saved.checkpoint
    there.restore(pickle.loads(pickle.dumps(saved)))
    assert there.iteration == 4
    saved.metrics["pointer.json"] = json.dumps({"trial_id": "t0000", "iteration": 6})
    with pytest.raises(CheckpointError, match="was paused at iteration 6"):
        there.restore(saved)


def test_a_run_that_can_write_no_more_says_how_to_go_on() -> None:
    error = going_on(
        CannotRunError("Cannot write trial.json: No space left on device.", "Free some."), "tune-jobs resume x"
    )
    assert error.hint == "Free some. What is done is kept; continue with `tune-jobs resume x`."
    assert error.message == "Cannot write trial.json: No space left on device."
