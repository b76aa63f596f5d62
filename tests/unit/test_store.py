"""The sweep folder: files are whole or not there, damage is found, and one process at a time drives a sweep."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from store_parts import make_iteration, make_sweep, make_trial

from analysis.best_records import BestRecord, EvaluationRecord
from analysis.records import FORMAT_VERSION, CheckpointRecord
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from tests.narrowing import present
from tune_jobs.store.local_storage import LocalStorage
from tune_jobs.store.manifests import read_manifest, verify_checkpoint
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    store = SweepStore(tmp_path / "storage" / "mine")
    store.create()
    return store


@pytest.fixture
def trial(store: SweepStore) -> TrialStore:
    return store.trial("t0000")


def write_checkpoint(
    trial: TrialStore, iteration: int = 3, files: dict[str, str] | None = None, **scores: float
) -> tuple[CheckpointRecord, Path]:
    record = CheckpointRecord(
        trial_id=trial.trial_id,
        iteration=iteration,
        num_env_steps=100 * iteration,
        **scores,
    )

    def write(folder: Path) -> None:
        for name, content in (
            {"policy.json": "{}", "policy.safetensors": ""} | (files or {"rllib/state.pkl": "abc"})
        ).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(content)

    trial.write_checkpoint(record, write)
    return record, trial.sweep_folder / record.path


# -- records


def test_records_come_back_as_they_were(store: SweepStore, trial: TrialStore) -> None:
    sweep = make_sweep(run_time_s=0.0, git_commit="abc")
    store.write_record(sweep)
    assert store.read_record() == sweep
    record = make_trial(
        status="failed", error="no\nroom", evaluation_return=0.0, checkpoints=(
            CheckpointRecord(trial_id="t0000", iteration=1, num_env_steps=2, evaluation_return=-1.0),
        ),
    )  # fmt: skip
    trial.write_record(record)
    assert trial.read_record() == record
    evaluation = EvaluationRecord(policy="p", env_id="E-v0", seeds=(1,), returns=(0.0,), lengths=(3,))
    best = BestRecord(
        checkpoint=record.checkpoints[0], point={}, seed=0, selection_score=-1.0, confirmation=evaluation,
        random=evaluation,
    )  # fmt: skip
    store.write_best(best)
    assert store.read_best() == best


def test_a_score_that_is_no_number_is_written_as_none(trial: TrialStore) -> None:
    trial.write_record(make_trial(evaluation_return=float("nan"), training_return=float("inf")))
    assert json.loads(trial.record_path.read_text())["evaluation_return"] is None
    assert trial.read_record().training_return is None


def test_trials_are_read_by_index(store: SweepStore) -> None:
    for index in (10, 2, 0):
        store.trial(f"t{index:04d}").write_record(make_trial(index))
    # A folder that a killed process had just made is no trial yet.
    store.trial("t0003").folder.mkdir()
    assert [record.index for record in store.read_trials()] == [0, 2, 10]
    assert SweepStore(store.folder.parent / "other").read_trials() == []


def test_what_is_not_there_is_not_found(store: SweepStore, trial: TrialStore, tmp_path: Path) -> None:
    for read in (store.read_record, trial.read_record, store.read_best):
        with pytest.raises(NotFoundError):
            read()
    assert not store.exists()
    assert trial.read_iterations() == []
    assert trial.checkpoints() == []
    assert trial.log_tail() == ""
    assert LocalStorage(tmp_path / "nowhere").sweeps() == []


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ('{"name": "mi', "cannot be read"),
        ("[]", "not a valid"),
        ('{"name": "mine"}', "not a valid"),
        (b"\xff\xfe\x00", "cannot be read"),
        (json.dumps({"format_version": FORMAT_VERSION + 1}), "Upgrade"),
    ],
)
def test_a_damaged_record_is_an_error_that_names_the_file(store: SweepStore, content: bytes | str, what: str) -> None:
    store.record_path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(CheckpointError, match=what) as raised:
        store.read_record()
    assert str(store.record_path) in raised.value.message
    assert raised.value.exit_code == 4


def test_what_a_newer_version_added_is_ignored(store: SweepStore) -> None:
    """Within a format version, fields may be added."""
    data = json.loads(make_sweep().model_dump_json()) | {"mood": "good"}
    store.record_path.write_text(json.dumps(data))
    assert store.read_record() == make_sweep()


def test_sweeps_are_listed_by_name(tmp_path: Path) -> None:
    for name in ("b", "a"):
        store = SweepStore(tmp_path / name)
        store.create()
        store.write_record(make_sweep(name=name))
    SweepStore(tmp_path / "half").create()
    (tmp_path / "file").write_text("")
    assert [store.name for store in LocalStorage(tmp_path).sweeps()] == ["a", "b"]


# -- results


def test_results_are_appended_and_replaced(trial: TrialStore) -> None:
    trial.keep_iterations([])
    trial.append_iterations([make_iteration(1), make_iteration(2, evaluation_return=0.0, learner={"lr": 1e-4})])
    trial.append_iterations([])
    trial.append_iterations([make_iteration(3, episode_returns=(1.5, -2.0), episode_lengths=(4, 5))])
    records = trial.read_iterations()
    assert [record.iteration for record in records] == [1, 2, 3]
    assert (records[1].evaluation_return, records[1].learner) == (0.0, {"lr": 1e-4})
    assert records[2].episode_returns == (1.5, -2.0)
    trial.keep_iterations(records[:2])
    assert trial.read_iterations() == records[:2]
    trial.append_iterations([make_iteration(3)])
    assert [record.iteration for record in trial.read_iterations()] == [1, 2, 3]


@pytest.mark.parametrize("torn", ['{"iteration": 2', '{"iteration": 2, "num_env_steps": 5}', ""])
def test_a_last_line_without_its_end_is_not_read(trial: TrialStore, torn: str) -> None:
    """Whole JSON or not: its newline was not written, so nothing says that it is complete."""
    trial.keep_iterations([make_iteration(1)])
    with trial.results_path.open("a") as file:
        file.write(torn)
    assert [record.iteration for record in trial.read_iterations()] == [1]


@pytest.mark.parametrize(
    "line",
    [
        b'{"iteration": "x"}',
        b'{"iteration": 2, "num_env_st{"iteration": 2, "num_env_steps": 5}',
        b"\xff\x00\xfe junk \x80",
        b"[1, 2]",
        b"null",
        b"",
        make_iteration(1).model_dump_json().encode(),
    ],
)
def test_a_damaged_line_within_is_left_out_with_a_warning_that_says_where(
    trial: TrialStore, caplog: pytest.LogCaptureFixture, line: bytes
) -> None:
    trial.keep_iterations([make_iteration(1)])
    with trial.results_path.open("ab") as file:
        file.write(line + b"\n")
    trial.append_iterations([make_iteration(3)])
    assert [record.iteration for record in trial.read_iterations()] == [1, 3]
    (warning,) = caplog.messages
    assert str(trial.results_path) in warning
    assert "line 2" in warning


# -- checkpoints


def test_a_checkpoint_has_a_manifest_of_every_file(trial: TrialStore) -> None:
    record, folder = write_checkpoint(trial, 3, evaluation_return=0.0)
    assert folder == trial.checkpoints_folder / "000003"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert set(manifest["files"]) == {"policy.json", "policy.safetensors", "rllib/state.pkl"}
    assert manifest["files"]["rllib/state.pkl"] == {
        "bytes": 3,
        "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
    }
    assert read_manifest(folder) == verify_checkpoint(folder) == record
    assert record.evaluation_return == 0.0
    assert trial.checkpoints() == [record]


def test_checkpoints_are_listed_oldest_first(trial: TrialStore) -> None:
    for iteration in (900, 1_000_001, 20):
        write_checkpoint(trial, iteration)
    assert [record.iteration for record in trial.checkpoints()] == [20, 900, 1_000_001]


def test_a_checkpoint_that_was_not_written_whole_is_not_there(trial: TrialStore) -> None:
    def fails(folder: Path) -> None:
        (folder / "half").write_text("x")
        raise OSError(28, "No space left on device")

    record, _ = write_checkpoint(trial, 3)
    with pytest.raises(OSError, match="No space"):
        trial.write_checkpoint(record.model_copy(update={"iteration": 4}), fails)
    assert [path.name for path in trial.checkpoints_folder.iterdir()] == ["000003"]
    # Nor where it would replace one.
    with pytest.raises(OSError, match="No space"):
        trial.write_checkpoint(record, fails)
    verify_checkpoint(trial.checkpoints_folder / "000003")


def test_while_a_checkpoint_is_written_readers_do_not_see_it(trial: TrialStore) -> None:
    seen = []
    record = CheckpointRecord(trial_id="t0000", iteration=1, num_env_steps=1)
    trial.write_checkpoint(record, lambda folder: seen.append((trial.checkpoints(), folder.is_dir())))
    assert seen == [([], True)]
    assert trial.checkpoints() == [record]


def test_a_checkpoint_written_anew_replaces_the_old_one(trial: TrialStore) -> None:
    write_checkpoint(trial, 3, {"old": "1"}, evaluation_return=1.0)
    record, folder = write_checkpoint(trial, 3, {"new": "2"}, evaluation_return=2.0)
    assert trial.checkpoints() == [record]
    assert {path.name for path in folder.iterdir()} == {"new", "policy.json", "policy.safetensors", "manifest.json"}
    assert len(list(trial.checkpoints_folder.iterdir())) == 1


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda path: path.write_text("abd"), "SHA-256"),
        (lambda path: path.write_text("abcd"), "SHA-256"),
        (lambda path: path.write_text(""), "SHA-256"),
        (lambda path: path.unlink(), "lacks the file"),
    ],
)
def test_a_changed_file_is_found(trial: TrialStore, damage: Callable[[Path], int | None], what: str) -> None:
    _, folder = write_checkpoint(trial)
    damage(folder / "rllib" / "state.pkl")
    with pytest.raises(CheckpointError, match=what) as raised:
        verify_checkpoint(folder)
    assert "rllib/state.pkl" in raised.value.message
    assert str(folder) in raised.value.message


def test_a_checkpoint_without_a_manifest_is_none(trial: TrialStore) -> None:
    _, folder = write_checkpoint(trial)
    (folder / "manifest.json").unlink()
    with pytest.raises(CheckpointError, match=r"no manifest\.json"):
        verify_checkpoint(folder)
    with pytest.raises(NotFoundError, match="No checkpoint folder"):
        verify_checkpoint(folder.with_name("000009"))


def test_deleted_checkpoints_and_leftovers_are_gone(trial: TrialStore) -> None:
    first, _ = write_checkpoint(trial, 1)
    second, _ = write_checkpoint(trial, 2)
    trial.delete_checkpoint(first)
    assert trial.checkpoints() == [second]
    (trial.checkpoints_folder / ".000003.77").mkdir()
    (trial.checkpoints_folder / ".000001.deleted").mkdir()
    trial.remove_leftovers()
    assert [path.name for path in trial.checkpoints_folder.iterdir()] == ["000002"]
    TrialStore(trial.sweep_folder, "t0009").remove_leftovers()


# -- logs


def test_the_end_of_a_log_is_its_last_lines(trial: TrialStore) -> None:
    trial.folder.mkdir(parents=True)
    trial.log_path.write_bytes(b"".join(b"line %d\n" % number for number in range(100_000)))
    assert trial.log_tail(2) == "line 99998\nline 99999"
    trial.log_path.write_bytes(b"caf\xe9 \xff\n")
    assert "caf" in trial.log_tail()


# -- the folder and its lock


def test_of_two_that_want_a_name_one_gets_it(store: SweepStore) -> None:
    with pytest.raises(SpecError, match="already"):
        SweepStore(store.folder).create()


def test_a_storage_folder_that_cannot_be_written_is_an_error_and_nothing_is_left(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    store = SweepStore(tmp_path / "file" / "mine")
    with pytest.raises(CannotRunError, match="cannot be written") as raised:
        store.create()
    assert "--storage" in raised.value.hint
    assert raised.value.exit_code == 5


def test_a_discarded_sweep_leaves_only_what_was_there_before(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    store = SweepStore(tmp_path / "old" / "new" / "newer" / "mine")
    store.create()
    store.write_record(make_sweep())
    store.discard()
    assert [path.name for path in tmp_path.rglob("*")] == ["old"]


def test_a_relative_folder_is_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trap: Ray answers "URI has empty scheme" to a relative one."""
    monkeypatch.chdir(tmp_path)
    from pathlib import Path

    assert SweepStore(Path("sweeps/mine")).folder == tmp_path / "sweeps" / "mine"


def test_a_stop_is_asked_for_and_forgotten(store: SweepStore) -> None:
    assert not store.stop_requested()
    store.clear_stop_request()
    store.request_stop()
    store.request_stop()
    assert store.stop_requested()
    store.clear_stop_request()
    assert not store.stop_requested()


HOLDER = """
import sys
from pathlib import Path
from tune_jobs.store.sweep_store import SweepStore
with SweepStore(Path(sys.argv[1])).lock():
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_process_at_a_time_drives_a_sweep_and_a_killed_one_no_longer_does(store: SweepStore) -> None:
    assert not store.is_driven()
    arguments = [sys.executable, "-c", HOLDER, str(store.folder)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert present(process.stdout).readline() == "held\n"
        assert store.is_driven()
        with pytest.raises(CannotRunError, match="another process") as raised, store.lock():
            pass
        assert f"tune-jobs status {store.folder}" in raised.value.hint
        os.kill(process.pid, 9)
        process.wait()
    assert not store.is_driven()
    with store.lock():
        assert store.is_driven()
    # Looking does not take it.
    with store.lock():
        pass
