"""What every store promises, as `tune_jobs/store/contract.py` says it; each test runs with every store of stores.py."""

import json
import os
import signal
from pathlib import Path

import pytest
from policy_factory import make_portable
from stores import HARNESSES

from analysis.records import (
    FORMAT_VERSION,
    BestRecord,
    CheckpointRecord,
    EvaluationRecord,
    IterationRecord,
    SweepRecord,
    TrialRecord,
)
from policies.acting.load import load_policy
from policies.errors import CannotRunError, CheckpointError, NotFoundError, SpecError
from policies.files import open_to_append
from tune_jobs.store.contract import Assignment
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.probe import answer

SWEEP, TRIAL, RESULTS = "sweep.json", "trials/t0000/trial.json", "trials/t0000/results.jsonl"
BEST, PACK = "best/evaluation.json", "packs/p00.json"
NO_IDS = ["", ".", "..", "../t0000", "t0000/", "/t0000", "t000", "T0000", "t00000000000", "t0000\n", "t0000\0", "*"]


@pytest.fixture(params=HARNESSES)
def harness(request, tmp_path):
    return HARNESSES[request.param](tmp_path)


@pytest.fixture
def sweep(harness):
    made = harness.storage().sweep("mine")
    made.create()
    return made


@pytest.fixture
def trial(sweep):
    return sweep.trial("t0000")


@pytest.fixture
def another(harness):
    """The sweep as another process opens it."""
    return lambda: harness.storage().sweep("mine")


def make_sweep(**changes):
    values = {"name": "mine", "state": "running", "spec": {"a": 1}, "evaluation_seeds": (1, 2), "num_trials": 2,
              "confirmation_seeds": (3,), "created_at": 5.0}  # fmt: skip
    return SweepRecord(**values | changes)


def make_trial(index=0, **changes):
    values = {"trial_id": f"t{index:04d}", "index": index, "point_index": index, "seed": index, "point": {"lr": 0.1}}
    return TrialRecord(**values | changes)


def make_iteration(number, **changes):
    return IterationRecord(iteration=number, num_env_steps=100 * number, num_episodes=number, time_s=number, **changes)


def make_checkpoint(iteration, **changes):
    values = {"trial_id": "t0000", "iteration": iteration, "num_env_steps": 100 * iteration}
    return CheckpointRecord(**values | changes)


def make_best(**changes):
    evaluation = EvaluationRecord(policy="p", env_id="E-v0", seeds=(1,), returns=(0.0,), lengths=(3,))
    values = {"checkpoint": make_checkpoint(1), "point": {}, "seed": 0, "selection_score": -1.0,
              "confirmation": evaluation, "random": evaluation}  # fmt: skip
    return BestRecord(**values | changes)


def fill(folder, content="abc"):
    """What an engine and the trial write into a checkpoint."""
    (folder / "policy.json").write_text("{}")
    (folder / "policy.safetensors").write_text("")
    (folder / "state").mkdir()
    (folder / "state" / "weights").write_text(content)


def killed(act):
    """Do something in a process that is killed within it: `act` is given what to call there."""
    child = os.fork()
    if not child:
        try:
            act(lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        finally:
            os._exit(0)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])


# -- names, and that there is a sweep


def test_a_sweep_is_there_from_its_record_on_and_sweeps_are_listed_by_name(harness):
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


def test_a_name_is_given_once(harness, sweep, another):
    for take in (another().create, lambda: harness.storage().new_sweep("mine")):
        with pytest.raises(SpecError, match="'mine' is already") as raised:
            take()
        assert "remove that folder" in raised.value.hint
    sweep.write_record(make_sweep())
    with pytest.raises(SpecError) as raised:
        another().create()
    assert "tune-jobs resume mine" in raised.value.hint
    another().discard()
    assert harness.storage().new_sweep("mine").name == "mine"
    another().create()


