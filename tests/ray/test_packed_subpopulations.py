"""Sub-populations in packs: when each selects, who goes on from whom, and what a driver that was killed still knows."""

from __future__ import annotations

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from meeting_packs import Packs, Score, random_scores

from analysis.records import ChangeRecord
from analysis.tables import describe_changes

pytestmark = pytest.mark.ray

MF: dict[str, Any] = {"type": "pbt", "perturb_every_env_steps": 200, "frequencies": [1, 2]}
"""With evaluations every 200 env steps, to 1,000: the faster one selects at 200, 400, 600 and 800, the slower at 400
and 800."""
FAST, SLOW = ("t0000", "t0003", "t0004", "t0007"), ("t0001", "t0002", "t0005", "t0006")


def ranked(*names: str) -> Score:
    """Scores by which these are the best, the best first, and the others equal."""
    return lambda trial_id, _: float(len(names) - names.index(trial_id) if trial_id in names else 0)


def times(packs: Packs, names: tuple[str, ...]) -> list[int]:
    return sorted({one.num_env_steps for name in names for one in packs.changes()[name]})


def of(packs: Packs, num_env_steps: int) -> dict[str, ChangeRecord]:
    found = packs.changes().items()
    return {name: one for name, changes in found for one in changes if one.num_env_steps == num_env_steps}


@pytest.mark.parametrize("seed", range(2))
def test_each_selects_at_its_own_frequency_in_any_number_of_packs(tmp_path: Path, seed: int) -> None:
    found = []
    for number, (num_packs, slots) in enumerate([(1, 64), (2, 64), (3, 2)]):
        packs = Packs(
            tmp_path / str(number), 8, random_scores(seed, 40), MF, seed=10 * seed + number, num_packs=num_packs,
            slots=slots,
        ).run()  # fmt: skip
        assert {record.num_env_steps for record in packs.records()} == {1_000}
        found.append((packs.changes(), packs.curves(), sorted(packs.trained())))
    assert all(one == found[0] for one in found)
    assert times(packs, FAST) == [200, 400, 600, 800]
    assert times(packs, SLOW) == [400, 800]


def test_the_worst_go_on_from_their_own_best_alone(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 8, random_scores(1, 40), MF).run()
    mutated = {
        (name, one.source_trial_id)
        for name, found in packs.changes().items()
        for one in found
        if one.values_trial_id is None
    }
    assert mutated
    assert all({name, source} <= set(FAST) or {name, source} <= set(SLOW) for name, source in mutated)


def test_a_faster_one_takes_a_trial_of_a_slower_one_whole(tmp_path: Path) -> None:
    # The best is a slower one; of the faster ones t0004 is third, and so open to it.
    packs = Packs(tmp_path, 8, ranked("t0001", "t0002", "t0005", "t0000", "t0003", "t0004", "t0006", "t0007"), MF)
    packs.run()
    (change, *_) = packs.changes()["t0004"]
    assert (change.num_env_steps, change.source_trial_id, change.source_iteration) == (200, "t0001", 2)
    assert change.values_trial_id == "t0001"
    assert change.after == {"lr": 1e-3 + 1e-4}
    assert ("t0004", "t0001@2") in packs.begun()
    assert [lr for name, at, lr in packs.trained() if name == "t0004" and at in (3, 4)] == [change.after["lr"]] * 2
    assert packs.store.trial("t0004").read_record().hyperparams["lr"] == packs.changes()["t0004"][-1].after["lr"]


def test_a_slower_one_takes_weights_of_a_faster_one_and_values_of_its_own_best(tmp_path: Path) -> None:
    # The best is a faster one; of the slower ones t0005 is third, and t0001 the best.
    packs = Packs(tmp_path, 8, ranked("t0003", "t0001", "t0002", "t0005", "t0006", "t0000", "t0004", "t0007"), MF)
    packs.run()
    (change, *_) = packs.changes()["t0005"]
    assert (change.num_env_steps, change.source_trial_id, change.source_iteration) == (400, "t0003", 4)
    assert change.values_trial_id == "t0001"
    assert change.after == {"lr": 1e-3 + 1e-4}
    assert ("t0005", "t0003@4") in packs.begun()
    assert [lr for name, at, lr in packs.trained() if name == "t0005"][:6] == [1.5e-3] * 4 + [change.after["lr"]] * 2
    (record,) = [record for record in packs.records() if record.trial_id == "t0005"]
    assert (describe_changes(record) or "").startswith(
        "at 400 env steps from t0003, values of t0001: lr 0.0011; at 800"
    )


