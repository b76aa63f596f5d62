"""Points of a sweep file, which are tried before all others."""

import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from spec_errors import MINIMAL

from policies.errors import SpecError
from tune_jobs.cli.commands import cli
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search import chosen_point
from tune_jobs.search.given_points import given_points
from tune_jobs.spec.file import load_spec, stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.adding import add_what_is_missing, check_same_trials
from tune_jobs.sweeps.drive import write_new

SPACE: dict[str, Any] = {"lr": {"loguniform": [1e-4, 1e-2]}, "hidden_sizes": {"choice": [[32], [64]]}}
FIRST, SECOND = {"lr": 0.5, "hidden_sizes": 64}, {"hidden_sizes": [16], "lr": 1e-3}
MACHINE = Machine(num_cpus=2)


def make_spec(points: Any = (FIRST, SECOND), **changes: Any) -> SweepSpec:
    return load_spec({**MINIMAL, "space": SPACE, "num_samples": 3, "points": points, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"space": {"lr": {"grid": [1e-3, 1e-2]}, "hidden_sizes": {"choice": [[32], [64]]}}, "seeds_per_point": 2},
        {"search": {"type": "gp", "num_startup_trials": 2}},
    ],
)
def test_they_come_first_with_all_seeds_and_what_is_drawn_behind_them_is_what_it_would_be_without(
    changes: dict[str, Any],
) -> None:
    with_points, without = (make_plan(make_spec(points, **changes), MACHINE) for points in ([FIRST, SECOND], []))
    seeds = changes.get("seeds_per_point", 1)
    assert with_points.num_points == without.num_points + 2
    points = [trial.point for trial in with_points.trials]
    # Written as the space has it; values may lie outside.
    assert (
        points[: 2 * seeds]
        == [{"lr": 0.5, "hidden_sizes": [64]}] * seeds + [{"lr": 1e-3, "hidden_sizes": [16]}] * seeds
    )
    assert points[2 * seeds :] == [trial.point for trial in without.trials]
    assert [note for note in with_points.notes if note.startswith("Point 0 was chosen with lr 0.5, outside of space")]


def test_the_record_has_them_as_chosen_points_and_a_resume_plans_the_same(tmp_path: Path) -> None:
    spec = make_spec()
    plan = make_plan(spec, MACHINE)
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, plan, None)
    record = store.read_record()
    assert [item.num_points for item in record.chosen_points] == [0, 1]
    again = stored_spec(record)
    assert again.points == spec.points
    check_same_trials(store, make_plan(again, MACHINE, chosen_points=record.chosen_points))
    more = again.model_copy(update={"num_samples": 5})
    extended = add_what_is_missing(store, record, more, MACHINE, None)
    assert [trial.point for trial in extended.trials[:5]] == [trial.point for trial in plan.trials]
    assert extended.num_points == 7


def test_a_sweep_without_points_is_written_as_it_always_was() -> None:
    assert make_spec([]).model_dump(mode="json")["points"] is None
    assert load_spec({**MINIMAL, "points": None}).points == ()


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([{}], ["points[0]: it has no lr and no hidden_sizes"]),
        ([{"lr": 1e-3}], ["points[0]: it has no hidden_sizes"]),
        ([FIRST, {**SECOND, "learning_rate": 1}], ["points[1]: 'learning_rate' is not searched", "leave it out"]),
        ([{**FIRST, "lr": "fast"}], ["points[0]: lr: 'fast' is not a number"]),
        ([{**FIRST, "lr": -1}], ["points[0]: lr"]),
        ([FIRST, SECOND, {"lr": 0.5, "hidden_sizes": [64]}], ["points[2]", "points[0]", "seeds_per_point"]),
        ([{}, {"lr": 1}], ["points[0]: it has no lr", "points[1]: it has no hidden_sizes"]),
    ],
)
def test_a_wrong_point_is_refused_with_its_place(points: Any, words: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        make_plan(make_spec(points), MACHINE)
    assert all(word in caught.value.message for word in words), caught.value.message
    assert "lr (loguniform" in caught.value.hint


def test_what_a_point_means_is_asked_once_however_many_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with each other one by one, a few hundred took seconds."""
    asked: list[Any] = []

    def count(spec: SweepSpec, point: Any) -> str | None:
        asked.append(point)
        return meaning(spec, point)

    meaning = chosen_point._meaning
    monkeypatch.setattr(chosen_point, "_meaning", count)
    points = [{"lr": 1e-6 * number, "hidden_sizes": 64} for number in range(1, 1_001)]
    assert len(given_points(make_spec(points))) == 1_000
    assert len(asked) == 1_000
    with pytest.raises(SpecError, match=r"points\[1000\]: it has the values of points\[7\]"):
        given_points(make_spec([*points, {"lr": 8e-6, "hidden_sizes": [64]}]))


def test_equal_values_are_the_same_point_though_their_texts_differ() -> None:
    space = {"entropy_coeff": {"uniform": [0.0, 0.1]}}
    with pytest.raises(SpecError, match=r"points\[1\]: it has the values of points\[0\]"):
        given_points(make_spec([{"entropy_coeff": 0.0}, {"entropy_coeff": -0.0}], space=space))


def test_a_point_that_the_grid_has_too_is_told_in_whatever_form_it_is_given() -> None:
    space: dict[str, Any] = {"lr": {"grid": [1e-3, 1e-2]}, "hidden_sizes": {"grid": [[32], [64]]}}
    points = [{"lr": 1e-2, "hidden_sizes": 32}, {"lr": 1e-2, "hidden_sizes": 16}]

    def told(points: list[dict[str, Any]], **changes: Any) -> list[str]:
        plan = make_plan(make_spec(points, space=space, num_samples=1, **changes), MACHINE)
        return [note for note in plan.notes if "the same values" in note or "more chosen" in note]

    (note,) = told(points)
    assert note.startswith("Point 0 was chosen, and point 4 has the same values: each counts as a setting of its own")
    assert told(points[1:]) == []
    space["hidden_sizes"]["grid"] = [[size] for size in range(1, 8)]
    many = told([{"lr": 1e-3, "hidden_sizes": size} for size in range(1, 8)])
    assert many[5:] == ["So it is with 2 more chosen points."]


@pytest.mark.parametrize("points", [{"lr": 1e-3}, 3, "lr=1", [None], [[1]], [3]])
def test_what_is_no_list_of_points_is_refused(points: Any) -> None:
    with pytest.raises(SpecError, match=r"points"):
        make_spec(points)


@pytest.mark.parametrize("changes", [{"space": {}}, {"scheduler": "pbt", "space": {"lr": SPACE["lr"]}}])
def test_a_sweep_that_takes_no_points_refuses_them(changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match="No point can be added"):
        make_plan(make_spec([{"lr": 1e-3}], **changes), MACHINE)


def test_a_dry_run_shows_them_first(tmp_path: Path) -> None:
    file = tmp_path / "sweep.yaml"
    file.write_text(json.dumps({**MINIMAL, "space": SPACE, "num_samples": 3, "points": [FIRST]}))
    result = CliRunner().invoke(cli, ["launch", str(file), "--dry-run", "--storage", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert next(line for line in result.output.splitlines() if line.strip().startswith("t0000")).split()[2] == "0.5"