def test_a_discarded_sweep_is_gone_with_all_that_it_had(harness, sweep, trial):
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())
    trial.write_checkpoint(make_checkpoint(1), fill)
    sweep.discard()
    assert not harness.storage().is_taken("mine")
    assert list(harness.storage().sweeps()) == []
    sweep.create()
    assert sweep.read_trials() == []


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "/a", "../mine", "a\0"])
def test_no_name_leads_out_of_the_storage(harness, sweep, name):
    for ask in (harness.storage().sweep, harness.storage().is_taken):
        with pytest.raises(NotFoundError):
            ask(name)


def test_a_sweep_is_found_by_its_place_too(harness, sweep):
    sweep.write_record(make_sweep())
    assert harness.by_place(sweep).read_record() == make_sweep()
    assert harness.by_place(sweep).name == "mine"


def test_a_rehearsal_leaves_the_name_free_and_nothing_behind(harness):
    storage = harness.storage()
    with storage.sweep("mine").rehearsal() as other:
        assert other.name != "mine"
        assert not storage.is_taken("mine")
        assert list(storage.sweeps()) == []
        assert storage.is_taken(other.name)
    assert not storage.is_taken(other.name)


# -- records


def test_records_come_back_as_they_were(sweep, trial, another):
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


def test_trials_are_read_by_index_and_those_without_a_record_are_none_yet(sweep, another):
    assert sweep.read_trials() == []
    for index in (10, 2, 0):
        sweep.trial(f"t{index:04d}").write_record(make_trial(index))
    sweep.trial("t0003").append_iterations([make_iteration(1)])
    assert [record.index for record in another().read_trials()] == [0, 2, 10]


def test_what_is_not_there_is_not_found(sweep, trial):
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
def test_a_damaged_record_is_an_error_that_names_it(harness, sweep, trial, key, content):
    harness.put("mine", key, content)
    read = {SWEEP: sweep.read_record, TRIAL: trial.read_record, BEST: sweep.read_best}[key]
    with pytest.raises(CheckpointError) as raised:
        read()
    assert key in raised.value.message
    assert raised.value.exit_code == 4


@pytest.mark.parametrize("key", [SWEEP, BEST])
def test_a_record_of_a_newer_format_is_refused_and_says_what_to_do(harness, sweep, key):
    sweep.write_record(make_sweep(format_version=FORMAT_VERSION + 1))
    sweep.write_best(make_best())
    data = json.loads(harness.content("mine", key)) | {"format_version": FORMAT_VERSION + 1}
    harness.put("mine", key, json.dumps(data).encode())
    with pytest.raises(CheckpointError, match="format version") as raised:
        (sweep.read_record if key == SWEEP else sweep.read_best)()
    assert "Upgrade" in raised.value.hint


@pytest.mark.parametrize("key", [SWEEP, TRIAL])
def test_a_field_that_a_newer_version_added_is_left_out(harness, sweep, trial, key):
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())
    data = json.loads(harness.content("mine", key)) | {"mood": "good"}
    harness.put("mine", key, json.dumps(data).encode())
    assert (sweep.read_record(), trial.read_record()) == (make_sweep(), make_trial())


def test_a_record_that_is_another_trials_is_refused(harness, sweep, trial):
    sweep.trial("t0001").write_record(make_trial(1))
    harness.put("mine", TRIAL, harness.content("mine", "trials/t0001/trial.json"))
    for read in (trial.read_record, sweep.read_trials):
        with pytest.raises(CheckpointError, match="t0001"):
            read()


