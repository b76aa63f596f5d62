"""Who trains in which pack, decided without any process: what packs report is made up here."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from scripted_packs import make_sweep

from analysis.records import CheckpointRecord
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.ray_tune.early_stopping import build_scheduler
from tune_jobs.ray_tune.pack_driver import PackDriver
from tune_jobs.ray_tune.pack_state import PackState
from tune_jobs.ray_tune.pack_trainable import PackTrainable
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Assignment
from tune_jobs.store.pack_files import PackFiles
from tune_jobs.store.progress import Progress
from tune_jobs.store.record_keeper import RecordKeeper
from tune_jobs.training.pack_loop import MemberReport

pytestmark = pytest.mark.ray


Report = MemberReport | tuple[int, float | str]
"""What a member tells: see `Driven.tell`."""


class Driven:
    """A driver whose packs are up, and what they would report."""

    def __init__(
        self,
        folder: Path,
        num_trials: int,
        *,
        num_packs: int = 2,
        slots: int = 2,
        choose: Callable[[str], None] | None = None,
        more_packs: int = 0,
        **spec: Any,
    ) -> None:
        self.store = make_sweep(folder / "mine", num_trials, **spec)
        names = [f"t{index:04d}" for index in range(num_trials)]
        self.spec = SweepSpec.model_validate(self.store.read_record().spec)
        self.keeper = RecordKeeper(self.store, names, lambda record: None)
        plan = PackPlan(num_packs, slots, 1.0, 0.0, tuple(names), "scalar", None, 0)
        scheduler = build_scheduler(self.spec.scheduler, self.spec.stop.num_env_steps)
        self.driver = PackDriver(
            self.store, self.spec, plan, names, scheduler=scheduler, keeper=self.keeper, choose=choose,
            more_packs=more_packs,
        )  # fmt: skip
        for pack_id in self.driver.pack_ids[:num_packs]:
            self.driver.started(pack_id)

    def assigned(self, pack_id: str = "p00") -> list[int]:
        """Trial numbers in a pack's file."""
        return [int(name[1:]) for name in PackFiles(self.store.folder, pack_id).read().trial_ids]

    def tell(self, pack_id: str = "p00", /, **reports: Report) -> bool:
        """Reports of a pack, by trial id: env steps, with a score, or a status, or a failure."""
        return self.driver.take(pack_id, [self.report(*item) for item in reports.items()], node="here", pid=1)

    def report(self, trial_id: str, what: Report) -> MemberReport:
        if isinstance(what, MemberReport):
            return what
        steps, told = what
        status, score = (told, 1.0) if isinstance(told, str) else ("running", told)
        progress = Progress(
            num_iterations=steps // 100, num_env_steps=steps, num_episodes=1, time_s=1.0, training_return=None,
            evaluation_return=score, best_evaluation_return=score, best_iteration=None, evaluated=True, status=status,
        )  # fmt: skip
        return MemberReport(trial_id, progress)

    def status(self, number: int) -> tuple[str, int]:
        record = self.keeper.record(f"t{number:04d}")
        return record.status, record.num_failures


def failure(number: int, *, retried: bool) -> MemberReport:
    return MemberReport(f"t{number:04d}", error="it broke", retried=retried)


# -- handing out


def test_a_pack_that_reports_is_told_what_it_trains_on(tmp_path: Path) -> None:
    driven, told = Driven(tmp_path, 6), list[tuple[str, ...]]()

    def tell(**reports: Report) -> None:
        made = [driven.report(*item) for item in reports.items()]
        driven.driver.take("p00", made, node="here", pid=1, tell=lambda what: told.append(what.trial_ids))

    # It has read that, and need not look there again.
    tell(t0000=(100, 1.0))
    assert told == [("t0000", "t0001")]
    tell(t0000=(200, 1.0))
    tell(t0000=(1000, "completed"))
    assert told[1:] == [("t0001", "t0004")]
    # The next process of the pack reads it in the storage, until it reports.
    driven.driver.died("p00", "killed")
    driven.driver.died("p00", "killed")
    assert driven.assigned() == [1]
    assert told[2:] == []
    tell(t0001=(100, 1.0))
    tell(t0001=(1000, "completed"))
    assert told[2:] == [("t0001",), ("t0004",)]


def test_what_a_process_is_told_goes_before_what_it_could_read() -> None:
    pack: Any = PackTrainable.__new__(PackTrainable)
    pack._first, pack._told, added = None, None, list[str]()
    pack._owner = SimpleNamespace(held=contextlib.nullcontext)
    pack._files = SimpleNamespace(read=lambda: Assignment(("t0000",)))
    pack._reader = SimpleNamespace(read=lambda trial_id: trial_id)
    loop: Any = SimpleNamespace(trial_ids=(), add=lambda task, _: added.append(task), hold=lambda _: None)
    pack._arrange(loop)
    pack.assign(Assignment(("t0001",)))
    pack._arrange(loop)
    assert added == ["t0000", "t0001"]


