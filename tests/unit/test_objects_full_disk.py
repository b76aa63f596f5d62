"""A sweep in an object store while this machine's disk for its files is full: that disk is named, and nothing else."""

import errno
import os
import shutil
from collections.abc import Callable
from io import BufferedWriter
from pathlib import Path
from typing import IO, Any, NoReturn

import pytest
from fake_sweeps import RunCommand
from store_parts import fill, make_checkpoint, make_iteration, make_sweep, make_trial
from stores import ObjectHarness, object_harness  # noqa: F401 (a fixture)

from policies import files
from policies.errors import CannotRunError
from tune_jobs.store.contract import Sweep
from tune_jobs.store.objects import object_trial, parts, scratch

FULL = os.strerror(errno.ENOSPC)
OPEN = Path.open
Prepare = Callable[[Sweep, ObjectHarness], Callable[[], object]]


@pytest.fixture
def sweep(harness: ObjectHarness) -> Sweep:
    """A sweep with results and a report, opened anew by a reader."""
    made = harness.storage().sweep("mine")
    made.create()
    made.write_record(make_sweep(num_trials=1, spec={"seeds_per_point": 1}))
    made.trial("t0000").write_record(make_trial())
    made.trial("t0000").append_iterations([make_iteration(1)])
    with made.writing_report() as folder:
        (folder / "index.html").write_text("A page.")
    found = harness.storage().sweep("mine")
    # Its folders of this machine are made before the disk is full.
    assert (found.read_record().num_trials, found.trial("t0000").log_path.parent.is_dir()) == (1, True)
    return found


def no_space(*_: object, **__: object) -> NoReturn:
    # As of a file that was opened: the error names none.
    raise OSError(errno.ENOSPC, FULL)


def no_space_to_append(path: Path, mode: str = "r", *given: Any, **more: Any) -> IO[Any]:
    return no_space() if mode == "ab" else OPEN(path, mode, *given, **more)


def full_file(_: Path) -> BufferedWriter:
    return Path("/dev/full").open("ab")


def no_space_for_new_ones(path: Path, *_: object, **__: object) -> None:
    if not path.is_dir():
        no_space()


def more_results(sweep: Sweep, harness: ObjectHarness) -> Callable[[], object]:
    """A trial that has read its results, and is to read those that came since."""
    trial = sweep.trial("t0000")
    assert len(trial.read_results().records) == 1
    writer = harness.storage().sweep("mine").trial("t0000")
    writer.append_iterations([make_iteration(2)])
    writer.settle()
    return trial.read_results


def fetched_anew(sweep: Sweep, _: ObjectHarness) -> Callable[[], object]:
    (kept,) = sweep.report_files().values()
    kept.with_name(f".{kept.name}.tag").unlink()
    return sweep.report_files


def without_report(sweep: Sweep, _: ObjectHarness) -> Callable[[], object]:
    (kept,) = sweep.report_files().values()
    shutil.rmtree(kept.parent)
    return sweep.report_files


def films(sweep: Sweep, _: ObjectHarness) -> Callable[[], object]:
    def write() -> None:
        with sweep.writing_films():
            pytest.fail("There is no room for films.")

    return write


def copied(sweep: Sweep, harness: ObjectHarness) -> Callable[[], object]:
    writer = harness.storage().sweep("mine")
    other = writer.trial("t0001")
    other.write_checkpoint(make_checkpoint(4, trial_id="t0001"), fill)
    writer.trial("t0000").copy_checkpoint(other.checkpoint_folder(4), 7)
    return lambda: sweep.trial("t0000").copied_checkpoint(7)


def in_report(sweep: Sweep, _: ObjectHarness) -> Callable[[], object]:
    assert sweep.report_files()

    def write() -> None:
        with sweep.writing_report():
            pytest.fail("There is no room for a report.")

    return write


NO_FOLDER = (Path, "mkdir", no_space_for_new_ones)
# What fails, how, and what is done then.
FILLS: dict[str, tuple[tuple[object, str, Callable[..., object]], Prepare]] = {
    "a record": ((Path, "write_bytes", no_space), lambda sweep, _: sweep.read_record),
    "more results": ((Path, "open", no_space_to_append), more_results),
    "fetched results": ((files, "sync", no_space), lambda sweep, _: sweep.trial("t0000").read_results),
    "which object it is": ((Path, "write_text", no_space), fetched_anew),
    "a report": ((shutil, "copyfile", no_space), in_report),
    "a line of a log": (
        (object_trial, "open_to_append", full_file),
        lambda sweep, _: lambda: sweep.trial("t0000").write_log("a step"),
    ),
    "events": (
        (parts, "open_to_append", full_file),
        lambda sweep, _: lambda: sweep.trial("t0000").append_events("events", b"some"),
    ),
    "a copy": ((Path, "rename", no_space), copied),
    "films": (NO_FOLDER, films),
    "a pack's folder": (NO_FOLDER, lambda sweep, _: lambda: sweep.pack("p00").log_path),
    "a trial's folder": (NO_FOLDER, lambda sweep, _: lambda: sweep.trial("t0001").log_path),
    "a folder of results": (NO_FOLDER, lambda sweep, _: sweep.trial("t0001").read_results),
    "the report's folder": (NO_FOLDER, without_report),
}


@pytest.mark.parametrize("what", FILLS)
def test_what_does_not_fit_on_the_disk_is_told_with_the_folder_and_what_moves_it(
    sweep: Sweep, harness: ObjectHarness, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    failing, prepare = FILLS[what]
    act = prepare(sweep, harness)
    monkeypatch.setattr(*failing)
    with pytest.raises(CannotRunError) as caught:
        act()
    assert os.environ[scratch.VARIABLE] in caught.value.message
    assert FULL in caught.value.message
    assert "s3://" not in caught.value.message
    assert scratch.VARIABLE in caught.value.hint


def test_results_that_do_not_fit_are_not_said_to_be_the_stores(sweep: Sweep, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "write_bytes", no_space)
    with pytest.raises(CannotRunError) as caught:
        sweep.trial("t0000").read_results()
    assert os.environ[scratch.VARIABLE] in caught.value.message
    assert "s3://" not in caught.value.message


def test_a_command_says_that_the_disk_is_full_and_not_that_its_output_is(
    run: RunCommand, sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "write_bytes", no_space)
    told = run("status", sweep.place)
    assert told.exit_code == CannotRunError.exit_code, told.output
    assert f"cannot be written to {os.environ[scratch.VARIABLE]}: {FULL}" in told.stderr
    assert "output of this command" not in told.stderr


def test_a_tally_for_which_there_is_no_folder_is_forgotten_all_the_same(
    sweep: Sweep, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = sweep.trial("t0000").log_path.parent.with_name("t0001")
    monkeypatch.setattr(*NO_FOLDER)
    sweep.trial("t0001").forget_tally()
    assert not folder.exists()