def test_a_record_whose_writing_fails_is_the_one_before(sweep, trial, another, monkeypatch):
    """Where the writer cannot go on, there is no half of it, and nothing that a later reader stumbles over."""
    sweep.write_record(make_sweep())
    trial.write_record(make_trial())

    def fails(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        for write in (
            lambda: sweep.write_record(make_sweep(num_trials=9)),
            lambda: trial.write_record(make_trial(seed=9)),
        ):
            with pytest.raises(CannotRunError, match="No space"):
                write()
    assert (another().read_record(), another().read_trials()) == (make_sweep(), [make_trial()])


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_record_whose_writer_is_killed_is_the_one_before_or_the_one_after(sweep, another, call):
    sweep.write_record(make_sweep())

    def act(die):
        setattr(os, call, die)
        Path.replace = die
        sweep.write_record(make_sweep(num_trials=9))

    killed(act)
    assert another().read_record() in (make_sweep(), make_sweep(num_trials=9))
    sweep.write_record(make_sweep(num_trials=10))
    assert another().read_record().num_trials == 10


# -- ids


@pytest.mark.parametrize("name", NO_IDS)
def test_no_id_leads_elsewhere(sweep, name):
    with pytest.raises(NotFoundError):
        sweep.trial(name)
    with pytest.raises(NotFoundError):
        sweep.pack(name.replace("t0", "px"))


@pytest.mark.parametrize("trial_id", ["../t0000", "t0000/../../../../x", "/x"])
def test_no_record_names_a_place(sweep, trial, trial_id):
    trial.write_checkpoint(make_checkpoint(1), fill)
    foreign = CheckpointRecord.model_construct(trial_id=trial_id, iteration=1, num_env_steps=1)
    with pytest.raises(NotFoundError):
        sweep.checkpoint_folder(foreign)
    trial.delete_checkpoint(foreign)  # of this trial, whatever the record says
    assert trial.checkpoint_iterations() == []


# -- results


def test_results_are_appended_and_replaced(trial, another):
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


def test_of_damaged_results_the_others_are_read(harness, trial, caplog):
    trial.append_iterations([make_iteration(1)])
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


# -- checkpoints


def test_a_checkpoint_comes_back_as_it_was_written(sweep, trial, another):
    for iteration in (900, 1_000_001, 20):
        trial.write_checkpoint(make_checkpoint(iteration, evaluation_return=iteration / 2), fill)
    found = another().trial("t0000")
    assert found.checkpoint_iterations() == [20, 900, 1_000_001]
    assert found.checkpoints() == [make_checkpoint(n, evaluation_return=n / 2) for n in (20, 900, 1_000_001)]
    assert found.verify_checkpoint(900) == found.checkpoint(900) == make_checkpoint(900, evaluation_return=450.0)
    for folder in (found.checkpoint_folder(20), another().checkpoint_folder(make_checkpoint(20))):
        assert (folder / "state" / "weights").read_text() == "abc"


def test_a_checkpoint_is_seen_when_it_is_whole(trial, another):
    seen = []
    trial.write_checkpoint(
        make_checkpoint(1), lambda folder: seen.append((list(folder.iterdir()), numbers(another))) or fill(folder)
    )
    assert seen == [([], [])]
    assert numbers(another) == [1]


def numbers(another):
    return another().trial("t0000").checkpoint_iterations()


def test_a_checkpoint_that_was_not_written_whole_is_not_there(trial, another):
    def fails(folder):
        fill(folder, "other")
        raise OSError(28, "No space left on device")

    trial.write_checkpoint(make_checkpoint(3), fill)
    for iteration in (4, 3):  # 3: where it would replace one
        with pytest.raises(OSError, match="No space"):
            trial.write_checkpoint(make_checkpoint(iteration), fails)
    assert numbers(another) == [3]
    assert (trial.checkpoint_folder(3) / "state" / "weights").read_text() == "abc"


def test_of_a_checkpoint_whose_writer_is_killed_nothing_is_seen_and_the_next_owner_clears_it_away(
    harness, trial, another
):
    trial.write_checkpoint(make_checkpoint(3), fill)
    before = harness.keys("mine")
    killed(lambda die: trial.write_checkpoint(make_checkpoint(4), lambda folder: (fill(folder), die())))
    assert numbers(another) == [3]
    trial.remove_leftovers()
    assert harness.keys("mine") == before


def test_a_checkpoint_is_replaced_and_deleted(trial, another):
    trial.write_checkpoint(make_checkpoint(3, evaluation_return=1.0), lambda folder: fill(folder, "old"))
    trial.write_checkpoint(make_checkpoint(3, evaluation_return=2.0), lambda folder: fill(folder, "new"))
    trial.write_checkpoint(make_checkpoint(4), fill)
    assert trial.verify_checkpoint(3).evaluation_return == 2.0
    assert (another().trial("t0000").checkpoint_folder(3) / "state" / "weights").read_text() == "new"
    trial.delete_checkpoint(make_checkpoint(3))
    assert numbers(another) == [4]
    assert not another().trial("t0000").checkpoint_folder(3).exists()
    for read in (trial.checkpoint, trial.verify_checkpoint):
        with pytest.raises(NotFoundError):
            read(3)


PLACE = "trials/t0000/checkpoints/000003/"


@pytest.mark.parametrize(
    ("key", "content", "what"),
    [
        ("state/weights", b"abd", "state/weights"),
        ("state/weights", b"", "state/weights"),
        ("state/weights", None, "state/weights"),
        ("state/more", b"", "state/more"),
        ("manifest.json", None, "manifest"),
        ("manifest.json", b"{", "manifest"),
        ("manifest.json", b"{}", "manifest"),
    ],
)
def test_a_damaged_checkpoint_is_found_before_it_is_read(harness, trial, key, content, what):
    trial.write_checkpoint(make_checkpoint(3), fill)
    if content is None:
        harness.remove("mine", PLACE + key)
    else:
        harness.put("mine", PLACE + key, content)
    with pytest.raises(CheckpointError, match=what) as raised:
        trial.verify_checkpoint(3)
    assert "000003" in raised.value.message
    assert trial.checkpoint_iterations() == [3]


def test_an_edited_score_and_another_checkpoints_manifest_are_refused(harness, trial):
    trial.write_checkpoint(make_checkpoint(3, evaluation_return=1.0), fill)
    trial.write_checkpoint(make_checkpoint(4, evaluation_return=2.0), fill)
    data = json.loads(harness.content("mine", PLACE + "manifest.json"))
    other = harness.content("mine", PLACE.replace("3", "4") + "manifest.json")
    for manifest in (json.dumps(data | {"evaluation_return": 9.0}).encode(), other):
        harness.put("mine", PLACE + "manifest.json", manifest)
        for read in (lambda: trial.checkpoint(3), trial.checkpoints):
            with pytest.raises(CheckpointError, match="000003"):
                read()
    assert trial.checkpoint(4).evaluation_return == 2.0


def test_the_engine_that_is_named_is_in_the_manifest(harness, trial):
    trial.write_checkpoint(make_checkpoint(3), fill, engine="packed")
    assert json.loads(harness.content("mine", PLACE + "manifest.json"))["engine"] == "packed"


# -- checkpoints of others, and what was damaged


def test_a_copy_stays_when_its_checkpoint_is_deleted(sweep, trial, another):
    other = sweep.trial("t0001")
    record = make_checkpoint(4, trial_id="t0001")
    assert not trial.copied_checkpoint(7).exists()
    for content in ("abc", "newer"):
        other.write_checkpoint(record, lambda folder: fill(folder, content))  # noqa: B023 (called at once)
        for iteration in (7, 9):
            assert trial.copy_checkpoint(other.checkpoint_folder(4), iteration) == record
        other.delete_checkpoint(record)
        assert (another().trial("t0000").copied_checkpoint(7) / "state" / "weights").read_text() == content
    assert trial.checkpoint_iterations() == []
    trial.remove_copies(keep=[9, 11])
    assert [trial.copied_checkpoint(iteration).exists() for iteration in (7, 9)] == [False, True]
    trial.remove_copies()
    trial.remove_copies()
    assert not another().trial("t0000").copied_checkpoint(9).exists()


def test_nothing_is_copied_of_a_checkpoint_that_is_damaged_or_gone(harness, sweep, trial):
    other = sweep.trial("t0001")
    other.write_checkpoint(make_checkpoint(3, trial_id="t0001"), fill)
    trial.copy_checkpoint(other.checkpoint_folder(3), 7)
    harness.put("mine", PLACE.replace("t0000", "t0001") + "state/weights", b"abd")
    before = harness.keys("mine")
    with pytest.raises(CheckpointError, match="state/weights"):
        trial.copy_checkpoint(other.checkpoint_folder(3), 7)
    with pytest.raises((OSError, NotFoundError)):
        trial.copy_checkpoint(other.checkpoint_folder(4), 7)
    assert harness.keys("mine") == before
    assert (trial.copied_checkpoint(7) / "state" / "weights").read_text() == "abc"


def test_what_is_set_aside_is_kept_and_taken_for_nothing(harness, trial, another):
    assert trial.latest_damaged() == 0
    trial.take()
    places = []
    for content in ("one", "two"):
        trial.write_checkpoint(make_checkpoint(3), lambda folder: fill(folder, content))  # noqa: B023 (called at once)
        places.append(trial.set_aside(trial.checkpoint_folder(3)))
    trial.append_iterations([make_iteration(1)])
    places.append(trial.set_aside_results())
    assert len(set(places)) == 3
    kept = [harness.content("mine", f"trials/t0000/{place}/state/weights") for place in places[:2]]
    assert kept == [b"one", b"two"]
    assert b'"iteration"' in harness.content("mine", f"trials/t0000/{places[2]}")
    found = another().trial("t0000")
    assert (found.checkpoint_iterations(), found.has_results(), found.latest_damaged()) == ([], False, 3)
    trial.keep_damaged_results([b"\xff", b"{"])
    trial.keep_damaged_results([b"["])
    assert harness.content("mine", "trials/t0000/results.damaged") == b"\xff\n{\n[\n"


def test_leftovers_of_a_sweep_are_removed_and_nothing_else(harness, sweep, trial):
    sweep.write_record(make_sweep())
    trial.write_record(make_trial(status="completed"))
    trial.write_checkpoint(make_checkpoint(3), fill)
    before = harness.keys("mine")
    killed(lambda die: trial.write_checkpoint(make_checkpoint(4), lambda folder: (fill(folder), die())))
    running = sweep.trial("t0001")
    running.write_record(make_trial(1, status="running"))
    running.write_checkpoint(
        make_checkpoint(1, trial_id="t0001"), lambda folder: (fill(folder), sweep.remove_leftovers())
    )
    assert running.checkpoint_iterations() == [1]
    assert {key for key in harness.keys("mine") if "t0001" not in key} == before


# -- who writes: locks, and owners by epoch


def test_one_process_at_a_time_drives_a_sweep(sweep, another):
    assert not sweep.is_driven()
    with sweep.lock():
        assert another().is_driven()
        with pytest.raises(CannotRunError, match="another process"), another().lock():
            pass
    assert not another().is_driven()
    with another().driver_lock():
        assert sweep.is_driven()
        for held in (sweep.lock, sweep.driver_lock):
            with pytest.raises(CannotRunError, match="still being run"), held():
                pass
    with sweep.lock(), another().driver_lock():
        pass


def test_a_killed_driver_holds_no_lock(sweep, another):
    def act(die):
        with another().lock():
            die()

    killed(act)
    assert not sweep.is_driven()
    with sweep.lock():
        pass


def test_who_was_run_before_has_lost_it(sweep, another):
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


def test_who_lost_a_trial_writes_nothing_of_it(harness, trial, another):
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


def test_a_trial_that_is_lost_while_its_checkpoint_is_written_gets_none(trial, another):
    trial.take()

    def write(folder):
        fill(folder)
        another().trial("t0000").take()

    with pytest.raises(OwnershipLostError):
        trial.write_checkpoint(make_checkpoint(1), write)
    assert numbers(another) == []


def test_a_trial_and_a_pack_are_taken_only_for_who_owns_the_run(sweep, trial, another):
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


def test_who_has_not_taken_a_trial_is_kept_from_nothing(trial, another):
    """A reader, or a tool that works on a sweep that nobody runs."""
    trial.take()
    reader = another().trial("t0000")
    with reader.owned():
        pass
    assert not reader.is_lost()


# -- packs


def test_an_assignment_comes_back_as_it_was_written(sweep, another):
    for assignment in (Assignment(("t0002", "t0000"), {"t0000": 2}), Assignment()):
        sweep.pack("p00").write(assignment)
        assert another().pack("p00").read() == assignment


@pytest.mark.parametrize("content", [None, b"", b"{}", b'{"trial_ids": ["../x"], "num_failures": {}}', b"\xff"])
def test_an_assignment_that_cannot_be_read_is_an_error_that_names_it(harness, sweep, content):
    if content is not None:
        harness.put("mine", PACK, content)
    with pytest.raises(CheckpointError, match="p00"):
        sweep.pack("p00").read()


# -- logs and tallies


def test_a_log_is_appended_to_and_its_end_is_told(sweep, trial, another, capfd):
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


def test_a_tally_is_forgotten_whether_there_is_one_or_not(trial):
    trial.take()
    trial.tally_path.write_bytes(b"")
    trial.forget_tally()
    trial.forget_tally()
    assert not trial.tally_path.exists()


# -- requests to stop


def test_a_stop_is_asked_for_and_forgotten(sweep, another):
    assert not sweep.stop_requested()
    sweep.clear_stop_request()
    another().request_stop()
    another().request_stop()
    assert sweep.stop_requested()
    sweep.clear_stop_request()
    assert not another().stop_requested()


# -- what comes of it


def test_the_best_is_read_with_its_policy(sweep, another):
    policy = make_portable("CartPole-v1", seed=3)
    sweep.write_best(make_best(), policy)
    assert another().has_best()
    assert load_policy(another().best_folder).env_id == load_policy(another().best_policy_path).env_id == "CartPole-v1"
    sweep.write_best(make_best(seed=4))
    assert another().read_best().seed == 4
    assert load_policy(another().best_folder).env_id == "CartPole-v1"


def test_a_policy_that_cannot_be_written_leaves_the_best_that_was_there(sweep, another, monkeypatch):
    sweep.write_best(make_best(), make_portable("CartPole-v1"))

    def fails(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fails)
        with pytest.raises(CannotRunError, match="No space"):
            sweep.write_best(make_best(seed=4), make_portable("Acrobot-v1"))
    assert another().read_best() == make_best()
    assert load_policy(another().best_folder).env_id == "CartPole-v1"


def test_an_edited_best_is_refused(harness, sweep):
    sweep.write_best(make_best())
    data = json.loads(harness.content("mine", BEST)) | {"selection_score": 99.0}
    harness.put("mine", BEST, json.dumps(data).encode())
    with pytest.raises(CheckpointError, match="SHA-256"):
        sweep.read_best()


def test_films_are_those_that_were_written(sweep, another):
    sweep.write_best(make_best(), make_portable("CartPole-v1"))
    with sweep.writing_films() as paths:
        assert set(paths) == {"before_mp4", "after_mp4", "after_gif", "before_after_mp4"}
        paths["after_mp4"].write_bytes(b"film")
    films = another().films()
    assert {name: path.read_bytes() for name, path in films.items()} == {"after_mp4": b"film"}


def test_a_report_is_written_over_the_one_before(harness, sweep):
    for text in (b"one", b"two"):
        with sweep.writing_report() as folder:
            folder.mkdir(exist_ok=True)
            (folder / "index.html").write_bytes(text)
        assert harness.content("mine", "report/index.html") == text


def test_events_are_appended(harness, trial):
    for data in (b"one", b"two"):
        trial.append_events("events.1", data)
    assert harness.content("mine", "trials/t0000/tensorboard/events.1") == b"onetwo"


# -- of machines


def test_who_sees_the_same_sweep_can_answer(harness, sweep):
    before = harness.keys("mine")
    with sweep.probing() as probe:
        assert not probe.is_same("", "node")
        question = answer(probe.place, "node")
        assert probe.is_same(question, "node")
        assert not probe.is_same(question, "other")
        assert not probe.is_same(f"{question}x", "node")
    assert not probe.is_same(question, "node")
    assert harness.keys("mine") == before


def test_ray_tunes_state_is_begun_anew_and_the_driver_prints_to_a_file(sweep, another):
    sweep.clear_tune_folder()
    sweep.tune_folder.mkdir(parents=True)
    (sweep.tune_folder / "state.json").touch()
    another().clear_tune_folder()
    assert not sweep.tune_folder.exists()
    with sweep.driver_log.open("ab") as file:
        file.write(b"said")
    assert another().driver_log.read_bytes() == b"said"