@pytest.mark.parametrize(
    ("num_trials", "slots", "shares"),
    [(5, 64, [[0, 1, 2], [3, 4]]), (9, 2, [[0, 1], [2, 3]]), (1, 8, [[0]]), (2, 1, [[0], [1]])],
)
def test_trials_are_spread_evenly_in_their_order(
    tmp_path: Path, num_trials: int, slots: int, shares: list[list[int]]
) -> None:
    driven = Driven(tmp_path, num_trials, slots=slots)
    assert [driven.assigned(pack_id) for pack_id in driven.driver.pack_ids] == shares
    assert not driven.driver.is_finished


def test_free_slots_are_filled_until_nobody_waits(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 6)
    assert driven.tell(t0000=(1000, "completed")) is False
    assert driven.assigned() == [1, 4]
    assert driven.status(4) == ("running", 0)
    driven.tell("p01", t0002=(1000, "completed"), t0003=(1000, "failed"))
    assert driven.assigned("p01") == [5]
    assert driven.tell("p01", t0005=(1000, "completed")) is True
    assert not driven.driver.is_finished
    assert driven.tell(t0001=(1000, "completed"), t0004=(1000, "completed")) is True
    assert driven.driver.is_finished
    assert [driven.status(number)[0] for number in (0, 3)] == ["completed", "failed"]


@pytest.mark.parametrize(
    ("num_trials", "more_packs", "num_packs"), [(4, 9, 2), (5, 9, 3), (9, 9, 5), (9, 1, 3), (1, 9, 1)]
)
def test_there_are_no_more_packs_than_trials_that_wait_would_fill(
    tmp_path: Path, num_trials: int, more_packs: int, num_packs: int
) -> None:
    assert len(Driven(tmp_path, num_trials, more_packs=more_packs).driver.pack_ids) == num_packs


def test_a_pack_on_a_node_that_joins_takes_trials_that_wait(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 9, more_packs=9)
    assert [driven.assigned(name) for name in driven.driver.pack_ids] == [[0, 1], [2, 3], [], [], []]
    driven.driver.started("p02")
    assert driven.assigned("p02") == [4, 5]
    assert driven.status(4) == ("running", 0)
    driven.tell("p02", t0004=(1000, "completed"))
    assert driven.assigned("p02") == [5, 6]
    # Those that train stay where they are.
    assert [driven.assigned("p00"), driven.assigned("p01")] == [[0, 1], [2, 3]]
    assert not driven.driver.is_of_no_use("p03")
    driven.tell(t0000=(1000, "completed"), t0001=(1000, "completed"))
    assert driven.assigned() == [7, 8]
    assert [driven.driver.is_of_no_use(name) for name in driven.driver.pack_ids] == [False, False, False, True, True]
    # One that gets its node too late has nothing to do, and none that has none is waited for.
    driven.driver.started("p03")
    assert driven.tell("p03") is True
    driven.driver.closed("p03")
    driven.tell(t0007=(1000, "completed"), t0008=(1000, "completed"))
    driven.tell("p01", t0002=(1000, "completed"), t0003=(1000, "completed"))
    assert not driven.driver.is_finished
    driven.tell("p02", t0005=(1000, "completed"), t0006=(1000, "completed"))
    assert driven.driver.is_finished


def test_a_pack_on_a_node_that_joins_takes_trials_whose_node_was_lost_first(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 7, more_packs=9)
    driven.driver.moved("p01", "Node 192.0.2.1 was lost.")
    assert driven.status(2)[0] != "running"
    driven.driver.started("p02")
    assert [driven.assigned("p01"), driven.assigned("p02")] == [[], [2, 3]]
    assert driven.status(2) == ("running", 0)
    # Now the lost one waits for a node, and goes on as one that joins.
    driven.driver.started("p01")
    assert driven.assigned("p01") == [4, 5]


def test_points_are_chosen_when_trials_are_handed_out_and_once(tmp_path: Path) -> None:
    chosen: list[str] = []
    driven = Driven(tmp_path, 6, choose=chosen.append)
    assert chosen == ["t0000", "t0001", "t0002", "t0003"]
    driven.tell(t0000=(1000, "completed"))
    driven.driver.died("p00", "killed")
    assert chosen[4:] == ["t0004"]


# -- schedulers


ASHA = {"type": "asha", "grace_env_steps": 200, "reduction_factor": 2}


