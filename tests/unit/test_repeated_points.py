"""What a plan says of points that must be the same as others."""

from typing import Any

import pytest
from spec_errors import MINIMAL

from tune_jobs.plan.points import repeated_points_notes
from tune_jobs.spec.domains import Domain, Grid
from tune_jobs.spec.draws import draw_points, num_points
from tune_jobs.spec.file import load_spec

REPLAY = ["uniform", "prioritized"]
WHEN = {"when": {"replay": "prioritized"}}


def notes(space: dict[str, Any], num_samples: int, **fields: Any) -> list[str]:
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space, "num_samples": num_samples, **fields})
    return repeated_points_notes(spec)


def space_of(space: dict[str, Any], algorithm: str = "dqn") -> list[Domain]:
    return list(load_spec({**MINIMAL, "algorithm": algorithm, "space": space}).space.values())


def test_the_different_points_of_a_listed_space_are_those_that_conditions_leave() -> None:
    space: dict[str, Any] = {
        "replay": {"choice": REPLAY},
        "prioritized_alpha": {"choice": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], **WHEN},
    }
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space})
    grids = {name: Grid(grid=getattr(domain, "choice", ()), when=domain.when) for name, domain in spec.space.items()}
    assert len(draw_points(grids, 1, 0)) == 7
    assert notes(space, 7) == []
    for fields in ({}, {"search": {"type": "gp", "num_startup_trials": 2}}):
        (note,) = notes(space, 9, **fields)
        assert note.startswith("The space has 7 different points, so some of the 9 that num_samples gives are the same")


def test_a_population_may_begin_with_the_same_points_which_it_changes() -> None:
    grid: dict[str, Any] = {"lr": {"grid": [1e-4, 1e-3]}}
    (note,) = notes(grid, 4)
    assert "seeds_per_point does that" in note
    # With a population it doesn't: there each trial has values of its own.
    assert notes(grid, 4, scheduler="pbt") == []


def test_combinations_of_grids_in_which_nothing_random_acts_are_told_to_be_repeated() -> None:
    alpha = {"uniform": [0.1, 0.9], **WHEN}
    space: dict[str, Any] = {"replay": {"grid": REPLAY}, "prioritized_alpha": alpha, "lr": {"grid": [1e-4, 1e-3]}}
    (note,) = notes(space, 3)
    assert note.startswith(
        "No random domain acts in 2 of the 4 combinations of grids, so num_samples 3 repeats what has them"
    )
    assert notes(space, 1) == []
    assert notes({**space, "gamma": {"uniform": [0.9, 0.99]}}, 3) == []
    # What depends on a random value may act with one sample and not with another.
    chained = {**space, "n_step": {"choice": [1, 2]}, "tau": {"uniform": [0.1, 0.9], "when": {"n_step": 2}}}
    assert notes(chained, 3) == []


def test_points_are_counted_no_further_than_a_note_needs() -> None:
    """All of a space whose values depend on each other would take seconds, and half a gigabyte, at each plan."""
    when = {"replay": "prioritized"}
    values = [0.05 * index for index in range(1, 13)]
    space: dict[str, Any] = {"replay": {"choice": REPLAY}} | {
        name: {"choice": values, "when": when} for name in ("prioritized_alpha", "prioritized_beta", "tau", "lr")
    }
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space})
    grids = {name: Grid(grid=getattr(domain, "choice", ()), when=domain.when) for name, domain in spec.space.items()}
    assert 50 <= num_points(grids, 1, most=50) < 50 * 12
    assert num_points(grids, 1, most=500_000) == 1 + 12**4
    assert notes(space, 50) == []


