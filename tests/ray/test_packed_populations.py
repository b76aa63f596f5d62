"""Populations in packs: who waits for whom, who goes on from whom, and what is left of it on disk."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from meeting_packs import PBT, Packs, random_scores

from analysis.records import ChangeRecord
from policies.errors import CheckpointError
from tune_jobs.ray_tune import pack_state
from tune_jobs.ray_tune.scheduling import Standing
from tune_jobs.search.gains import Evaluations, gains_of
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.pack_loop import MemberReport

pytestmark = pytest.mark.ray


# -- when, and who


@pytest.mark.parametrize("seed", range(2))
def test_it_depends_on_no_timing_and_not_on_the_number_of_packs_or_places(tmp_path: Path, seed: int) -> None:
    found = []
    for number, (num_packs, slots) in enumerate([(1, 64), (2, 64), (3, 2), (2, 1)]):
        packs = Packs(
            tmp_path / str(number), 8, random_scores(seed), PBT, seed=10 * seed + number, num_packs=num_packs,
            slots=slots,
        ).run()  # fmt: skip
        assert {record.status for record in packs.records()} == {"completed"}
        assert {record.num_env_steps for record in packs.records()} == {1_000}
        found.append((packs.changes(), packs.curves(), sorted(packs.trained())))
    assert all(one == found[0] for one in found)
    assert sum(map(len, found[0][0].values())) >= 2


def test_all_are_compared_by_what_they_have_at_the_same_env_steps(tmp_path: Path) -> None:
    # At 400 env steps the first is the worst, at 800 the last; nobody is compared by an older score.
    scores = {4: [0, 5, 6, 7], 8: [4, 5, 6, 1]}
    packs = Packs(tmp_path, 4, lambda trial_id, at: float(scores.get(at, [9] * 4)[int(trial_id[1:])]), PBT).run()
    changes = packs.changes()
    assert [(name, one.iteration, one.source_trial_id) for name, found in changes.items() for one in found] == [
        ("t0000", 4, "t0003"),
        ("t0003", 8, "t0002"),
    ]


def test_a_copy_goes_on_from_what_the_better_one_has_saved_there_and_trains_with_the_new_values(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT, num_packs=1).run()
    changes = packs.changes()["t0000"]
    assert [(one.iteration, one.num_env_steps, one.source_trial_id) for one in changes] == [
        (4, 400, "t0003"), (8, 800, "t0003"),
    ]  # fmt: skip
    assert [one for one in packs.begun() if one[0] == "t0000"] == [
        ("t0000", "t0000@0"), ("t0000", "t0003@4"), ("t0000", "t0003@8"),
    ]  # fmt: skip
    rates = {iteration: lr for name, iteration, lr in packs.trained() if name == "t0000"}
    first, second = (change.after["lr"] for change in changes)
    assert rates == {at: 1e-3 if at <= 4 else first if at <= 8 else second for at in range(1, 11)}
    assert packs.store.trial("t0000").read_record().hyperparams["lr"] == second
    # Nobody else was opened a second time: who waits goes on where it is.
    assert sorted(name for name, _ in packs.begun()) == ["t0000"] * 3 + ["t0001", "t0002", "t0003"]
    assert not (packs.store.folder / "trials" / "t0000" / "copied").exists()


def test_who_waits_is_saved_there_whatever_its_score_and_its_checkpoints_are(tmp_path: Path) -> None:
    rare = {"every_iterations": 99, "keep": 0}
    packs = Packs(tmp_path, 4, lambda trial_id, at: float(trial_id[1:]) - at, PBT, checkpoints=rare).run()
    assert [one for one in packs.begun() if one[0] == "t0000"][1:] == [("t0000", "t0003@4"), ("t0000", "t0003@8")]


def test_who_waits_is_brought_to_the_store_before_others_hear_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settled = list[str]()
    monkeypatch.setattr(TrialStore, "settle", lambda self: settled.append(self.trial_id))
    packs = Packs(tmp_path, 2, lambda trial_id, _: 1.0, PBT, num_packs=1)
    process = packs.processes["p00"]
    process.trainable._arrange(process.loop)
    reports = process.loop.advance(1e9, until_evaluated=False)
    assert {report.trial_id for report in reports if report.waits} == {"t0000", "t0001"} == set(settled)


def test_a_pack_of_slower_members_is_waited_for_and_trains_meanwhile(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT)
    for _ in range(20):
        packs.step("p00")
    # The others have not begun; without them nobody is compared.
    assert {at for _, at, _ in packs.processes["p00"].engine.trained} == {1, 2, 3, 4}
    assert packs.changes() == {f"t000{index}": [] for index in range(4)}
    assert {record.status for record in packs.records()} == {"running"}
    packs.run()
    assert len(packs.changes()["t0000"]) == 2


# -- pb2

PB2 = {**PBT, "type": "pb2"}


def test_pb2_chooses_the_same_values_in_any_number_of_packs_and_other_ones_than_mutation(tmp_path: Path) -> None:
    found = []
    for number, (num_packs, slots, scheduler) in enumerate([(1, 64, PB2), (2, 2, PB2), (1, 64, PBT)]):
        packs = Packs(
            tmp_path / str(number), 8, random_scores(0), scheduler, num_packs=num_packs, slots=slots,
            stop={"num_env_steps": 2_000},
        ).run()  # fmt: skip
        found.append(packs.changes())
    ours, again, mutated = found
    assert ours == again
    assert ours != mutated
    # The first copies are of the same trials: what is chosen there goes by the first intervals alone.
    assert [[one.source_trial_id for one in each[:1]] for each in ours.values()] == [
        [one.source_trial_id for one in each[:1]] for each in mutated.values()
    ]


def test_a_resumed_pb2_knows_what_intervals_gained(tmp_path: Path) -> None:
    def until(packs: Packs, num_env_steps: int) -> Packs:
        return packs.run(until=lambda: all(one.num_env_steps >= num_env_steps for one in packs.records()))

    packs = until(Packs(tmp_path, 8, random_scores(0), PB2, stop={"num_env_steps": 2_000}), 1_400)
    before = packs.population()
    packs.begin()
    standing = Standing("t0000", 1_600, 0.0, evaluated=True)
    rngs = [np.random.default_rng(0) for _ in range(2)]
    assert before._changed(standing, "t0003", rngs[0]) == packs.population()._changed(standing, "t0003", rngs[1])
    assert len(gains_of(packs.records(), Evaluations(packs.store)([f"t000{index}" for index in range(8)]), 400)) > 16


# -- what goes wrong


class KilledError(BaseException):
    """The driver is killed here."""


def kill(*args: Any, **kwargs: Any) -> None:
    raise KilledError


def test_a_driver_killed_between_a_copy_and_its_record_leaves_the_trial_as_it_was(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT)
    with mock.patch.object(packs.keeper, "change", kill), pytest.raises(KilledError):
        packs.run()
    assert (packs.store.folder / "trials" / "t0000" / "copied" / "000004").is_dir()
    packs.keeper.close()
    assert packs.store.trial("t0000").read_record().changes == ()
    packs.begin()
    packs.run()
    # It went on from its own checkpoint, with the values that it had; a copy came at the next comparison.
    assert [one for one in packs.begun() if one[0] == "t0000"] == [("t0000", "t0000@4"), ("t0000", "t0003@8")]
    assert [lr for name, at, lr in packs.trained() if name == "t0000" and at <= 8] == [1e-3] * 4
    assert {record.status for record in packs.records()} == {"completed"}


def test_a_driver_killed_after_the_record_goes_on_with_the_copy_and_its_values(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT)
    keep = packs.keeper.change

    def then_kill(*args: Any) -> None:
        keep(*args)
        raise KilledError

    with mock.patch.object(packs.keeper, "change", then_kill), pytest.raises(KilledError):
        packs.run()
    (change,) = packs.store.trial("t0000").read_record().changes
    packs.begin()
    packs.run()
    assert packs.begun()[0] == ("t0000", "t0003@4")
    assert packs.changes()["t0000"][0] == change.model_copy(update={"time": 0.0})
    assert [lr for name, at, lr in packs.trained() if name == "t0000" and at <= 8] == [change.after["lr"]] * 4


def test_a_checkpoint_that_cannot_be_copied_leaves_the_trial_as_it_is(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT)
    damaged = mock.Mock(side_effect=CheckpointError("It is damaged."))
    with mock.patch("tune_jobs.ray_tune.population.copy_latest_checkpoint", damaged):
        packs.run()
    assert damaged.call_count == 2
    assert packs.changes()["t0000"] == []
    assert {record.status for record in packs.records()} == {"completed"}
    assert "t0000 goes on as it is: It is damaged." in caplog.text


def test_a_member_that_fails_is_waited_for_no_longer_and_nobody_goes_on_from_it(tmp_path: Path) -> None:
    def script(trial_id: str, iteration: int) -> None:
        if trial_id == "t0003" and iteration == 4:
            raise ZeroDivisionError

    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT, script=script, max_retries=0).run()
    assert [record.status for record in packs.records()] == ["completed"] * 3 + ["failed"]
    assert [one.source_trial_id for one in packs.changes()["t0000"]] == ["t0002"] * 2


def test_a_member_that_is_retried_is_waited_for_and_nothing_else_changes(tmp_path: Path) -> None:
    failed = list[int]()

    def script(trial_id: str, iteration: int) -> None:
        if trial_id == "t0003" and iteration == 4 and not failed:
            failed.append(1)
            raise ZeroDivisionError

    score = random_scores(3)
    packs = Packs(tmp_path / "failing", 6, score, PBT, script=script, max_retries=1).run()
    assert packs.changes() == Packs(tmp_path / "whole", 6, score, PBT).run().changes()
    assert packs.keeper.record("t0003").num_failures == 1


def test_scores_that_are_no_numbers_are_the_worst_and_are_not_copied(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: math.nan if trial_id == "t0003" else 1.0, PBT).run()
    assert {name: len(found) for name, found in packs.changes().items()} == {
        "t0000": 0, "t0001": 0, "t0002": 0, "t0003": 2,
    }  # fmt: skip


@pytest.mark.parametrize("seed", range(2))
def test_a_pack_that_dies_while_its_members_wait_is_waited_for_again(tmp_path: Path, seed: int) -> None:
    score = random_scores(seed)
    packs = Packs(tmp_path / "dying", 4, score, PBT, seed=seed, max_retries=3)
    for _ in range(10):
        packs.step("p00")
    packs.driver.died("p00", "killed")
    packs.starts("p00")
    packs.run()
    assert packs.changes() == Packs(tmp_path / "whole", 4, score, PBT).run().changes()
    # From where they waited, not from before.
    assert {("t0000", "t0000@4"), ("t0001", "t0001@4")} <= set(packs.begun())
    assert sorted(at for name, at, _ in packs.trained() if name == "t0000") == list(range(1, 11))


def test_a_member_that_has_to_go_on_alone_gets_a_pack_while_the_others_wait(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), PBT, max_retries=3)
    for _ in range(2):
        packs.driver.died("p00", "killed")
        packs.starts("p00")
    packs.run()
    assert {record.status for record in packs.records()} == {"completed"}
    assert len(packs.changes()["t0000"]) == 2


@pytest.mark.parametrize("comes_late", [False, True])
@pytest.mark.parametrize("slots", [2, 64])
def test_trials_whose_node_is_not_replaced_get_the_places_of_those_that_wait_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slots: int, comes_late: bool
) -> None:
    score = random_scores(1)
    packs = Packs(tmp_path / "lost", 4, score, PBT, slots=slots)
    for pack_id in ("p00", "p01"):
        packs.step(pack_id)
    packs.driver.moved("p01", "Node 10.0.0.7 was lost.")
    del packs.processes["p01"]
    for _ in range(20):
        packs.step("p00")
    # Another node may come within minutes.
    assert packs.store.pack("p01").read().trial_ids == ("t0002", "t0003")
    assert not packs.driver.is_of_no_use("p01")
    monkeypatch.setattr(pack_state, "_PATIENCE_S", 0.0)
    packs.step("p00")
    assert packs.store.pack("p01").read().trial_ids == ()
    assert packs.driver.is_of_no_use("p01") == (slots == 64)
    if comes_late:
        packs.starts("p01")
    packs.run()
    whole = Packs(tmp_path / "whole", 4, score, PBT, slots=slots).run()
    assert {record.status for record in packs.records()} == {"completed"}
    assert (packs.changes(), packs.curves()) == (whole.changes(), whole.curves())


def test_a_sweep_is_not_over_while_one_that_gave_its_place_away_waits_for_one_that_fails_for_good(
    tmp_path: Path,
) -> None:
    packs = Packs(tmp_path, 2, lambda trial_id, _: 1.0, PBT, num_packs=1, slots=1, max_retries=0)
    packs.run(until=lambda: packs.keeper.record("t0000").status == "paused")
    packs.driver.died("p00", "killed")
    assert packs.keeper.record("t0001").status == "failed"
    assert not packs.driver.is_finished
    packs.starts("p00")
    packs.run()
    assert [record.status for record in packs.records()] == ["completed", "failed"]


def test_what_is_told_of_one_that_gave_its_place_away_is_known_already(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 2, lambda trial_id, _: 1.0, PBT, num_packs=1, slots=1)
    packs.run(until=lambda: packs.keeper.record("t0000").status == "paused")
    known = packs.keeper.record("t0000")
    packs.driver.take("p00", [MemberReport("t0000", error="late", retried=False)], node="here", pid=1)
    assert packs.keeper.record("t0000") == known


def test_the_last_one_of_a_population_goes_on_by_itself(tmp_path: Path) -> None:
    def script(trial_id: str, iteration: int) -> None:
        if trial_id != "t0001" and iteration == 3:
            raise ZeroDivisionError

    packs = Packs(tmp_path, 3, lambda trial_id, _: 1.0, PBT, script=script, max_retries=0).run()
    assert [record.status for record in packs.records()] == ["failed", "completed", "failed"]
    assert packs.keeper.record("t0001").num_env_steps == 1_000


def test_stop_rules_act_on_a_copied_member_by_its_own_counts(tmp_path: Path) -> None:
    # From 800 env steps on, what t0000 reaches with the copied weights ends it.
    packs = Packs(
        tmp_path, 4, lambda name, at: 99.0 if (name, at) == ("t0000", 10) else float(name[1:]), PBT,
        stop={"num_env_steps": 1_600, "evaluation_return": 50.0},
    ).run()  # fmt: skip
    ended = {record.trial_id: (record.num_env_steps, record.stop_reason) for record in packs.records()}
    assert ended["t0000"] == (1_000, "evaluation_return 99 >= 50")
    assert ended["t0001"] == (1_600, "num_env_steps 1600 >= 1600")


def test_a_stop_request_pauses_those_that_wait_and_those_that_gave_their_place_away(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 6, lambda trial_id, _: float(trial_id[1:]), PBT, num_packs=2, slots=2)
    packs.run(until=lambda: any(record.status == "paused" for record in packs.records()))
    packs.store.request_stop()
    packs.run()
    assert {record.status for record in packs.records()} <= {"paused", "pending"}
    packs.store.clear_stop_request()
    packs.begin()
    packs.run()
    assert {record.status for record in packs.records()} == {"completed"}


def times(changes: dict[str, list[ChangeRecord]]) -> list[int]:
    return sorted({one.num_env_steps for found in changes.values() for one in found})


def test_where_evaluations_are_rarer_than_comparisons_the_next_evaluation_counts(tmp_path: Path) -> None:
    scheduler = {**PBT, "perturb_every_env_steps": 250}
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), scheduler).run()
    assert times(packs.changes()) == [400, 800]
