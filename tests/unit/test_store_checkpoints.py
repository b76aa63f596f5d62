"""What every store promises of checkpoints, copies and what is set aside, as its contract says it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from store_parts import ON_DISK, Reopen, fill, killed, make_checkpoint, make_iteration, make_sweep, make_trial, numbers
from stores import Harness

from policies.errors import CheckpointError, NotFoundError
from tune_jobs.store.contract import Sweep, Trial
from tune_jobs.store.manifests import verify_checkpoint

# -- checkpoints


def in_turn(folder: Path, then: Callable[[], None]) -> None:
    fill(folder)
    then()


def test_a_checkpoint_comes_back_as_it_was_written(sweep: Sweep, trial: Trial, another: Reopen) -> None:
    for iteration in (900, 1_000_001, 20):
        trial.write_checkpoint(make_checkpoint(iteration, evaluation_return=iteration / 2), fill)
    found = another().trial("t0000")
    assert found.checkpoint_iterations() == [20, 900, 1_000_001]
    assert found.checkpoints() == [make_checkpoint(n, evaluation_return=n / 2) for n in (20, 900, 1_000_001)]
    assert found.verify_checkpoint(900) == found.checkpoint(900) == make_checkpoint(900, evaluation_return=450.0)
    again = another()  # what it has fetched is there as long as it is
    for folder in (found.checkpoint_folder(20), again.checkpoint_folder(make_checkpoint(20))):
        assert (folder / "state" / "weights").read_text() == "abc"


def test_a_checkpoint_is_read_in_a_block_by_its_writer_and_by_others(trial: Trial, another: Reopen) -> None:
    trial.write_checkpoint(make_checkpoint(3), fill)
    for is_writer in (True, False):
        # The writer's may not be in the store yet; another one comes when it is.
        found = trial if is_writer else another().trial("t0000")
        with found.reading_checkpoint(3) as folder:
            assert verify_checkpoint(folder) == make_checkpoint(3)
            assert (folder / "state" / "weights").read_text() == "abc"
        with found.reading_checkpoint(4) as folder:
            assert not folder.exists()


def test_a_checkpoint_is_seen_when_it_is_whole(trial: Trial, another: Reopen) -> None:
    seen = []

    def look_and_fill(folder: Path) -> None:
        seen.append((list(folder.iterdir()), numbers(another)))
        fill(folder)

    trial.write_checkpoint(make_checkpoint(1), look_and_fill)
    assert seen == [([], [])]
    assert numbers(another) == [1]


def test_a_checkpoint_that_was_not_written_whole_is_not_there(trial: Trial, another: Reopen) -> None:
    def fails(folder: Path) -> None:
        fill(folder, "other")
        raise OSError(28, "No space left on device")

    trial.write_checkpoint(make_checkpoint(3), fill)
    for iteration in (4, 3):  # 3: where it would replace one
        with pytest.raises(OSError, match="No space"):
            trial.write_checkpoint(make_checkpoint(iteration), fails)
    assert numbers(another) == [3]
    assert (trial.checkpoint_folder(3) / "state" / "weights").read_text() == "abc"


@ON_DISK
def test_of_a_checkpoint_whose_writer_is_killed_nothing_is_seen_and_the_next_owner_clears_it_away(
    harness: Harness, trial: Trial, another: Reopen
) -> None:
    trial.write_checkpoint(make_checkpoint(3), fill)
    before = harness.keys("mine")
    killed(lambda die: trial.write_checkpoint(make_checkpoint(4), lambda folder: in_turn(folder, die)))
    assert numbers(another) == [3]
    trial.remove_leftovers()
    assert harness.keys("mine") == before


def test_a_checkpoint_is_replaced_and_deleted(trial: Trial, another: Reopen) -> None:
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
    ("key", "content"),
    [
        ("state/weights", b"abd"),
        ("state/weights", b""),
        ("state/weights", None),
        ("state/more", b""),
        ("manifest.json", None),
        ("manifest.json", b"{"),
        ("manifest.json", b"{}"),
    ],
)
def test_a_damaged_checkpoint_is_found_before_it_is_read(
    harness: Harness, sweep: Sweep, another: Reopen, key: str, content: bytes | None
) -> None:
    sweep.trial("t0000").write_checkpoint(make_checkpoint(3), fill)
    trial = another().trial("t0000")
    if content is None:
        harness.remove("mine", PLACE + key)
    else:
        harness.put("mine", PLACE + key, content)
    with pytest.raises(CheckpointError, match=key.removesuffix(".json")) as raised:
        trial.verify_checkpoint(3)
    assert "000003" in raised.value.message
    assert trial.checkpoint_iterations() == [3]


def test_an_edited_score_and_another_checkpoints_manifest_are_refused(
    harness: Harness, sweep: Sweep, another: Reopen
) -> None:
    trial = sweep.trial("t0000")
    trial.write_checkpoint(make_checkpoint(3, evaluation_return=1.0), fill)
    trial.write_checkpoint(make_checkpoint(4, evaluation_return=2.0), fill)
    data = json.loads(harness.content("mine", PLACE + "manifest.json"))
    other = harness.content("mine", PLACE.replace("3", "4") + "manifest.json")
    for manifest in (json.dumps(data | {"evaluation_return": 9.0}).encode(), other):
        harness.put("mine", PLACE + "manifest.json", manifest)
        for read in (lambda: another().trial("t0000").checkpoint(3), another().trial("t0000").checkpoints):
            with pytest.raises(CheckpointError, match="000003"):
                read()
    assert trial.checkpoint(4).evaluation_return == 2.0


def test_the_engine_that_is_named_is_in_the_manifest(harness: Harness, trial: Trial) -> None:
    trial.write_checkpoint(make_checkpoint(3), fill, engine="packed")
    assert json.loads(harness.content("mine", PLACE + "manifest.json"))["engine"] == "packed"


# -- checkpoints of others, and what was damaged


def test_a_copy_stays_when_its_checkpoint_is_deleted(sweep: Sweep, trial: Trial, another: Reopen) -> None:
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


def test_nothing_is_copied_of_a_checkpoint_that_is_damaged_or_gone(
    harness: Harness, sweep: Sweep, trial: Trial, another: Reopen
) -> None:
    other = sweep.trial("t0001")
    other.write_checkpoint(make_checkpoint(3, trial_id="t0001"), fill)
    trial.copy_checkpoint(other.checkpoint_folder(3), 7)
    harness.put("mine", PLACE.replace("t0000", "t0001") + "state/weights", b"abd")
    other = another().trial("t0001")
    before = harness.keys("mine")
    with pytest.raises(CheckpointError, match="state/weights"):
        trial.copy_checkpoint(other.checkpoint_folder(3), 7)
    with pytest.raises((OSError, NotFoundError)):
        trial.copy_checkpoint(other.checkpoint_folder(4), 7)
    assert harness.keys("mine") == before
    assert (trial.copied_checkpoint(7) / "state" / "weights").read_text() == "abc"


def test_what_is_set_aside_is_kept_and_taken_for_nothing(harness: Harness, trial: Trial, another: Reopen) -> None:
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


@ON_DISK
def test_leftovers_of_a_sweep_are_removed_and_nothing_else(harness: Harness, sweep: Sweep, trial: Trial) -> None:
    sweep.write_record(make_sweep())
    trial.write_record(make_trial(status="completed"))
    trial.write_checkpoint(make_checkpoint(3), fill)
    before = harness.keys("mine")
    killed(lambda die: trial.write_checkpoint(make_checkpoint(4), lambda folder: in_turn(folder, die)))
    running = sweep.trial("t0001")
    running.write_record(make_trial(1, status="running"))
    running.write_checkpoint(
        make_checkpoint(1, trial_id="t0001"), lambda folder: in_turn(folder, sweep.remove_leftovers)
    )
    assert running.checkpoint_iterations() == [1]
    assert {key for key in harness.keys("mine") if "t0001" not in key} == before
