"""What every store promises of names, records, ids and results, as `tune_jobs/store/contract.py` says it."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from store_parts import (
    BEST,
    NO_IDS,
    ON_DISK,
    RESULTS,
    SWEEP,
    TRIAL,
    Reopen,
    fill,
    killed,
    make_best,
    make_checkpoint,
    make_iteration,
    make_sweep,
    make_trial,
)
from stores import Harness

from analysis.records import (
    FORMAT_VERSION,
    CheckpointRecord,
)
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from tune_jobs.store.command_names import name_in_commands
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.results_tail import ResultsMark

# -- names, and that there is a sweep


def test_a_sweep_is_there_from_its_record_on_and_sweeps_are_listed_by_name(harness: Harness) -> None:
    storage = harness.storage()
    assert list(storage.sweeps()) == []
    for name in ("b", "a", "half"):
        assert not storage.is_taken(name)
        storage.sweep(name).create()
        assert storage.is_taken(name)
        assert not storage.sweep(name).exists()
    assert list(storage.sweeps()) == []
    for name in ("b", "a"):
        storage.sweep(name).write_record(make_sweep(name=name))
    assert [found.name for found in harness.storage().sweeps()] == ["a", "b"]
    assert harness.storage().sweep("a").exists()


def test_a_name_is_given_once(harness: Harness, sweep: Sweep, another: Reopen) -> None:
    for take in (another().create, lambda: harness.storage().new_sweep("mine")):
        with pytest.raises(SpecError, match="'mine' is already") as raised:
            take()
        assert "remove " in raised.value.hint
    sweep.write_record(make_sweep())
    with pytest.raises(SpecError) as raised:
        another().create()
    assert f"tune-jobs resume {name_in_commands(sweep.place)}" in raised.value.hint
    another().discard()
    assert harness.storage().new_sweep("mine").name == "mine"
    another().create()


def test_a_discarded_sweep_is_gone_with_all_that_it_had(harness: Harness, sweep: Sweep, trial: Trial) -> None:
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())
    trial.write_checkpoint(make_checkpoint(1), fill)
    sweep.discard()
    assert not harness.storage().is_taken("mine")
    assert list(harness.storage().sweeps()) == []
    sweep.create()
    assert sweep.read_trials() == []


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/a", "../mine", "a\0", "x" * 256])
def test_no_name_leads_out_of_the_storage(harness: Harness, sweep: Sweep, name: str) -> None:
    for ask in (harness.storage().sweep, harness.storage().is_taken):
        with pytest.raises(NotFoundError):
            ask(name)


def test_a_sweep_is_found_by_its_place_too(harness: Harness, sweep: Sweep) -> None:
    sweep.write_record(make_sweep())
    assert harness.by_place(sweep).read_record() == make_sweep()
    assert harness.by_place(sweep).name == "mine"


def test_a_rehearsal_leaves_the_name_free_and_nothing_behind(harness: Harness) -> None:
    storage = harness.storage()
    with storage.sweep("mine").rehearsal() as other:
        assert other.name != "mine"
        assert not storage.is_taken("mine")
        assert list(storage.sweeps()) == []
        assert storage.is_taken(other.name)
    assert not storage.is_taken(other.name)


# -- records


def test_records_come_back_as_they_were(sweep: Sweep, trial: Trial, another: Reopen) -> None:
    records = make_sweep(run_time_s=0.0, git_commit="abc"), make_trial(
        status="failed", error="no\nroom ☃", evaluation_return=0.0, time_s=float("inf"),
        checkpoints=(make_checkpoint(1, evaluation_return=-1.0),),
    )  # fmt: skip
    for _ in range(2):
        sweep.write_record(records[0])
        trial.write_record(records[1])
        sweep.write_best(make_best())
        assert another().read_record() == records[0]
        assert another().trial("t0000").read_record() == records[1]
        assert another().read_best() == make_best()
        records = make_sweep(state="completed"), make_trial(status="completed")


def test_trials_are_read_by_index_and_those_without_a_record_are_none_yet(sweep: Sweep, another: Reopen) -> None:
    assert sweep.read_trials() == []
    for index in (10, 2, 0):
        sweep.trial(f"t{index:04d}").write_record(make_trial(index))
    sweep.trial("t0003").append_iterations([make_iteration(1)])
    assert [record.index for record in another().read_trials()] == [0, 2, 10]


def test_what_is_not_there_is_not_found(sweep: Sweep, trial: Trial) -> None:
    for read in (sweep.read_record, trial.read_record, sweep.read_best):
        with pytest.raises(NotFoundError) as raised:
            read()
        assert not isinstance(raised.value, CheckpointError)
    assert not sweep.has_best()
    assert not sweep.films()


@pytest.mark.parametrize("key", [SWEEP, TRIAL, BEST])
@pytest.mark.parametrize(
    "content",
    [b"", b'{"name": "mi', b"[]", b"{}", b"\xff\xfe\x00", b'{"format_version": 1e999}', b"[" * 100_000],
    ids=["empty", "half", "list", "fields missing", "no text", "no number", "deep"],
)
def test_a_damaged_record_is_an_error_that_names_it(
    harness: Harness, sweep: Sweep, trial: Trial, key: str, content: bytes
) -> None:
    harness.put("mine", key, content)
    read = {SWEEP: sweep.read_record, TRIAL: trial.read_record, BEST: sweep.read_best}[key]
    with pytest.raises(CheckpointError) as raised:
        read()
    assert harness.shown(key) in raised.value.message
    assert raised.value.exit_code == 4


@pytest.mark.parametrize("key", [SWEEP, BEST])
def test_a_record_of_a_newer_format_is_refused_and_says_what_to_do(harness: Harness, sweep: Sweep, key: str) -> None:
    sweep.write_record(make_sweep(format_version=FORMAT_VERSION + 1))
    sweep.write_best(make_best())
    data = json.loads(harness.content("mine", key)) | {"format_version": FORMAT_VERSION + 1}
    harness.put("mine", key, json.dumps(data).encode())
    with pytest.raises(CheckpointError, match="format version") as raised:
        (sweep.read_record if key == SWEEP else sweep.read_best)()
    assert "Upgrade" in raised.value.hint


@pytest.mark.parametrize("key", [SWEEP, TRIAL])
def test_a_field_that_a_newer_version_added_is_left_out(harness: Harness, sweep: Sweep, trial: Trial, key: str) -> None:
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())
    data = json.loads(harness.content("mine", key)) | {"mood": "good"}
    harness.put("mine", key, json.dumps(data).encode())
    assert (sweep.read_record(), trial.read_record()) == (make_sweep(), make_trial())


def test_a_record_that_is_another_trials_is_refused(harness: Harness, sweep: Sweep, trial: Trial) -> None:
    sweep.trial("t0001").write_record(make_trial(1))
    harness.put("mine", TRIAL, harness.content("mine", "trials/t0001/trial.json"))
    for read in (trial.read_record, sweep.read_trials):
        with pytest.raises(CheckpointError, match="t0001"):
            read()


@ON_DISK
def test_a_record_whose_writing_fails_is_the_one_before(
    sweep: Sweep, trial: Trial, another: Reopen, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the writer cannot go on, there is no half of it, and nothing that a later reader stumbles over."""
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        writes: tuple[Callable[[], None], ...] = (
            lambda: sweep.write_record(make_sweep(num_trials=9)),
            lambda: trial.write_record(make_trial(seed=9)),
        )
        for write in writes:
            with pytest.raises(CannotRunError, match="No space"):
                write()
    assert (another().read_record(), another().read_trials()) == (make_sweep(), [make_trial()])


