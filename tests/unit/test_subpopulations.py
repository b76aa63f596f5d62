"""Sub-populations: who is in which, who is open to trials of others, and whose weights and values such a one gets."""

import collections
from typing import Any

import pytest
from spec_errors import MINIMAL, errors

from policies.errors import SpecError
from tune_jobs.cli.plan_view import show_plan
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search.subpopulations import Migration, Ranked, migrations, subpopulation_of
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.rules import check_extendable
from tune_jobs.spec.scheduler import num_worst

LR = {"lr": {"loguniform": [1e-4, 1e-2]}}


# -- who is where


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_sub_populations_are_equally_large_however_many_trials_there_are(number: int) -> None:
    for num_trials in range(number, 5 * number + 3):
        sizes = collections.Counter(subpopulation_of(index, number) for index in range(num_trials))
        assert len(sizes) == number
        assert max(sizes.values()) - min(sizes.values()) <= 1


def test_a_grid_of_as_many_values_is_spread_over_the_sub_populations() -> None:
    # Two values in turn, as the trials of a grid have them.
    found = {(subpopulation_of(index, 2), index % 2) for index in range(8)}
    assert found == {(0, 0), (0, 1), (1, 0), (1, 1)}


# -- brackets


@pytest.mark.parametrize(
    ("num_trials", "fraction", "sizes"),
    [(1, 0.25, (0, 0, 0)), (2, 0.25, (1, 0, 1)), (3, 0.25, (1, 1, 1)), (4, 0.25, (1, 1, 1)), (8, 0.25, (2, 2, 2)),
     (9, 0.4, (4, 1, 4)), (4, 0.5, (2, 0, 2))],
)  # fmt: skip
def test_no_trial_is_in_two_brackets(num_trials: int, fraction: float, sizes: tuple[int, int, int]) -> None:
    ranked = Ranked.of({f"t{index}": float(index) for index in range(num_trials)}, fraction)
    assert tuple(map(len, (ranked.worst, ranked.open_to_others, ranked.best))) == sizes
    names = ranked.worst + ranked.open_to_others + ranked.best
    assert len(set(names)) == len(names)


def test_brackets_are_by_score_and_of_equal_scores_the_first_are_worse() -> None:
    ranked = Ranked.of({"a": 3.0, "b": 1.0, "c": 1.0, "d": 9.0, "e": 2.0, "f": 5.0, "g": 4.0, "h": 6.0}, 0.25)
    assert ranked == Ranked(("b", "c"), ("a", "e"), ("h", "d"))


# -- migration

FAST = {"f0": 1.0, "f1": 2.0, "f2": 3.0, "f3": 4.0}
SLOW = {"s0": 1.5, "s1": 2.5, "s2": 3.5, "s3": 4.5}


def moved(own: int, *groups: dict[str, float], fraction: float = 0.25) -> dict[str, Migration]:
    scores = {name: score for group in groups for name, score in group.items()}
    return migrations(own, [Ranked.of(group, fraction) for group in groups], scores)


def test_from_a_slower_one_comes_a_trial_with_its_values_and_from_a_faster_one_its_weights_alone() -> None:
    assert moved(0, FAST, SLOW) == {"f1": Migration("s3", "s3")}
    assert moved(1, FAST, SLOW) == {"s1": Migration("f3", "s3")}


def test_the_best_of_all_others_comes_whichever_sub_population_it_is_of() -> None:
    slowest = {"z0": 0.0, "z1": 0.0, "z2": 0.0, "z3": 5.0}
    assert moved(1, FAST, SLOW, slowest) == {"s1": Migration("z3", "z3")}
    assert moved(1, FAST, SLOW, dict.fromkeys(slowest, 0.0)) == {"s1": Migration("f3", "s3")}


def test_nobody_is_given_a_trial_that_is_not_better() -> None:
    assert moved(0, FAST, dict.fromkeys(SLOW, 2.0)) == {}
    assert moved(0, {**FAST, "f1": 1.9}, dict.fromkeys(SLOW, 2.0)) == {"f1": Migration("s3", "s3")}


def test_each_migrant_comes_once_and_the_best_of_those_who_are_open_is_asked_first() -> None:
    fast = {f"f{index}": float(index) for index in range(8)}
    slow = {f"s{index}": 10.0 + index for index in range(8)}
    assert moved(0, fast, slow) == {"f3": Migration("s7", "s7"), "f2": Migration("s6", "s6")}
    # One of the two is better than the best migrant, the other gets it.
    assert moved(0, fast, {f"s{index}": 2.5 - index for index in range(8)}) == {"f2": Migration("s0", "s0")}


def test_a_sub_population_whose_others_have_ended_takes_in_nobody() -> None:
    assert moved(0, FAST, {}) == moved(1, {}, SLOW) == {}
    assert moved(0, {"f0": 1.0}, SLOW) == moved(0, {"f0": 1.0, "f1": 2.0}, SLOW) == {}


def test_who_migrates_is_not_changed_at_the_same_comparison_itself() -> None:
    # One has lost a trial, so that it has fewer best ones than the other takes in.
    fast = {f"f{index}": float(index) for index in range(5)}
    slow = {f"s{index}": 10.0 + index for index in range(4)}
    assert num_worst(5, 0.25) == 2
    changed = {*Ranked.of(slow, 0.25).worst, *Ranked.of(slow, 0.25).open_to_others}
    assert {one.weights_of for one in moved(0, fast, slow).values()} == {"s3"}
    assert not {one.weights_of for one in moved(0, fast, slow).values()} & changed