def test_who_is_ended_makes_room_before_it_has_left(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 4, num_packs=1, scheduler=ASHA)
    driven.tell(t0000=(200, 9.0), t0001=(200, 1.0))
    # The pack lets 1 go first; it is no member any more to whoever reads the file.
    assert driven.assigned() == [0, 2]
    assert driven.status(1) == ("running", 0)
    driven.tell(t0001=(200, "stopped"), t0002=(100, 3.0))
    assert driven.keeper.record("t0001").stop_reason == "scheduler, at 200 env steps"
    assert driven.assigned() == [0, 2]


@pytest.mark.parametrize("how", ["fails", "dies"])
def test_who_is_ended_and_cannot_save_is_ended_all_the_same(tmp_path: Path, how: str) -> None:
    driven = Driven(tmp_path, 2, num_packs=1, scheduler=ASHA, max_retries=0)
    driven.tell(t0000=(200, 9.0), t0001=(200, 1.0))
    saved = CheckpointRecord(trial_id="t0001", iteration=2, num_env_steps=200, evaluation_return=1.0)
    driven.store.trial("t0001").write_checkpoint(saved, lambda folder: None)
    # A newer one that is damaged costs neither the record nor the driver.
    driven.store.trial("t0001").checkpoint_folder(3).mkdir()
    if how == "fails":
        driven.tell(t0001=failure(1, retried=True))
    else:
        driven.driver.died("p00", "killed")
    record = driven.keeper.record("t0001")
    assert (record.status, record.num_failures, record.checkpoints) == ("stopped", 0, (saved,))
    # It may have been the ended one that ended the process: the other is tried again, without any retries left.
    assert driven.status(0) == (("running", 0) if how == "fails" else ("pending", 1))
    assert driven.assigned() == [0]


def test_whoever_has_ended_is_compared_with_too(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 5, num_packs=1, slots=5, scheduler=ASHA)
    # With what it had at its end.
    driven.tell(t0000=(200, "completed"), t0001=(200, 0.5))
    assert driven.assigned() == [2, 3, 4]
    # 0 and 1, which is ended at the second rung, don't count at the first one, where they were never seen.
    driven = Driven(tmp_path / "b", 3, num_packs=1, slots=3, scheduler=ASHA)
    driven.tell(t0000=(400, 9.0), t0001=(400, 1.0))
    assert driven.assigned() == [0, 2]
    driven.tell(t0002=(200, 0.5))
    assert driven.assigned() == [0, 2]
    driven.tell(t0002=(400, 0.5))
    assert driven.assigned() == [0]


def test_a_report_without_an_evaluation_is_compared_with_nothing(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 2, num_packs=1, scheduler=ASHA)
    driven.tell(t0000=(200, 9.0))
    report = driven.report("t0001", (200, 1.0))
    silent = MemberReport("t0001", progress=Progress(**{**vars(report.progress), "evaluated": False}))
    driven.tell(t0001=silent)
    assert driven.assigned() == [0, 1]


# -- failures


def test_failures_of_its_own_are_known_to_the_next_process(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 2, num_packs=1, max_retries=3)
    driven.tell(t0001=failure(1, retried=True))
    assert driven.status(1) == ("running", 1)
    assert PackFiles(driven.store.folder, "p00").read().num_failures == {"t0001": 1}
    driven.tell(t0001=failure(1, retried=False))
    assert driven.status(1) == ("failed", 2)
    assert driven.assigned() == [0]


def test_who_was_in_two_packs_that_died_goes_on_alone(tmp_path: Path) -> None:
    chosen: list[str] = []
    driven = Driven(tmp_path, 5, num_packs=1, slots=2, max_retries=0, choose=chosen.append)
    driven.driver.died("p00", "killed")
    # Once may be anybody's fault: all are tried again.
    assert driven.assigned() == [0, 1]
    assert [driven.status(number) for number in (0, 1, 2)] == [("pending", 1), ("pending", 1), ("pending", 0)]
    driven.driver.started("p00")
    driven.tell(t0000=(1000, "completed"))
    assert driven.assigned() == [1, 2]
    driven.driver.died("p00", "killed")
    # 2 was in one such pack only, and 3 takes the other's slot.
    assert driven.assigned() == [2, 3]
    assert driven.status(1) == ("pending", 2)
    driven.driver.started("p00")
    driven.tell(t0002=(1000, "completed"), t0003=(1000, "completed"))
    # The pack is empty: now 1 has it for itself, though somebody waits.
    assert driven.assigned() == [1]
    driven.tell(t0001=(100, 1.0))
    assert driven.assigned() == [1]
    driven.driver.died("p00", "killed by 1")
    # It was nobody else.
    assert driven.status(1) == ("failed", 3)
    assert driven.assigned() == [4]
    driven.driver.started("p00")
    assert driven.tell(t0004=(1000, "completed")) is True
    assert driven.driver.is_finished
    assert chosen == [f"t000{number}" for number in range(5)]


