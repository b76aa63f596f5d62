"""Whole runs in packs, with scripted members: who trains where, who is ended, and what becomes of a dead pack's."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import ray
from scripted_packs import STEPS, make_sweep, run_packs
from test_schedulers import MIXED

from analysis.records import TrialRecord
from tests.narrowing import present
from tune_jobs.ray_tune.early_stopping import build_scheduler
from tune_jobs.ray_tune.scheduling import Decision, NobodyWaits, Standing
from tune_jobs.spec.scheduler import SchedulerSpec
from tune_jobs.store.pack_files import PackFiles
from tune_jobs.store.sweep_store import SweepStore

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

ASHA = {"type": "asha", "grace_env_steps": 200, "reduction_factor": 2}


def assert_whole(store: SweepStore, record: TrialRecord, num_iterations: int = 10) -> None:
    """Every iteration once, and what the record says is on disk."""
    assert [one.iteration for one in store.trial(record.trial_id).read_iterations()] == list(
        range(1, num_iterations + 1)
    )
    assert record.num_iterations == num_iterations
    assert list(record.checkpoints) == store.trial(record.trial_id).checkpoints()


def test_trials_are_spread_over_packs_and_take_the_slots_that_become_free(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 9)
    seen: list[TrialRecord] = []
    records = run_packs(store, listener=seen.append, slots=2, pause_s=0.02)
    for record in records:
        assert (record.status, record.stop_reason) == ("completed", "num_env_steps 1000 >= 1000")
        assert (record.num_failures, record.error) == (0, None)
        assert present(record.started_at) < present(record.ended_at)
        assert_whole(store, record)
        assert "built from seed" in store.trial(record.trial_id).log_path.read_text()
        assert list((store.trial(record.trial_id).folder / "tensorboard").glob("events.*"))
    # Two processes, and never more than two trials at once in each.
    running: set[str] = set()
    most = 0
    for record in seen:
        (running.add if record.status == "running" else running.discard)(record.trial_id)
        most = max(most, len(running))
    assert most <= 4
    by_process: dict[int | None, list[str]] = {}
    for record in records:
        by_process.setdefault(record.pid, []).append(record.trial_id)
    assert len(by_process) == 2
    assert {"t0000", "t0001"} <= set(by_process[records[0].pid])
    assert {"t0002", "t0003"} <= set(by_process[records[2].pid])
    assert store.read_trials() == records


def test_fewer_trials_than_slots_are_spread_evenly(tmp_path: Path) -> None:
    records = run_packs(make_sweep(tmp_path / "mine", 5), slots=64)
    pids = [record.pid for record in records]
    assert pids[0] == pids[1] == pids[2] != pids[3] == pids[4]


def test_packs_that_never_get_a_node_do_not_hold_up_the_end(tmp_path: Path) -> None:
    store, all_cpus = make_sweep(tmp_path / "mine", 3), ray.cluster_resources()["CPU"]
    asked: list[int] = []

    def listen(_: TrialRecord) -> None:
        groups = ray.util.placement_group_table().values()
        asked.append(sum(group["state"] == "PENDING" for group in groups))

    records = run_packs(
        store, num_packs=1, slots=1, cpus_per_pack=all_cpus, more_packs=9, listener=listen, pause_s=0.2
    )  # fmt: skip
    assert [(record.status, record.num_failures) for record in records] == [("completed", 0)] * 3
    assert len({record.pid for record in records}) == 1
    # A pack each for the two that wait; and none once the last one has begun.
    assert max(asked) == 2
    assert asked[-1] == 0


def test_trials_that_are_not_packed_run_too(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 3, stop={"num_iterations": 1}, hyperparams={"hidden_sizes": [4]})
    records = run_packs(store, trial_ids=("t0000", "t0002"))
    assert [record.status for record in records] == ["completed"] * 3
    # RLlib's are the iterations of a batch.
    assert [record.num_env_steps == STEPS for record in records] == [True, False, True]


# -- schedulers


def expected_steps(scores: Sequence[float], scheduler: SchedulerSpec, max_env_steps: int, *, slots: int) -> list[int]:
    """Env steps each trial comes to, by the scheduler itself: one pack, its members in lockstep, evaluated each 200."""
    judge = build_scheduler(scheduler, max_env_steps)
    waiting = {str(index): score for index, score in enumerate(scores)}
    steps: dict[str, int] = {}
    members: dict[str, float] = {}
    while waiting or members:
        while waiting and len(members) < slots:
            name = next(iter(waiting))
            members[name] = waiting.pop(name)
            judge.begins(name)
        for name, score in list(members.items()):
            steps[name] = steps.get(name, 0) + 200
            standing = Standing(name, steps[name], score, evaluated=True)
            over = steps[name] >= max_env_steps
            if over or judge.reached(standing, NobodyWaits()) is Decision.STOP:
                judge.ended(standing)
                del members[name]
    return [steps[str(index)] for index in range(len(scores))]


def run_scheduled(
    folder: Path, scores: Sequence[float], scheduler: dict[str, Any], **kwargs: Any
) -> tuple[SweepStore, list[TrialRecord]]:
    store = make_sweep(folder, len(scores), scheduler=scheduler, stop={"num_env_steps": 1600})
    scripts = {f"t{index:04d}": {"score": score} for index, score in enumerate(scores)}
    return store, run_packs(store, scripts, **kwargs)


def test_asha_decides_as_with_single_trials(tmp_path: Path) -> None:
    store, records = run_scheduled(tmp_path / "mine", MIXED, ASHA, num_packs=1, slots=1)
    # As in test_schedulers.
    assert [record.num_env_steps for record in records] == [1600, 1600, 200, 1600, 200, 400, 200, 400]
    for record in records:
        assert_whole(store, record, record.num_env_steps // STEPS)
        if record.num_env_steps == 1600:
            assert record.status == "completed"
        else:
            assert (record.status, record.stop_reason) == ("stopped", f"scheduler, at {record.num_env_steps} env steps")
            assert record.ended_at is not None
            # It may still be the best.
            assert record.checkpoints[-1].iteration == record.num_iterations


@pytest.mark.parametrize("kind", ["asha", "median"])
def test_a_scheduler_ends_members_inside_a_pack_before_their_next_iteration(tmp_path: Path, kind: str) -> None:
    scheduler = {**ASHA, "type": kind}
    scores = (*MIXED, None, 9.0, 0.5, 3.5)
    told = [float("nan") if score is None else score for score in scores]
    store, records = run_scheduled(tmp_path / "mine", told, scheduler, num_packs=1, slots=4)
    expected = expected_steps(
        [-1e300 if score is None else score for score in scores], SchedulerSpec(**scheduler), 1600, slots=4
    )
    assert [record.num_env_steps for record in records] == expected
    assert {200, 1600} <= set(expected)
    for record in records:
        assert_whole(store, record, record.num_env_steps // STEPS)


def test_asha_compares_members_of_all_packs(tmp_path: Path) -> None:
    # Within its own pack no member is worse than another. The second begins when the first has ended.
    store = make_sweep(tmp_path / "mine", 4, scheduler=ASHA, stop={"num_env_steps": 1600})
    scripts: dict[str, dict[str, Any]] = {
        f"t000{index}": {"score": score} for index, score in enumerate((5.0, 5.0, 1.0, 1.0))
    }
    scripts["t0003"]["after"] = "trials/t0000/checkpoints/000016"
    records = run_packs(store, scripts)
    assert [record.num_env_steps for record in records] == [1600, 1600, 200, 200]
    assert records[0].pid == records[1].pid != records[2].pid == records[3].pid


# -- failures


def test_a_member_that_always_fails_fails_alone(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 4, max_retries=1)
    records = run_packs(store, {"t0001": {"raise_at": 5}}, slots=4, num_packs=1)
    assert [record.status for record in records] == ["completed", "failed", "completed", "completed"]
    assert [record.num_failures for record in records] == [0, 2, 0, 0]
    assert present(records[1].error).startswith("ZeroDivisionError: the cart left the track")
    assert records[1].ended_at is not None
    assert len({record.pid for record in records}) == 1
    for record in records:
        if record.status == "completed":
            assert_whole(store, record)


def test_the_members_of_a_pack_that_is_killed_go_on_from_their_checkpoints(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 4, max_retries=0)
    seen: list[TrialRecord] = []
    records = run_packs(store, {"t0001": {"kill_at": 5}}, num_packs=1, slots=3, listener=seen.append)
    assert [record.status for record in records] == ["completed"] * 4
    # The fourth had not begun.
    assert [record.num_failures for record in records] == [1, 1, 1, 0]
    errors = {record.trial_id: record.error for record in seen if record.error}
    assert set(errors) == {"t0000", "t0001", "t0002"}
    assert errors["t0000"].startswith("The process of the pack died.")
    # As many as it had made, though the last report may be older.
    assert {record.num_env_steps for record in seen if record.error} == {4 * STEPS}
    # The end of the pack's log.
    assert "about to die" in errors["t0000"]
    for record in records:
        assert_whole(store, record)
        assert record.error is None
        log = store.trial(record.trial_id).log_path.read_text()
        assert ("built from checkpoint 000004" in log) == (record.trial_id != "t0003")


def test_a_pack_that_hangs_is_ended_and_started_again(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 3, iteration_timeout_s=20)
    seen: list[TrialRecord] = []
    records = run_packs(store, {"t0001": {"hang_at": 5}}, num_packs=1, slots=3, listener=seen.append)
    assert [(record.status, record.num_failures) for record in records] == [("completed", 1)] * 3
    errors = {record.trial_id: record.error for record in seen if record.error}
    first, *lines = errors["t0002"].splitlines()
    assert set(errors.values()) == {errors["t0002"]}
    assert "died: an iteration took longer than iteration_timeout_s (20 s). It hung at " in first
    assert first.endswith(" in train_iteration.")
    # The frames of the thread that hung, and no other's.
    assert lines[0].startswith("Timeout (")
    assert "in train_iteration" in lines[2]
    assert sum("Thread 0x" in line for line in lines) == 1
    for record in records:
        assert_whole(store, record)


def test_members_of_a_pack_that_dies_again_go_on_alone(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 5, max_retries=1)
    # It kills two packs, and fails twice by itself: the others finish.
    scripts = {"t0001": {"kill_at": 5, "kills": 99}}
    records = run_packs(store, scripts, num_packs=2, slots=3)
    assert [record.status for record in records] == ["completed", "failed", "completed", "completed", "completed"]
    assert [record.num_failures for record in records] == [2, 4, 2, 0, 0]
    assert present(records[1].error).startswith("The process of the pack died.")
    for record in records:
        if record.status == "completed":
            assert_whole(store, record)
    assert int((store.folder / "t0001.kills").read_text()) == 4
    # Nobody else is given to a pack in which somebody is alone.
    assert PackFiles(store.folder, "p00").read().trial_ids == ()


# -- interrupted


def stop_when(store: SweepStore, condition: Callable[[], object]) -> threading.Thread:
    def wait() -> None:
        deadline = time.monotonic() + 600
        while not condition() and time.monotonic() < deadline:
            time.sleep(0.02)
        store.request_stop()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def test_a_stopped_run_pauses_all_and_goes_on_where_it_was(tmp_path: Path) -> None:
    store = make_sweep(tmp_path / "mine", 7, stop={"num_env_steps": 100_000})
    # Both packs begin when their processes are up, one perhaps long before the other.
    first = [store.trial(f"t{index:04d}") for index in range(4)]
    thread = stop_when(store, lambda: all(trial.checkpoint_iterations() for trial in first))
    records = run_packs(store, slots=2, pause_s=0.02)
    thread.join()
    assert [record.status for record in records] == ["paused"] * 4 + ["pending"] * 3
    for record in records[:4]:
        assert record.checkpoints[-1].iteration == record.num_iterations > 0
        assert_whole(store, record, record.num_iterations)
    store.clear_stop_request()
    sweep = store.read_record()
    goal = max(record.num_iterations for record in records) + 2
    sweep.spec["stop"]["num_iterations"] = goal
    store.write_record(sweep)
    resumed = run_packs(store, slots=2)
    assert [record.status for record in resumed] == ["completed"] * 7
    for before, record in zip(records, resumed, strict=True):
        assert_whole(store, record, goal)
        if before.num_iterations:
            log = store.trial(record.trial_id).log_path.read_text()
            assert f"built from checkpoint {before.num_iterations:06d}" in log


# -- points chosen when a trial is handed out


def test_points_are_chosen_when_trials_are_handed_to_packs(tmp_path: Path) -> None:
    pytest.importorskip("optuna")
    store = make_sweep(tmp_path / "mine", 8, search={"type": "tpe", "num_startup_trials": 2})
    for record in store.read_trials():
        store.trial(record.trial_id).write_record(record.model_copy(update={"has_point": False}))
    # Where all are equally good, points are random.
    records = run_packs(store, {f"t{index:04d}": {"score": 10.0 + index} for index in range(8)}, slots=2)
    assert [record.status for record in records] == ["completed"] * 8
    assert all(record.has_point and record.hyperparams["lr"] == record.point["lr"] for record in records)
    from tune_jobs.spec.draws import draw_point
    from tune_jobs.spec.sweep_spec import SweepSpec

    spec = SweepSpec.model_validate(store.read_record().spec)
    random = [draw_point(spec.space, index, spec.seed) for index in range(8)]
    # Four are handed out before any has ended; the others know those.
    assert [record.point for record in records[:4]] == random[:4]
    assert all(record.point != point for record, point in zip(records[4:], random[4:], strict=True))
