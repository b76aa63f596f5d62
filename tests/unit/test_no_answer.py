"""A storage that gives no answer never counts as one where nothing is: no work is lost, and no damage hidden."""

import errno
from collections.abc import Callable
from pathlib import Path

import pytest
from broken_storage import LISTING, Fail, fail, pathlib_of  # noqa: F401 (fixtures)
from fake_engine import FakeEngine
from sweep_folders import make_sweep_folder
from trial_runs import Trial

from analysis.records import ChangeRecord
from policies.errors import CannotRunError, CheckpointError
from tune_jobs.store.candidates import candidates, readable_trials
from tune_jobs.store.manifests import verify_checkpoint, write_manifest
from tune_jobs.store.storage_watch import StorageWatch
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.sweeps import verbs as sweeps

# ruff: noqa: F811 - fixtures are named as arguments

pytestmark = pytest.mark.usefixtures("pathlib_of")

NUMBERS = pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE])
EVERY_2 = {"every_iterations": 2, "keep": 3}


class WithParts(FakeEngine):
    """Has files in a folder of its checkpoints."""

    def save(self, folder: Path) -> None:
        super().save(folder)
        (folder / "rllib" / "state").write_text("learned")


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return make_sweep_folder(tmp_path / "mine", iterations=2)


@NUMBERS
@pytest.mark.parametrize("part", ["", "000004", "000004/manifest.json", "000004/policy.json", "000004/rllib"])
def test_a_trial_whose_checkpoints_give_no_answer_is_not_begun_again(
    tmp_path: Path, fail: Fail, part: str, number: int
) -> None:
    Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2).run_to(4)
    store = TrialStore(tmp_path, "t0000")
    folder = store.checkpoints_folder
    with fail(folder / part, number), pytest.raises((CheckpointError, OSError)):
        Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2)
    assert [record.iteration for record in store.read_iterations()] == [1, 2, 3, 4]
    assert not (store.folder / "damaged").exists()
    assert Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2).engine.builds == ["000004"]


def change(iteration: int) -> ChangeRecord:
    return ChangeRecord(
        iteration=iteration, num_env_steps=100 * iteration, source_trial_id="t0001", source_iteration=4,
        before={"lr": 0.1}, after={"lr": 0.2}, time=0.0,
    )  # fmt: skip


@NUMBERS
def test_a_checkpoint_of_which_a_folder_cannot_be_listed_is_no_damaged_one(
    tmp_path: Path, fail: Fail, number: int
) -> None:
    Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2).run_to(4)
    store = TrialStore(tmp_path, "t0000")
    unlisted = store.checkpoint_folder(4) / "rllib"
    with fail(unlisted, number, calls=LISTING), pytest.raises(CheckpointError, match="rllib cannot be read"):
        Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2)
    assert Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2).engine.builds == ["000004"]


@NUMBERS
def test_a_copy_that_gives_no_answer_is_not_passed_over(tmp_path: Path, fail: Fail, number: int) -> None:
    trial = Trial(tmp_path, checkpoints=EVERY_2)
    trial.run_to(5)
    trial.store.copy_checkpoint(trial.store.checkpoint_folder(4), 5)
    with fail(trial.store.copied_checkpoint(5), number), pytest.raises(CheckpointError, match="000005 cannot be read"):
        Trial(tmp_path, checkpoints=EVERY_2, changes=(change(5),))
    assert Trial(tmp_path, checkpoints=EVERY_2, changes=(change(5),)).loop.iteration == 5


def test_results_that_give_no_answer_are_not_written_behind(tmp_path: Path, fail: Fail) -> None:
    """Iterations after the checkpoint are repeated, and would be in the file twice."""
    Trial(tmp_path, checkpoints={"every_iterations": 4, "keep": 1}).run_to(6)
    store = TrialStore(tmp_path, "t0000")
    with fail(store.results_path, errno.EIO), pytest.raises(CheckpointError, match="Input/output error"):
        store.has_results()


def test_what_was_set_aside_is_not_written_over(tmp_path: Path, fail: Fail) -> None:
    store = TrialStore(tmp_path, "t0000")
    store.take()
    for content in ("one", "two"):
        store.results_path.write_text(content)
        aside = store.folder / "damaged" / "results.jsonl"
        if content == "two":
            with fail(aside, errno.EIO), pytest.raises(CheckpointError, match="Input/output error"):
                store.set_aside_results()
            # Nor is said to be kept what is still in its place.
            with fail(store.results_path, errno.EIO), pytest.raises(CheckpointError, match="Input/output error"):
                store.set_aside_results()
        store.set_aside_results()
    assert [(store.folder / "damaged" / name).read_text() for name in ("results.jsonl", "results.jsonl-2")] == [
        "one",
        "two",
    ]


