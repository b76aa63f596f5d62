"""What a plan says of points that must be the same as others."""

from typing import Any

from spec_errors import MINIMAL

from tune_jobs.plan.points import repeated_points_notes
from tune_jobs.spec.domains import Grid
from tune_jobs.spec.draws import draw_points, num_points
from tune_jobs.spec.file import load_spec

REPLAY = ["uniform", "prioritized"]
WHEN = {"when": {"replay": "prioritized"}}


def notes(space: dict[str, Any], num_samples: int, **fields: Any) -> list[str]:
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space, "num_samples": num_samples, **fields})
    return repeated_points_notes(spec)


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