def test_a_pack_of_one_has_the_retries_of_a_trial(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 1, num_packs=1, max_retries=2)
    statuses = []
    for _ in range(3):
        assert not driven.driver.is_finished
        driven.driver.died("p00", "killed")
        statuses.append(driven.status(0))
    assert statuses == [("pending", 1), ("pending", 2), ("failed", 3)]
    assert driven.driver.is_finished
    assert driven.keeper.record("t0000").error == "killed"


# -- the end of the run


def test_nobody_is_handed_out_any_more_when_the_sweep_stops(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 6)
    driven.store.request_stop()
    assert driven.tell(t0000=(300, "paused"), t0001=failure(1, retried=True)) is True
    assert [driven.status(number) for number in (0, 1, 4)] == [("paused", 0), ("pending", 1), ("pending", 0)]
    assert driven.keeper.running == {"t0002", "t0003"}
    # The other did not save in time.
    driven.driver.closed("p01")
    assert [driven.status(number)[0] for number in (2, 3)] == ["paused", "paused"]
    assert driven.keeper.running == set()


def test_who_leaves_for_a_stop_of_which_the_driver_has_not_heard_is_paused(tmp_path: Path) -> None:
    """In an object store, answers are some seconds old: it would have ended for good, as if a scheduler had done it."""
    driven = Driven(tmp_path, 6)
    assert driven.tell(t0000=(300, "paused")) is False
    assert driven.status(0) == ("paused", 0)
    # Nobody gets its place.
    assert driven.assigned() == [1]
    driven.tell(t0001=(300, "paused"))
    assert [driven.status(number)[0] for number in (1, 4)] == ["paused", "pending"]


def test_a_member_that_another_process_took_waits_again_and_has_not_failed(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 3, num_packs=1)
    driven.tell(t0000=(100, 1.0))
    assert not driven.tell(t0000=MemberReport("t0000", lost=True))
    # The one that waited has its place.
    assert driven.assigned() == [1, 2]
    assert driven.status(0) == ("paused", 0)
    driven.tell(t0001=(200, "completed"))
    assert driven.assigned() == [2, 0]
    assert driven.status(0) == ("running", 0)


def test_a_pack_that_another_process_is_has_not_died(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 2, num_packs=1)
    driven.driver.lost("p00")
    assert driven.assigned() == [0, 1]
    assert [driven.status(number) for number in (0, 1)] == [("paused", 0)] * 2
    driven.driver.started("p00")
    # Nor does it count later, for who goes on alone.
    driven.driver.died("p00", "killed")
    assert driven.assigned() == [0, 1]


def test_the_loss_of_a_packs_node_is_no_failure_and_who_was_to_end_has_ended(tmp_path: Path) -> None:
    driven = Driven(tmp_path, 4, num_packs=1, slots=3, scheduler={"type": "asha", "grace_env_steps": 100})
    driven.tell(t0000=(200, 5.0))
    driven.tell(t0001=(200, 1.0))
    assert driven.assigned() == [0, 2, 3]
    assert driven.driver.reached("p00") == (("t0000", 0), ("t0001", 0), ("t0002", 0), ("t0003", 0))
    for _ in range(9):
        driven.driver.moved("p00", "Node 10.0.0.7 (1234) was lost.")
    records = driven.keeper.all_records()
    assert [record.status for record in records] == ["pending", "stopped", "pending", "pending"]
    assert [record.num_failures for record in records] == [0] * 4
    assert (
        records[0].notes[0] == "Node 10.0.0.7 (1234) was lost. The trial went on elsewhere, from its latest checkpoint."
    )
    assert driven.assigned() == [0, 2, 3]
    assert not driven.driver.is_finished


def test_the_next_process_of_a_pack_finds_written_what_the_last_one_was_told() -> None:
    writes, told = list[tuple[tuple[str, ...], bool]](), list[Assignment]()
    files: Any = SimpleNamespace(write=lambda assignment, soon: writes.append((assignment.trial_ids, soon)))
    pack, assignment = PackState(files), Assignment(("t0000",))
    pack.tell = told.append
    for _ in range(2):
        pack.assign(assignment, contextlib.nullcontext)
    assert (writes, told) == ([(("t0000",), True)], [assignment])
    pack.tell = None
    pack.assign(assignment, contextlib.nullcontext)
    assert writes[1:] == [(("t0000",), False)]
