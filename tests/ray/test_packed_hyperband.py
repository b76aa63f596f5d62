"""HyperBand in packs: who waits for whom, and that nobody waits for a trial that has ended."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from meeting_packs import Packs, random_scores

from tune_jobs.ray_tune import pack_state
from tune_jobs.ray_tune.hyperband import HyperBand
from tune_jobs.ray_tune.scheduling import WORST_SCORE, Decision, NobodyWaits, Standing

pytestmark = pytest.mark.ray

BAND: dict[str, Any] = {"type": "hyperband", "grace_env_steps": 200, "reduction_factor": 2.0}


def by_itself(packs: Packs, num_trials: int, seed: int) -> dict[str, tuple[str, int]]:
    """Where HyperBand ends each trial if all have a place, and one after the other comes to its next evaluation."""
    band = packs._scheduler()
    assert isinstance(band, HyperBand)
    rng = np.random.default_rng(seed)
    names = [f"t{index:04d}" for index in range(num_trials)]
    steps, over = dict.fromkeys(names, 0), dict[str, str]()
    for name in names:
        band.begins(name)
    while running := [name for name in names if name not in over and not band.waits(name)]:
        name = str(rng.choice(running))
        steps[name] += 200
        if steps[name] == 1_000:
            over[name] = "completed"
            band.gone(name)
        else:
            score = packs.score(name, steps[name] // 100)
            score = WORST_SCORE if math.isnan(score) else score
            if band.reached(Standing(name, steps[name], score, evaluated=True), NobodyWaits()) is Decision.STOP:
                over[name] = "stopped"
                band.gone(name)
        over |= dict.fromkeys(band.take_ended(), "stopped")
    assert over.keys() == set(names)
    return {name: (over[name], steps[name]) for name in names}


@pytest.mark.parametrize("seed", range(3))
def test_hyperband_ends_the_same_trials_at_the_same_env_steps_in_packs(tmp_path: Path, seed: int) -> None:
    score = random_scores(seed, 100)
    for number, (num_packs, slots) in enumerate([(1, 64), (2, 2)]):
        packs = Packs(
            tmp_path / str(number), 9, lambda name, at: math.nan if name == "t0004" else score(name, at), BAND,
            seed=seed, num_packs=num_packs, slots=slots,
        )  # fmt: skip
        expected = by_itself(packs, 9, seed)
        packs.run()
        found = {record.trial_id: (record.status, record.num_env_steps) for record in packs.records()}
        assert found == expected
    assert 2 <= sum(status == "completed" for status, _ in found.values()) <= 7
    # Nobody begins anew: who waited goes on where it was, in whichever pack.
    assert len(packs.trained()) == sum(steps // 100 for _, steps in found.values())


@pytest.mark.parametrize(("seed", "every", "slots"), [(0, 1, 9), (1, 2, 64)])
def test_a_sweep_that_is_resumed_ends_the_trials_that_it_would_have_ended(
    tmp_path: Path, seed: int, every: int, slots: int
) -> None:
    """Trials of two brackets, of which those that have ended by then are not run again."""

    def made(name: str) -> Packs:
        return Packs(
            tmp_path / name, 30, random_scores(seed, 1_000), {"type": "hyperband", "grace_env_steps": 100}, seed=seed,
            slots=slots, stop={"num_env_steps": 2_000}, evaluation={"every_iterations": every, "num_episodes": 1},
        )  # fmt: skip

    def ends(packs: Packs) -> list[tuple[str, int]]:
        return [(record.status, record.num_env_steps) for record in packs.records()]

    whole = ends(made("whole").run())
    assert 1 < sum(status == "completed" for status, _ in whole) < 6
    num_stopped = []
    for at in (300, 700, 1_300):
        packs = made(f"killed at {at}")
        packs.run(until=functools.partial(packs.has_reached, at))
        num_stopped.append(sum(status == "stopped" for status, _ in ends(packs)))
        packs.begin()
        packs.run()
        assert ends(packs) == whole, at
    assert num_stopped == sorted(set(num_stopped))
    assert num_stopped[0] > 0


def test_a_member_that_fails_does_not_hold_up_its_bracket(tmp_path: Path) -> None:
    def script(trial_id: str, iteration: int) -> None:
        if trial_id == "t0000" and iteration == 2:
            raise ZeroDivisionError

    packs = Packs(tmp_path, 6, random_scores(1), BAND, script=script, max_retries=0).run()
    assert packs.keeper.record("t0000").status == "failed"
    assert {record.status for record in packs.records()} == {"failed", "completed", "stopped"}


@pytest.mark.parametrize("slots", [2, 64])
def test_trials_whose_node_is_not_replaced_do_not_hold_up_their_bracket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slots: int
) -> None:
    monkeypatch.setattr(pack_state, "_PATIENCE_S", 0.0)
    packs = Packs(tmp_path / "lost", 4, random_scores(1, 100), BAND, slots=slots)
    for pack_id in ("p00", "p01"):
        packs.step(pack_id)
    packs.driver.moved("p01", "Node 10.0.0.7 was lost.")
    del packs.processes["p01"]
    packs.run()
    whole = Packs(tmp_path / "whole", 4, random_scores(1, 100), BAND, slots=slots).run()
    assert {record.status for record in packs.records()} == {"completed", "stopped"}
    assert packs.curves() == whole.curves()


@pytest.mark.parametrize("is_up", [False, True])
def test_who_is_ended_while_its_process_is_gone_is_not_trained_again_and_holds_up_nobody(
    tmp_path: Path, is_up: bool
) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), BAND, max_retries=3)
    for number in range(2):
        for _ in range(6):
            packs.step("p00")
        packs.driver.died("p00", "killed")
        if number == 0 or is_up:
            packs.starts("p00")
    # Both have been where they wait, and the second one has no place now: each has to go on alone.
    assert [packs.keeper.record(name).num_env_steps for name in ("t0000", "t0001")] == [200, 200]
    while packs.keeper.record("t0003").num_env_steps <= 200:
        packs.step("p01")
    if not is_up:
        packs.starts("p00")
    packs.run()
    found = [(record.status, record.num_env_steps) for record in packs.records()]
    assert found == [("stopped", 200)] * 2 + [("stopped", 400), ("completed", 1_000)]


def test_who_is_ended_as_its_process_tells_that_it_waits_again_holds_up_nobody(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 4, lambda trial_id, _: float(trial_id[1:]), BAND, max_retries=3)
    for _ in range(6):
        packs.step("p00")
    packs.driver.died("p00", "killed")
    packs.starts("p00")
    process = packs.processes["p00"]
    process.trainable._arrange(process.loop)
    late = process.loop.advance(0.0, until_evaluated=True)
    assert [report.waits for report in late] == [True, True]
    while packs.keeper.record("t0003").num_env_steps <= 200:
        packs.step("p01")
    packs.driver.take("p00", late, node="here", pid=1, tell=process.trainable.assign)
    packs.run()
    assert [record.status for record in packs.records()] == ["stopped"] * 3 + ["completed"]