def test_the_latest_iteration_that_was_set_aside_is_not_zero_where_it_cannot_be_read(
    tmp_path: Path, fail: Fail
) -> None:
    store = TrialStore(tmp_path, "t0000")
    (store.folder / "damaged" / "000004-2").mkdir(parents=True)
    (store.folder / "damaged" / "copied-000009").mkdir()
    assert store.latest_damaged() == 4
    with fail(store.folder / "damaged", errno.EACCES), pytest.raises(CheckpointError, match="Permission denied"):
        store.latest_damaged()


@NUMBERS
def test_a_manifest_names_what_cannot_be_listed_or_is_not_written(tmp_path: Path, fail: Fail, number: int) -> None:
    trial = Trial(tmp_path, engine=WithParts(), checkpoints=EVERY_2)
    trial.run_to(2)
    folder = trial.store.checkpoint_folder(2)
    record = verify_checkpoint(folder)
    (folder / "manifest.json").unlink()
    with fail(folder / "rllib", number, calls=LISTING), pytest.raises(CheckpointError, match="rllib cannot be read"):
        write_manifest(folder, record)
    assert not (folder / "manifest.json").exists()


def test_a_checkpoint_that_gives_no_answer_is_left_out_with_a_warning(
    tmp_path: Path, fail: Fail, caplog: pytest.LogCaptureFixture
) -> None:
    trial = Trial(tmp_path, checkpoints=EVERY_2)
    trial.run_to(4)
    with fail(trial.store.checkpoint_folder(4) / "manifest.json", errno.EIO):
        assert 4 not in [record.iteration for record in candidates(trial.store)]
    assert "000004/manifest.json cannot be read" in caplog.text


# -- a sweep


@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_a_sweep_that_gives_no_answer_is_not_one_that_is_not_there(store: SweepStore, fail: Fail, number: int) -> None:
    ask: list[Callable[[], object]] = [
        store.exists,
        lambda: sweeps.status(store.folder),
        lambda: sweeps.status("mine", storage=store.folder.parent),
    ]
    with fail(store.record_path, number):
        for question in ask:
            with pytest.raises(CheckpointError, match=r"sweep\.json cannot be read"):
                question()


def test_a_sweep_that_may_not_be_looked_at_exists(
    store: SweepStore, fail: Fail, caplog: pytest.LogCaptureFixture
) -> None:
    other = make_sweep_folder(store.folder.with_name("other"), iterations=1)
    with fail(other.record_path, errno.EACCES):
        assert other.exists()
        assert [status.sweep.name for status in sweeps.list_sweeps(store.folder.parent)] == ["mine"]
        with pytest.raises(CheckpointError, match=r"other/sweep.json cannot be read"):
            sweeps.status(other.folder)
    assert f"{other.record_path} cannot be read" in caplog.text


@NUMBERS
def test_no_trial_is_left_out_of_those_to_train_and_choose_among(store: SweepStore, fail: Fail, number: int) -> None:
    with fail(store.trial("t0001").record_path, number), pytest.raises(CheckpointError, match=r"t0001/trial\.json"):
        store.read_trials()
    with fail(store.folder / "trials", number), pytest.raises(CheckpointError, match="trials cannot be read"):
        store.read_trials()


@NUMBERS
def test_a_trial_that_gives_no_answer_is_left_out_of_a_look_with_a_warning(
    store: SweepStore, fail: Fail, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    with fail(store.trial("t0001").record_path, number):
        assert [trial.trial_id for trial in readable_trials(store)] == ["t0000", "t0002", "t0003"]
        assert sorted(store.trial_stamps()) == ["t0000", "t0001", "t0002", "t0003"]
    assert "t0001/trial.json cannot be read" in caplog.text


@NUMBERS
def test_a_best_policy_that_gives_no_answer_is_not_one_that_was_never_chosen(
    store: SweepStore, fail: Fail, number: int
) -> None:
    asked: list[Callable[[], object]] = [store.has_best, store.read_best]
    (store.folder / "best").mkdir(exist_ok=True)
    (store.folder / "best" / "evaluation.json").write_text("{}")
    for part in ("best", "best/evaluation.json"):
        for question in asked:
            with fail(store.folder / part, number), pytest.raises(CheckpointError, match=f"{part} cannot be read"):
                question()


def test_a_link_that_gives_no_answer_is_not_followed(store: SweepStore, tmp_path: Path, fail: Fail) -> None:
    (store.folder / "best").mkdir(exist_ok=True)
    (store.folder / "best" / "link").symlink_to(tmp_path)
    with fail(store.folder / "best" / "link", errno.EIO), pytest.raises(CheckpointError, match="link cannot be read"):
        _ = store.best_folder


def test_a_storage_that_gives_no_answer_for_long_is_away(store: SweepStore, fail: Fail) -> None:
    now = 0.0
    watch = StorageWatch(store, lambda: now)
    with fail(store.folder.parent, errno.ESTALE, below=True):
        now = 2.0
        watch.check()
        now = 4.0
        with pytest.raises(CannotRunError, match="has not been there for 4 s"):
            watch.check()