@ON_DISK
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_record_whose_writer_is_killed_is_the_one_before_or_the_one_after(
    sweep: Sweep, another: Reopen, call: str
) -> None:
    sweep.write_record(make_sweep())

    def act(die: Callable[..., None]) -> None:
        setattr(os, call, die)
        Path.replace = die  # type: ignore[method-assign,assignment]
        sweep.write_record(make_sweep(num_trials=9))

    killed(act)
    assert another().read_record() in (make_sweep(), make_sweep(num_trials=9))
    sweep.write_record(make_sweep(num_trials=10))
    assert another().read_record().num_trials == 10


# -- ids


@pytest.mark.parametrize("name", NO_IDS)
def test_no_id_leads_elsewhere(sweep: Sweep, name: str) -> None:
    with pytest.raises(NotFoundError):
        sweep.trial(name)
    with pytest.raises(NotFoundError):
        sweep.pack(name.replace("t0", "px"))


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../mine", "mine/", "/mine", "mine\0", "m" * 256, "\N{PILE OF POO}" * 64]
)
def test_no_name_leads_elsewhere(harness: Harness, sweep: Sweep, name: str) -> None:
    for ask in (harness.storage().sweep, harness.storage().new_sweep, harness.storage().is_taken):
        with pytest.raises(NotFoundError):
            ask(name)


