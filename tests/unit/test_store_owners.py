"""What every store promises of who writes, of packs, logs and stops, and of what comes of a sweep."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from policy_factory import make_portable
from store_parts import BEST, ON_DISK, PACK, Reopen, fill, killed, make_best, make_checkpoint, make_iteration, numbers
from stores import Harness

from policies.acting.load import load_policy
from policies.errors import CannotRunError, CheckpointError, NotFoundError
from policies.files import open_to_append
from tests.narrowing import present
from tune_jobs.store.contract import Assignment, Sweep, Trial
from tune_jobs.store.opening import answer
from tune_jobs.store.ownership import OwnershipLostError

# -- who writes: locks, and owners by epoch


def test_one_process_at_a_time_drives_a_sweep(sweep: Sweep, another: Reopen) -> None:
    assert not sweep.is_driven()
    with sweep.lock():
        assert another().is_driven()
        with pytest.raises(CannotRunError, match="another process"), another().lock():
            pass
    assert not another().is_driven()
    with another().driver_lock():
        assert sweep.is_driven()
        for held in (sweep.lock, sweep.driver_lock):
            with pytest.raises(CannotRunError, match="A cluster still runs"), held():
                pass
    with sweep.lock(), another().driver_lock():
        pass


@ON_DISK
def test_a_killed_driver_holds_no_lock(sweep: Sweep, another: Reopen) -> None:
    def act(die: Callable[..., None]) -> None:
        with another().lock():
            die()

    killed(act)
    assert not sweep.is_driven()
    with sweep.lock():
        pass


def test_who_was_run_before_has_lost_it(sweep: Sweep, another: Reopen) -> None:
    first = sweep.take()
    with first.held():
        pass
    second = another().take()
    assert (first.is_current(), second.is_current()) == (False, True)
    for write in (first.check, first.held().__enter__):
        with pytest.raises(OwnershipLostError):
            write()
    passed_on = another().owner(second.token)
    passed_on.check()
    second.release()
    for owner in (second, passed_on):
        with owner.held():
            pass
    assert not another().owner("").is_current()
    assert not another().owner(first.token).is_current()


def test_who_lost_a_trial_writes_nothing_of_it(harness: Harness, trial: Trial, another: Reopen) -> None:
    trial.take()
    trial.append_iterations([make_iteration(1)])
    trial.write_checkpoint(make_checkpoint(1), fill)
    assert not trial.is_lost()
    another().trial("t0000").take()
    assert trial.is_lost()
    before = {key: harness.content("mine", key) for key in harness.keys("mine")}
    for write in (
        lambda: trial.append_iterations([make_iteration(2)]),
        lambda: trial.keep_iterations([]),
        lambda: trial.write_checkpoint(make_checkpoint(2), fill),
        lambda: trial.write_checkpoint(make_checkpoint(1), lambda folder: fill(folder, "other")),
        lambda: trial.delete_checkpoint(make_checkpoint(1)),
        lambda: trial.set_aside(trial.checkpoint_folder(1)),
        trial.set_aside_results,
        lambda: trial.keep_damaged_results([b"x"]),
        trial.remove_copies,
        trial.forget_tally,
        trial.owned().__enter__,
    ):
        with pytest.raises(OwnershipLostError):
            write()
    assert {key: harness.content("mine", key) for key in harness.keys("mine")} == before


@pytest.mark.parametrize("saves", [False, True])
def test_who_lost_a_trial_and_does_not_know_it_removes_no_copy(trial: Trial, another: Reopen, saves: bool) -> None:
    other, reader, kept = another().trial("t0001"), another().trial("t0000"), list[bool]()
    trial.take()
    another().trial("t0000").take()
    other.write_checkpoint(make_checkpoint(4, trial_id="t0001"), fill)
    another().trial("t0000").copy_checkpoint(other.checkpoint_folder(4), 7)

    def remove_and_wait() -> None:
        if saves:
            trial.write_checkpoint(make_checkpoint(9), fill)
        trial.remove_copies()
        kept.append(reader.copied_checkpoint(7).exists())
        # Here at the latest.
        trial.settle()

    with pytest.raises(OwnershipLostError):
        remove_and_wait()
    assert all(kept)
    assert another().trial("t0000").copied_checkpoint(7).exists()


def test_a_trial_that_is_lost_while_its_checkpoint_is_written_gets_none(trial: Trial, another: Reopen) -> None:
    trial.take()

    def write(folder: Path) -> None:
        fill(folder)
        another().trial("t0000").take()

    def write_and_wait() -> None:
        trial.write_checkpoint(make_checkpoint(1), write)
        # Here at the latest.
        trial.settle()

    with pytest.raises(OwnershipLostError):
        write_and_wait()
    assert numbers(another) == []


def test_a_trial_and_a_pack_are_taken_only_for_who_owns_the_run(sweep: Sweep, trial: Trial, another: Reopen) -> None:
    run = sweep.take()
    pack = sweep.pack("p00").take(run)
    trial.take(pack)
    second = another().take()
    for take in (another().trial("t0000").take, another().pack("p00").take):
        with pytest.raises(OwnershipLostError):
            take(run)
    assert not trial.is_lost()
    assert pack.is_current()
    another().pack("p00").take(second)
    with pytest.raises(OwnershipLostError):
        another().trial("t0000").take(pack)
    assert not trial.is_lost()


def test_who_has_not_taken_a_trial_is_kept_from_nothing(trial: Trial, another: Reopen) -> None:
    """A reader, or a tool that works on a sweep that nobody runs."""
    trial.take()
    reader = another().trial("t0000")
    with reader.owned():
        pass
    assert not reader.is_lost()


# -- packs


def test_an_assignment_comes_back_as_it_was_written(sweep: Sweep, another: Reopen) -> None:
    for assignment in (Assignment(("t0002", "t0000"), {"t0000": 2}), Assignment()):
        sweep.pack("p00").write(assignment)
        assert another().pack("p00").read() == assignment


@pytest.mark.parametrize("content", [None, b"", b"{}", b'{"trial_ids": ["../x"], "num_failures": {}}', b"\xff"])
def test_an_assignment_that_cannot_be_read_is_an_error_that_names_it(
    harness: Harness, sweep: Sweep, content: bytes | None
) -> None:
    if content is not None:
        harness.put("mine", PACK, content)
    with pytest.raises(CheckpointError, match="p00"):
        sweep.pack("p00").read()


# -- logs and tallies


def test_a_log_is_appended_to_and_its_end_is_told(
    sweep: Sweep, trial: Trial, another: Reopen, capfd: pytest.CaptureFixture[str]
) -> None:
    pack = sweep.pack("p00")
    assert trial.log_tail() == pack.log_tail() == ""
    for log in (trial, pack):
        with open_to_append(log.log_path) as file:
            file.write(b"".join(b"line %d\n" % number for number in range(30)))
    trial.write_log("it \udcff ended")
    assert another().pack("p00").log_tail(2) == "line 28\nline 29"
    *_, before, last = another().trial("t0000").log_tail().splitlines()
    assert before == "line 29"
    assert last.endswith(f"process {os.getpid()}: it \\udcff ended")
    pack.begin_log()
    assert str(os.getpid()) in capfd.readouterr().out


def test_a_tally_is_forgotten_whether_there_is_one_or_not(trial: Trial) -> None:
    trial.take()
    trial.tally_path.write_bytes(b"")
    trial.forget_tally()
    trial.forget_tally()
    assert not trial.tally_path.exists()


# -- requests to stop


def test_a_stop_is_asked_for_and_forgotten(sweep: Sweep, another: Reopen) -> None:
    assert not sweep.stop_requested()
    sweep.clear_stop_request()
    another().request_stop()
    another().request_stop()
    assert sweep.stop_requested()
    sweep.clear_stop_request()
    assert not another().stop_requested()


# -- what comes of it


def test_the_best_is_read_with_its_policy(sweep: Sweep, another: Reopen) -> None:
    policy = make_portable("CartPole-v1", seed=3)
    sweep.write_best(make_best(), policy)
    assert another().has_best()
    assert load_policy(another().best_folder).env_id == load_policy(another().best_policy_path).env_id == "CartPole-v1"
    sweep.write_best(make_best(seed=4))
    assert another().read_best().seed == 4
    assert load_policy(another().best_folder).env_id == "CartPole-v1"


def test_a_policy_that_cannot_be_written_leaves_the_best_that_was_there(
    sweep: Sweep, another: Reopen, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep.write_best(make_best(), make_portable("CartPole-v1"))

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        with pytest.raises(CannotRunError, match="No space"):
            sweep.write_best(make_best(seed=4), make_portable("Acrobot-v1"))
    assert another().read_best() == make_best()
    assert load_policy(another().best_folder).env_id == "CartPole-v1"


def test_an_edited_best_is_refused(harness: Harness, sweep: Sweep) -> None:
    sweep.write_best(make_best())
    data = json.loads(harness.content("mine", BEST)) | {"selection_score": 99.0}
    harness.put("mine", BEST, json.dumps(data).encode())
    with pytest.raises(CheckpointError, match="SHA-256"):
        sweep.read_best()


def test_films_are_those_that_were_written(sweep: Sweep, another: Reopen) -> None:
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    with sweep.writing_films() as paths:
        assert set(paths) == {"before_mp4", "after_mp4", "after_gif", "before_after_mp4"}
        paths["after_mp4"].write_bytes(b"film")
    films = another().films()
    assert {name: path.read_bytes() for name, path in films.items()} == {"after_mp4": b"film"}


def test_films_of_another_winner_are_not_its_own(harness: Harness, sweep: Sweep, another: Reopen) -> None:
    first, second = make_best(), make_best()
    second = second.model_copy(update={"checkpoint": second.checkpoint.model_copy(update={"iteration": 7})})
    with pytest.raises(NotFoundError), sweep.writing_films():
        pass
    sweep.write_best(first, make_portable("CartPole-v1"))
    with sweep.writing_films() as paths:
        for path in paths.values():
            path.write_bytes(b"film")
    sweep.write_best(second)
    assert another().films() == {}
    # It is confirmed again, or its settings are judged anew: it is the same policy.
    sweep.write_best(first.model_copy(update={"selection_score": 3.0}))
    assert set(another().current_films()) == set(paths)
    # Somebody was ended while the other one was filmed.
    sweep.write_best(second)
    with contextlib.suppress(InterruptedError), sweep.writing_films() as paths:
        paths["after_mp4"].write_bytes(b"film of another")
        raise InterruptedError
    sweep.write_best(first)
    assert another().films() == {}
    harness.put("mine", "best/films.json", b"{}")
    assert another().films() == {}


def test_a_report_is_written_over_the_one_before(harness: Harness, sweep: Sweep) -> None:
    for text in (b"one", b"two"):
        with sweep.writing_report() as folder:
            folder.mkdir(exist_ok=True)
            (folder / "index.html").write_bytes(text)
        assert harness.content("mine", "report/index.html") == text


def test_films_and_report_are_current_once_all_are_there(sweep: Sweep, another: Reopen) -> None:
    assert another().current_films() == {}
    assert another().current_report() is None
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    with sweep.writing_films() as paths:
        *most, last = paths.values()
        for path in most:
            path.write_bytes(b"film")
        assert another().current_films() == {}
        last.write_bytes(b"film")
    assert set(another().current_films()) == set(paths)
    with sweep.writing_report() as folder:
        folder.mkdir(exist_ok=True)
        assert another().current_report() is None
        (folder / "index.html").write_bytes(b"page")
    assert present(another().current_report()).read_bytes() == b"page"


def test_events_are_appended(harness: Harness, trial: Trial) -> None:
    for data in (b"one", b"two"):
        trial.append_events("events.1", data)
    assert harness.content("mine", "trials/t0000/tensorboard/events.1") == b"onetwo"


# -- of machines


def test_who_sees_the_same_sweep_can_answer(harness: Harness, sweep: Sweep) -> None:
    before = harness.keys("mine")
    with sweep.probing() as probe:
        assert not probe.is_same("", "node")
        question = answer(probe.place, "node")
        assert probe.is_same(question, "node")
        assert not probe.is_same(question, "other")
        assert not probe.is_same(f"{question}x", "node")
    assert not probe.is_same(question, "node")
    assert harness.keys("mine") == before


def test_ray_tunes_state_is_begun_anew_and_the_driver_prints_to_a_file(sweep: Sweep, another: Reopen) -> None:
    sweep.clear_tune_folder()
    sweep.tune_folder.mkdir(parents=True)
    (sweep.tune_folder / "state.json").touch()
    another().clear_tune_folder()
    assert not sweep.tune_folder.exists()
    with sweep.driver_log.open("ab") as file:
        file.write(b"said")
    assert another().driver_log.read_bytes() == b"said"