def test_who_selects_seldom_keeps_what_it_has_meanwhile_and_is_saved_for_the_others(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 8, random_scores(2, 40), {**MF, "frequencies": [1, 4]}).run()
    assert times(packs, SLOW) == [800]
    first = of(packs, 200)
    assert first
    # Whoever comes from a slower one at 200 comes as it is there.
    assert {one.source_iteration for one in first.values()} == {2}
    opened = [weights for name, weights in packs.begun() if name in SLOW]
    assert {weights for weights in opened if not weights.endswith("@8")} == {f"{name}@0" for name in SLOW}


@pytest.mark.parametrize("frequencies", [[1], [1, 2]])
@pytest.mark.parametrize("stops", [False, True])
def test_a_sweep_that_is_resumed_is_compared_where_it_would_have_been(
    tmp_path: Path, frequencies: list[int], stops: bool
) -> None:
    score, scheduler = random_scores(3, 40), {**MF, "frequencies": frequencies}
    whole = Packs(tmp_path / "whole", 8, score, scheduler).run()
    packs = Packs(tmp_path / "killed", 8, score, scheduler)
    # Those of one pack wait at 400, where all are compared, those of the other have not come there.
    packs.run(until=lambda: {400} < {one.num_env_steps for one in packs.records()})
    if stops:
        packs.store.request_stop()
        packs.run()
        packs.store.clear_stop_request()
    assert not of(packs, 400)
    before = {record.trial_id for record in packs.records() if record.num_env_steps == 400}
    assert 0 < len(before) < 8
    packs.begin()
    packs.run()
    assert {record.status for record in packs.records()} == {"completed"}
    assert packs.changes() == whole.changes()


@pytest.mark.parametrize(
    ("every", "interval", "points"),
    [
        (100, 240, [(300, 5), (400, 8), (1_200, 5)]),
        (300, 200, [(200, 8), (600, 5), (1_100, 8)]),
        (400, 250, [(300, 8), (800, 5), (1_200, 5)]),
        (500, 200, [(300, 8), (500, 5), (1_400, 8)]),
    ],
)
@pytest.mark.parametrize("stops", [False, True])
def test_so_it_is_where_intervals_are_no_multiples_of_the_env_steps_between_evaluations(
    tmp_path: Path, every: int, interval: int, points: list[tuple[int, int]], stops: bool
) -> None:
    """Stopped where five of the eight wait for the others, and between the end of an interval and an evaluation."""
    scheduler = {**MF, "perturb_every_env_steps": interval, "frequencies": [1, 4]}

    def made(name: str, slots: int) -> Packs:
        packs = Packs(
            tmp_path / name, 8, random_scores(3, 40), scheduler, num_packs=1, slots=slots,
            stop={"num_env_steps": 1_600}, evaluation={"every_iterations": every // 100, "num_episodes": 1},
        )  # fmt: skip
        # Each step is one iteration.
        packs.rng = cast("Any", SimpleNamespace(choice=lambda among: among[0]))
        return packs

    whole = made("whole", 8).run().changes()
    assert {each.num_env_steps for changes in whole.values() for each in changes} <= set(range(every, 1_600, every))
    assert all(any(whole[name] for name in names) for names in (FAST, SLOW))
    for at, slots in points:
        packs = made(f"stopped at {at}", slots)
        packs.run(until=functools.partial(packs.has_reached, at))
        assert (len({one.num_env_steps for one in packs.records()}) > 1) == (slots < 8)
        if stops:
            packs.store.request_stop()
            packs.run()
            packs.store.clear_stop_request()
        packs.begin()
        packs.run()
        assert packs.changes() == whole, at


def test_a_sweep_that_is_resumed_between_two_comparisons_selects_when_it_would_have(tmp_path: Path) -> None:
    score = random_scores(3, 40)
    whole = Packs(tmp_path / "whole", 8, score, MF).run()
    packs = Packs(tmp_path / "killed", 8, score, MF)
    packs.run(until=lambda: all(one.num_env_steps == 500 for one in packs.records()))
    packs.begin()
    packs.run()
    assert packs.changes() == whole.changes()
    assert times(packs, SLOW) == [400, 800]


def test_trials_that_are_added_do_not_hold_back_those_that_are_far_ahead(tmp_path: Path) -> None:
    packs = Packs(tmp_path, 8, random_scores(3, 40), {**MF, "frequencies": [1]})
    for record in packs.records()[:4]:
        known = {"num_iterations": 6, "num_env_steps": 600, "evaluation_return": 1.0}
        packs.store.trial(record.trial_id).write_record(record.model_copy(update=known))
    packs.begin()
    population = packs.population()
    population.in_step()
    assert [population.due_at(record.trial_id) for record in packs.records()] == [800] * 4 + [200] * 4