@pytest.mark.parametrize("trial_id", ["../t0000", "t0000/../../../../x", "/x"])
def test_no_record_names_a_place(sweep: Sweep, trial: Trial, trial_id: str) -> None:
    trial.write_checkpoint(make_checkpoint(1), fill)
    foreign = CheckpointRecord.model_construct(trial_id=trial_id, iteration=1, num_env_steps=1)
    with pytest.raises(NotFoundError):
        sweep.checkpoint_folder(foreign)
    trial.delete_checkpoint(foreign)  # of this trial, whatever the record says
    assert trial.checkpoint_iterations() == []


# -- results


def test_results_are_appended_and_replaced(trial: Trial, another: Reopen) -> None:
    assert not trial.has_results()
    assert trial.read_iterations() == []
    trial.keep_iterations([])
    assert trial.has_results()
    first = [make_iteration(1), make_iteration(2, evaluation_return=0.0, learner={"lr": 1e-4})]
    trial.append_iterations(first)
    trial.append_iterations([])
    trial.append_iterations([make_iteration(3, episode_returns=(1.5, float("-inf")), episode_lengths=(4, 5))])
    found = another().trial("t0000").read_iterations()
    assert found == [*first, make_iteration(3, episode_returns=(1.5, float("-inf")), episode_lengths=(4, 5))]
    trial.keep_iterations(first)
    trial.append_iterations([make_iteration(3)])
    assert another().trial("t0000").read_iterations() == [*first, make_iteration(3)]


def test_of_damaged_results_the_others_are_read(
    harness: Harness, sweep: Sweep, another: Reopen, caplog: pytest.LogCaptureFixture
) -> None:
    sweep.trial("t0000").append_iterations([make_iteration(1)])
    trial = another().trial("t0000")
    assert trial.scores_of({1}) == {1: [(100, None)]}
    written = harness.content("mine", RESULTS)
    last = make_iteration(3).model_dump_json().encode()
    harness.put("mine", RESULTS, written + b'\xff{"iteration": 2\n' + last + b'\n{"iteration": 4, "num')
    found = trial.read_results()
    assert [record.iteration for record in found.records] == [1, 3]
    assert [(bad.number, bad.content) for bad in found.bad] == [(2, b'\xff{"iteration": 2')]
    assert found.tail == b'{"iteration": 4, "num'
    assert [record.iteration for record in trial.read_iterations()] == [1, 3]
    assert "line 2" in caplog.text
    assert trial.scores_of({2, 3, 9}) == {3: [(300, None)]}
    harness.put("mine", RESULTS, harness.content("mine", RESULTS) * 2)
    assert trial.scores_of([1, 3])[3] == [(300, None)] * 2


# -- for those who look again and again


def test_what_was_appended_is_read_once(trial: Trial, another: Reopen) -> None:
    reader = another().trial("t0000")
    nothing = reader.read_new_points(ResultsMark())
    assert (nothing.points, nothing.replaced) == ((), False)
    trial.append_iterations([make_iteration(1), make_iteration(2, training_return=2.0, evaluation_return=-1.0)])
    trial.settle()
    first = reader.read_new_points(nothing.mark)
    assert [point.iteration for point in first.points] == [1, 2]
    last = first.points[1]
    assert (last.num_env_steps, last.training_return, last.evaluation_return) == (200, 2.0, -1.0)
    assert not reader.read_new_points(first.mark).points
    trial.append_iterations([make_iteration(3)])
    trial.settle()
    second = reader.read_new_points(first.mark)
    assert [point.iteration for point in second.points] == [3]
    assert not second.replaced
    # Whoever begins anew gets all.
    assert len(another().trial("t0000").read_new_points(ResultsMark()).points) == 3


