"""The folder that a repetition is kept in: which names it may have, and when it is left there."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder, train

import tune_jobs
from analysis.records import JobRecord, ReplicationRecord, TrialPlan
from analysis.waits import WaitRecord
from policies.errors import CannotRunError, SpecError
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.spec.file import stored_spec
from tune_jobs.store import candidates
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.store.transitions import pending_record
from tune_jobs.sweeps import reproduce as module
from tune_jobs.sweeps import resume
from tune_jobs.sweeps.interrupted import SweepInterrupted
from tune_jobs.sweeps.outcome import SweepResult


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    return make_sweep_folder(tmp_path / "mine")


class Again:
    """In the place of the training in Ray's processes."""

    before: BaseException | None = None
    """Raised before anything trained."""
    after: BaseException | None = None
    began = False

    def __call__(self, folder: str, progress: str) -> None:
        self.began = True
        if self.before is not None:
            raise self.before
        store = SweepStore(Path(folder))
        (trial,) = store.read_trials()
        train(store, trial.trial_id, stored_spec(store.read_record()).stop.num_iterations)
        if self.after is not None:
            raise self.after


@pytest.fixture
def again(monkeypatch: pytest.MonkeyPatch) -> Again:
    fake = Again()
    monkeypatch.setattr(module, "_train_again", fake)
    return fake


@pytest.mark.parametrize("name", ["my repetition", "für-t1", ".hid", "x" * 101, "-o"])
def test_a_repetition_may_be_kept_in_a_folder_of_any_name(
    store: SweepStore, again: Again, tmp_path: Path, name: str
) -> None:
    job = JobRecord(id="mine-1a2b", address="http://head.example.org:8265")
    store.write_record(store.read_record().model_copy(update={"job": job, "waiting": WaitRecord(since=1.0)}))
    found = tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=tmp_path / "new" / name)
    assert (found.equal, found.folder) == (True, tmp_path / "new" / name)
    status = tune_jobs.status(tmp_path / "new" / name)
    assert status.sweep.name == name
    assert stored_spec(status.sweep).space == stored_spec(store.read_record()).space
    # No cluster runs it.
    assert (status.sweep.job, status.sweep.waiting) == (None, None)


def test_a_link_to_what_is_not_there_is_in_the_way(store: SweepStore, again: Again, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(CannotRunError, match="exists already"):
        tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=tmp_path / "link")
    assert not again.began


def test_a_folder_is_left_only_where_something_trained(store: SweepStore, again: Again, tmp_path: Path) -> None:
    out = tmp_path / "new" / "again"
    again.before = CannotRunError("no Ray")
    with pytest.raises(CannotRunError, match="no Ray"):
        tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=out)
    assert not out.parent.exists()
    again.before, again.after = None, SweepInterrupted()
    with pytest.raises(SweepInterrupted):
        tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=out)
    assert len(SweepStore(out).trial("t0001").read_iterations()) == 6


def test_a_resume_of_a_repetition_trains_no_other_trial(store: SweepStore, again: Again, tmp_path: Path) -> None:
    out = tmp_path / "again"
    tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=out)
    made = SweepStore(out)
    made.write_record(made.read_record().model_copy(update={"state": "completed"}))
    before = SweepStore(out).read_trials()
    result = tune_jobs.resume(out, progress="none", finish=False)
    assert [trial.trial_id for trial in result.trials] == ["t0001"]
    assert SweepStore(out).read_trials() == before
    record = SweepStore(out).read_record()
    assert (record.repeats, record.num_trials) == ("mine/t0001", 1)


def test_more_trials_for_a_repetition_are_refused(store: SweepStore, again: Again, tmp_path: Path) -> None:
    out = tmp_path / "again"
    tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=out)
    calls: list[Callable[[], object]] = [
        lambda: tune_jobs.extend(out, num_samples=2, progress="none"),
        lambda: tune_jobs.inject(out, {"lr": 0.5}, progress="none"),
        lambda: tune_jobs.replicate(out, progress="none"),
        lambda: tune_jobs.resume(out, retry_failed=True, progress="none"),
    ]
    for call in calls:
        with pytest.raises(SpecError, match="again repeats trial mine/t0001") as caught:
            call()
        assert "Add them to sweep mine" in caught.value.hint
    assert [trial.trial_id for trial in tune_jobs.trials(out)] == ["t0001"]


def test_a_repetition_says_which_cluster_it_runs_on(
    store: SweepStore, again: Again, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "again"
    tune_jobs.reproduce("mine/t0001", storage=tmp_path, output=out)
    (trial,) = SweepStore(out).read_trials()
    made, runs_on = SweepStore(out), []

    def run(kept: SweepStore, _: object, **where: object) -> SweepResult:
        runs_on.append((where["address"], kept.read_record().address))
        return SweepResult(kept.place, kept.read_record(), kept.read_trials())

    @contextlib.contextmanager
    def taken(*_: object, **__: object) -> Iterator[tuple[None, Machine, tuple[str, ...]]]:
        yield None, Machine(8.0), ()

    monkeypatch.setattr(resume, "run_sweep", run)
    monkeypatch.setattr(resume, "_taken_over", taken)
    for status in ("paused", "completed"):
        made.trial("t0001").write_record(trial.model_copy(update={"status": status}))
        for address in ("ray://head:10001", None):
            resume.go_on(made, address, finish=False, progress="none")
    # Nothing is written of what is finished.
    assert runs_on == [("ray://head:10001", "ray://head:10001"), (None, None), ("ray://head:10001", None), (None, None)]


def test_a_repetition_of_an_extra_seed_is_numbered_as_the_original(tmp_path: Path, again: Again) -> None:
    store = make_sweep_folder(tmp_path / "mine")
    record = store.read_record()
    more = ReplicationRecord(num_points=2, points=(0,))
    store.write_record(record.model_copy(update={"num_trials": 5, "replications": (more,)}))
    extra = {"trial_id": "t0004", "index": 4, "point_index": 0, "seed_index": 2, "seed": 77}
    plan = {name: getattr(store.read_trials()[0], name) for name in TrialPlan.model_fields}
    store.trial("t0004").write_record(pending_record(TrialPlan.model_validate(plan | extra)))
    train(store, "t0004", 6)
    assert candidates.read_trials(store)[-1].seed_index == 2
    found = tune_jobs.reproduce("mine/t0004", storage=tmp_path, output=tmp_path / "again")
    (repeated,) = candidates.read_trials(SweepStore(present(found.folder)))
    assert {name: getattr(repeated, name) for name in extra} == extra
