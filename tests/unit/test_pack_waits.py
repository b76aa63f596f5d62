"""A member that waits in its pack: none of those seconds count for `stop`; and what its log says then."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import pytest
from fake_engine import FakeClock, FakeEngine, make_task
from fake_pack import Pack

from analysis.records import IterationRecord
from policies.acting.evaluate import Episodes, Evaluator
from policies.acting.policy import Policy
from tune_jobs.store.logs import continued_from
from tune_jobs.store.trial_store import TrialStore
from tune_jobs.training.pack_loop import PackLoop
from tune_jobs.training.packed import PackedEngine

# -- its seconds


class Slow(FakeEngine):
    """Takes ten seconds an iteration."""

    def __init__(self, clock: FakeClock) -> None:
        super().__init__()
        self.clock = clock

    def train_iteration(self) -> Any:
        self.clock.now += 10.0
        return super().train_iteration()


def test_what_a_member_waits_is_no_training(tmp_path: Path) -> None:
    clock = FakeClock()
    pack = Pack(tmp_path, lambda _: Slow(clock), clock=clock, stop={"num_iterations": 5, "time_s": 3_600})
    pack.add("t0000").advance()
    pack.loop.hold({"t0000": 200})
    pack.advance()
    assert (pack.of("t0000")[-1].waits, pack.last("t0000").time_s) == (True, 20.0)
    waited = 3 * 3_600.0
    for _ in range(3):
        # Others train, in another pack or in this one's place.
        clock.now += 3_600.0
        pack.loop.hold({"t0000": 200})
        pack.advance()
    pack.loop.hold({"t0000": 400})
    pack.advance()
    assert (pack.last("t0000").status, pack.last("t0000").time_s) == ("running", 30.0 + waited)
    clock.now += 1.0
    pack.loop.hold({"t0000": 400})
    pack.advance()
    # Not only that it trains counts, but all that comes between its iterations while it does.
    assert pack.last("t0000").time_s == 41.0 + waited
    clock.now += 3_600.0
    pack.loop.hold({})
    pack.run()
    ended = pack.last("t0000")
    assert (ended.status, ended.stop_reason, ended.time_s) == ("completed", "num_iterations 5 >= 5", 3_651.0 + waited)
    records = pack.store("t0000").read_iterations()
    # What the processors are shared by knows the pack's seconds, the stop rule those without its waits.
    assert [record.waited_s for record in records] == [0.0, 0.0, waited, waited, waited + 3_600]
    assert [record.time_s - record.waited_s for record in records] == [10.0, 20.0, 30.0, 41.0, 51.0]


def test_the_seconds_of_one_that_trains_beside_it_are_a_wait(tmp_path: Path) -> None:
    clock = FakeClock()
    pack = Pack(tmp_path, lambda _: Slow(clock), clock=clock).add("t0000", "t0001")
    pack.loop.hold({"t0000": 100})
    for _ in range(4):
        pack.advance()
    pack.loop.hold({})
    pack.advance()
    # In the first iteration and the last both train.
    assert [pack.last(trial_id).time_s for trial_id in ("t0000", "t0001")] == [70.0, 70.0]
    assert [pack.store(trial_id).read_iterations()[-1].waited_s for trial_id in ("t0000", "t0001")] == [30.0, 0.0]


def test_a_wait_is_none_of_its_seconds_after_a_restore(tmp_path: Path) -> None:
    clock = FakeClock()
    pack = Pack(tmp_path, lambda _: Slow(clock), clock=clock, stop={"num_iterations": 9, "time_s": 45})
    pack.add("t0000").advance()
    pack.loop.hold({"t0000": 100})
    pack.advance()
    clock.now += 3_600.0
    pack.loop.hold({})
    pack.advance()
    pack.stop = True
    pack.advance()
    assert pack.last("t0000").status == "paused"
    again = Pack(tmp_path, lambda _: Slow(clock), clock=clock, stop={"num_iterations": 9, "time_s": 45})
    again.add("t0000").run()
    assert again.last("t0000").stop_reason == "time_s 50 >= 45"
    assert [record.waited_s for record in again.store("t0000").read_iterations()] == [0.0, *[3_600.0] * 4]


# -- its episodes

SIZES: dict[str, dict[str, Any]] = {
    "ppo": {"train_batch_size": 128, "minibatch_size": 64, "num_epochs": 1},
    "dqn": {"train_batch_size": 8, "learning_starts": 8, "env_steps_per_iteration": 128, "replay_capacity": 512},
}


class RealPack:
    """A pack loop over the packed engine, with two trials in one stack."""

    def __init__(self, folder: Path, algorithm: str) -> None:
        self.folder = folder
        self.engine = PackedEngine("scalar")
        self.loop = PackLoop(
            self.engine, cast("Evaluator", None), self._evaluate, stop_requested=lambda: False, max_retries=0,
            wait=lambda _: None,
        )  # fmt: skip
        for seed in (5, 6):
            hyperparams = SIZES[algorithm] | {"num_envs": 2, "hidden_sizes": (8,)}
            task = make_task(folder, hyperparams=hyperparams, in_step=True)
            self.loop.add(dataclasses.replace(task, trial_id=f"t000{seed - 5}", seed=seed, algorithm=algorithm))

    def _evaluate(self, _: Evaluator, policies: Sequence[Policy]) -> list[Episodes | Exception]:
        return [Episodes((1, 2), (1.0, 2.0), (1, 2)) for _ in policies]

    def train(self, *holds: dict[str, int]) -> None:
        """One iteration each."""
        for hold_at in holds:
            self.loop.hold(hold_at)
            self.loop.advance(0.0, until_evaluated=False)

    def store(self, trial_id: str) -> TrialStore:
        return TrialStore(self.folder, trial_id)

    def episodes(self, trial_id: str) -> list[IterationRecord]:
        return [
            item.model_copy(update={"time_s": 0.0, "waited_s": 0.0}) for item in self.store(trial_id).read_iterations()
        ]


@pytest.fixture(params=SIZES)
def packs(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[RealPack, RealPack]]:
    """Two packs of the same trials, of which nobody waits in the second."""
    found = RealPack(tmp_path / "waits", request.param), RealPack(tmp_path / "goes on", request.param)
    found[1].train({}, {}, {}, {})
    yield found
    for pack in found:
        pack.engine.close()


def test_the_log_of_a_member_that_was_moved_says_from_where_its_episodes_are_others(
    packs: tuple[RealPack, RealPack],
) -> None:
    pack, other = packs
    pack.train({}, {"t0000": 256})
    assert continued_from(pack.store("t0000").newest_log()) is None
    # Only the other trains, twice.
    pack.train({"t0000": 256}, {"t0000": 256}, {}, {})
    assert continued_from(pack.store("t0000").newest_log()) == 2
    assert pack.store("t0000").newest_log().read_text().count("built from checkpoint") == 1
    assert pack.episodes("t0000")[:2] == other.episodes("t0000")[:2]
    assert pack.episodes("t0000")[2] != other.episodes("t0000")[2]
    assert continued_from(pack.store("t0001").newest_log()) is None
    assert pack.episodes("t0001")[:4] == other.episodes("t0001")


def test_members_that_wait_together_go_on_as_they_were(packs: tuple[RealPack, RealPack]) -> None:
    pack, other = packs
    at = {"t0000": 256, "t0001": 256}
    pack.train({}, at, at, at, {}, {})
    for trial_id in at:
        assert continued_from(pack.store(trial_id).newest_log()) is None
        assert pack.episodes(trial_id) == other.episodes(trial_id)