def test_half_a_line_is_read_when_it_is_whole(harness: Harness, sweep: Sweep, another: Reopen) -> None:
    sweep.trial("t0000").append_iterations([make_iteration(1)])
    trial = another().trial("t0000")
    whole = harness.content("mine", RESULTS)
    line = make_iteration(2).model_dump_json().encode() + b"\n"
    harness.put("mine", RESULTS, whole + line[:20])
    first = trial.read_new_points(ResultsMark())
    assert [point.iteration for point in first.points] == [1]
    harness.put("mine", RESULTS, whole + line[:40])
    more = trial.read_new_points(first.mark)
    assert not more.points
    harness.put("mine", RESULTS, whole + line)
    assert [point.iteration for point in trial.read_new_points(more.mark).points] == [2]


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_results_that_were_replaced_are_read_anew(trial: Trial, another: Reopen, kept: int) -> None:
    """A trial that continues from a checkpoint drops what came after it."""
    records = [make_iteration(number) for number in (1, 2, 3)]
    trial.append_iterations(records)
    before = another().trial("t0000").read_new_points(ResultsMark())
    trial.keep_iterations(records[:kept])
    # By then it may have more lines than before, and in place of those that were read.
    trial.append_iterations([make_iteration(number, training_return=9.0) for number in range(kept + 1, 6)])
    after = another().trial("t0000").read_new_points(before.mark)
    assert after.replaced
    assert [(point.iteration, point.training_return) for point in after.points] == [
        (number, None if number <= kept else 9.0) for number in range(1, 6)
    ]


def test_results_that_are_gone_are_read_as_none(harness: Harness, sweep: Sweep, another: Reopen) -> None:
    sweep.trial("t0000").append_iterations([make_iteration(1)])
    trial = another().trial("t0000")
    before = trial.read_new_points(ResultsMark())
    harness.remove("mine", RESULTS)
    after = trial.read_new_points(before.mark)
    assert (after.points, after.replaced) == ((), True)
    assert not trial.read_new_points(after.mark).replaced


def test_new_results_that_contradict_are_weighed_as_all_are(harness: Harness, trial: Trial) -> None:
    def put(*numbers: int) -> None:
        lines = [make_iteration(number).model_dump_json().encode() + b"\n" for number in numbers]
        harness.put("mine", RESULTS, b"".join([b"\xff no result\n", *lines]))

    put(1, 2, 900)
    first = trial.read_new_points(ResultsMark())
    assert [point.iteration for point in first.points] == [1, 2, 900]
    put(1, 2, 900, 3, 4)
    second = trial.read_new_points(first.mark)
    assert second.replaced
    assert [point.iteration for point in second.points] == [1, 2, 3, 4]
    assert [record.iteration for record in trial.read_iterations()] == [1, 2, 3, 4]


def test_stamps_tell_which_trials_were_written_and_whether_the_winner_was(sweep: Sweep, another: Reopen) -> None:
    assert another().trial_stamps() == {}
    for index in (0, 1):
        sweep.trial(f"t{index:04d}").write_record(make_trial(index))
    sweep.trial("t0002").append_iterations([make_iteration(1)])
    before = another().trial_stamps()
    assert set(before) == {"t0000", "t0001"}
    assert another().trial_stamps() == before
    sweep.trial("t0001").write_record(make_trial(1, status="running"))
    after = another().trial_stamps()
    assert {trial_id for trial_id in after if after[trial_id] != before[trial_id]} == {"t0001"}
    stamps = [another().best_stamp()]
    for best in (make_best(), make_best(seed=44)):
        sweep.write_best(best)
        stamps.append(another().best_stamp())
        assert another().best_stamp() == stamps[-1]
    assert (stamps[0], len(set(stamps))) == ((), 3)


def test_a_report_is_known_by_the_names_of_its_files(sweep: Sweep, another: Reopen) -> None:
    assert another().report_files() == {}
    with sweep.writing_report() as folder:
        (folder / "figures").mkdir(parents=True)
        for name in ("index.html", "figures/a.svg", ".index.1-2.html"):
            (folder / name).write_text(name)
    files = another().report_files()
    assert {name: path.read_text() for name, path in files.items()} == {
        "index.html": "index.html", "figures/a.svg": "figures/a.svg",
    }  # fmt: skip