@pytest.mark.parametrize(
    ("number", "fraction", "worst"),
    [
        # Their products are a little more than 7 in floats.
        (25, 0.28, 7), (50, 0.14, 7), (100, 0.07, 7),
        (100, 0.29, 29), (100, 0.071, 8), (5, 0.25, 2), (5, 0.5, 2), (4, 0.25, 1), (8, 1e-12, 1), (1, 0.5, 0),
    ],
)  # fmt: skip
def test_of_a_share_that_is_a_whole_number_of_trials_there_are_as_many(
    number: int, fraction: float, worst: int
) -> None:
    assert num_worst(number, fraction) == worst


# -- the sweep file


@pytest.mark.parametrize(
    ("scheduler", "more", "words"),
    [
        ({"frequencies": [1, 5, 9]}, {}, ["3 sub-populations", "would be 8", "at least 9"]),
        ({"frequencies": [1, 10]}, {}, ["10 times", "200,000 env steps", "stop.num_env_steps, 200,000"]),
        ({"frequencies": [5, 1]}, {}, ["[5, 1]", "begin with 1 and rise"]),
        ({"frequencies": [1, 5, 5]}, {}, ["[1, 5, 5]", "begin with 1 and rise"]),
        ({"frequencies": [2, 5]}, {}, ["[2, 5]", "begin with 1"]),
        ({"frequencies": []}, {}, ["[]", "begin with 1"]),
        ({"frequencies": 5}, {}, ["5", "list"]),
        ({"frequencies": [1, 2.5]}, {}, ["frequencies[1]", "2.5", "whole number"]),
        ({"frequencies": [0, 1]}, {}, ["frequencies[0]", "0"]),
        ({"frequencies": [1, 5], "type": "pb2"}, {}, ["is for pbt", "pb2"]),
        ({"frequencies": [1, 5], "type": "asha"}, {}, ["is for pbt", "asha"]),
        ({"frequencies": [1, 5], "quantile_fraction": 0.5}, {}, ["scheduler.quantile_fraction", "0.5", "of 4"]),
        # The larger of two unequal ones has no place for a migrant.
        ({"frequencies": [1, 5], "quantile_fraction": 0.34}, {"num_samples": 7}, ["quantile_fraction", "0.34"]),
    ],
)  # fmt: skip
def test_frequencies_that_cannot_be_are_refused(
    scheduler: dict[str, Any], more: dict[str, Any], words: list[str]
) -> None:
    fields = {"space": LR, "num_samples": 8, "scheduler": {"type": "pbt", **scheduler}}
    message = errors(base={**MINIMAL, **fields, **more})
    assert "scheduler." in message
    for word in words:
        assert word in message


def test_sweeps_without_sub_populations_are_written_as_before() -> None:
    spec = load_spec({**MINIMAL, "space": LR, "num_samples": 8, "scheduler": {"type": "pbt", "frequencies": [1]}})
    assert spec == load_spec({**MINIMAL, "space": LR, "num_samples": 8, "scheduler": "pbt"})
    assert "frequencies" not in spec.model_dump(mode="json")["scheduler"]
    several = load_spec({**MINIMAL, "space": LR, "num_samples": 8, "scheduler": {"type": "pbt", "frequencies": [1, 5]}})
    assert several.model_dump(mode="json")["scheduler"]["frequencies"] == [1, 5]
    assert load_spec(several.model_dump(mode="json")) == several


def test_a_sweep_is_extended_by_as_many_trials_as_its_sub_populations_need() -> None:
    fields = {**MINIMAL, "space": LR, "num_samples": 8}
    spec = load_spec({**fields, "scheduler": {"type": "pbt", "frequencies": [1, 5]}})
    check_extendable(spec, 6)
    with pytest.raises(SpecError, match=r"by 5 trials: .* 2 sub-populations .* needs 3") as caught:
        check_extendable(spec, 5)
    assert "at least 6" in caught.value.hint
    check_extendable(load_spec({**fields, "scheduler": "pbt"}), 1)
    gridded = {**fields, "space": {**LR, "gamma": {"grid": [0.9, 0.99, 0.999]}}}
    check_extendable(load_spec({**gridded, "scheduler": {"type": "pbt", "frequencies": [1, 5]}}), 2)


def test_the_plan_tells_how_often_each_trial_is_compared(capsys: pytest.CaptureFixture[str]) -> None:
    fields: dict[str, Any] = {**MINIMAL, "space": LR, "num_samples": 9}
    several = load_spec({**fields, "scheduler": {"type": "pbt", "frequencies": [1, 2, 5]}})
    show_plan(several, make_plan(several, Machine(num_cpus=2)), as_json=False)
    shown = capsys.readouterr().out
    assert "pbt, 3 sub-populations that select every 20,000, 40,000 and 100,000 env steps" in " ".join(shown.split())
    ends = [line.split()[-1] for line in shown.splitlines() if line.strip().startswith("t0")]
    assert ends == ["20,000", "40,000", "100,000", "40,000", "100,000", "20,000", "100,000", "20,000", "40,000"]
    one = load_spec({**fields, "scheduler": "pbt"})
    show_plan(one, make_plan(one, Machine(num_cpus=2)), as_json=False)
    assert "select" not in capsys.readouterr().out