FINITE = [
    ({"train_batch_size": {"choice": [16, 32, 64, 128, 256]}}, 5),
    ({"train_batch_size": {"power_of_two": [16, 256]}}, 5),
    ({"n_step": {"randint": [1, 4]}}, 3),
    ({"n_step": {"lograndint": [1, 4]}}, 3),
    ({"train_batch_size": {"qrandint": [16, 64, 16]}}, 4),
    ({"lr": {"quniform": [1e-3, 3e-3, 1e-3]}}, 3),
    ({"lr": {"qloguniform": [1e-3, 3e-3, 1e-3]}}, 3),
    ({"hidden_sizes": {"layers": {"number": 1, "sizes": [32, 64]}}}, 2),
    ({"hidden_sizes": {"layers": {"number": [1, 2], "sizes": {"power_of_two": [32, 128]}}}}, 3 + 9),
    ({"n_step": {"randint": [1, 4]}, "lr": {"quniform": [1e-3, 3e-3, 1e-3]}}, 9),
    ({"n_step": {"grid": [1, 2]}, "train_batch_size": {"power_of_two": [16, 64]}}, 6),
]
"""Spaces of which no domain is a range of real numbers, and how many different points each has."""


@pytest.mark.parametrize(("space", "number"), FINITE)
def test_the_points_of_steps_and_layers_are_counted_as_those_of_lists(space: dict[str, Any], number: int) -> None:
    for fields in ({}, {"search": {"type": "gp", "num_startup_trials": 2}}):
        (note,) = notes(space, 20, **fields)
        assert note.startswith(f"The space has {number} different points, so some of the ")
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space})
    assert len({repr(point) for point in draw_points(spec.space, 4 * number, 0)}) == number
    num_grids = num_points(spec.space, 1)
    assert notes(space, number // num_grids) == []
    assert len(notes(space, number // num_grids + 1)) == 1


@pytest.mark.parametrize("space", [space for space, _ in FINITE])
def test_points_with_a_real_number_are_never_told_to_be_the_same(space: dict[str, Any]) -> None:
    assert notes({**space, "gamma": {"uniform": [0.9, 0.99]}}, 20) == []
    # Also where it acts in some of the points only.
    acting = {"gamma": {"uniform": [0.9, 0.99], **WHEN}, "replay": {"choice": REPLAY}}
    assert notes({**space, **acting}, 200) == []


def test_wide_ranges_are_not_listed() -> None:
    wide = {"randint": [1, 10**9]}
    layers = {"layers": {"number": [1, 16], "sizes": {"randint": [1, 1000]}}}
    # Of less first, which would not fill the memory.
    less = {"layers": {"number": [1, 2], "sizes": {"randint": [1, 100]}}}
    for domain in space_of({"n_step": {"randint": [1, 10**6]}, "hidden_sizes": less}):
        assert domain.all_values(1000) is None
    for space in ({"n_step": wide}, {"hidden_sizes": layers}, {"n_step": wide, "double_q": {"choice": [True, False]}}):
        assert notes(space, 1000) == []


def test_steps_so_small_that_floats_cannot_tell_them_apart_are_one_value() -> None:
    # Floats of this size lie 0.125 apart.
    end = 2.0**53 * 0.1
    (domain,) = space_of({"kl_target": {"quniform": [end - 2, end, 0.1]}}, algorithm="ppo")
    values = domain.all_values(100)
    assert values is not None
    assert len(values) == len(set(values)) < 20
    assert domain.all_values(10) is None


@pytest.mark.parametrize(
    ("named", "when", "number"),
    [
        # As Python has it 3 * 0.1 is 0.30000000000000004, which a condition may name for the step 0.3.
        ({"tau": {"quniform": [0.1, 0.4, 0.1]}}, {"tau": 3 * 0.1}, 3 + 5),
        ({"tau": {"quniform": [0.1, 0.4, 0.1]}}, {"tau": [0.1, 0.2]}, 2 + 2 * 5),
        ({"n_step": {"randint": [1, 4]}}, {"n_step": 2.0}, 2 + 5),
        ({"train_batch_size": {"power_of_two": [16, 64]}}, {"train_batch_size": [16, 64]}, 1 + 2 * 5),
    ],
)
def test_what_depends_on_steps_is_counted_where_it_acts(
    named: dict[str, Any], when: dict[str, Any], number: int
) -> None:
    space = {**named, "lr": {"quniform": [1e-3, 5e-3, 1e-3], "when": when}}
    assert notes(space, number) == []
    (note,) = notes(space, number + 1)
    assert note.startswith(f"The space has {number} different points, ")
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space})
    assert len({repr(point) for point in draw_points(spec.space, 4 * number, 0)}) == number
