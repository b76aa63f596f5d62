"""What the report says of a launch of its sweep file, beside what such a launch would train."""

import dataclasses
from typing import Any

import pytest
import yaml
from report_sources import source_of
from spec_errors import MINIMAL
from synthetic_sweep import make_sweep

from analysis.numbering import planned_places
from analysis.page import repeat
from analysis.page.source import Source
from analysis.page_templates import make_environment
from analysis.records import ChosenPointRecord, ReplicationRecord
from tune_jobs.search.points import planned_points
from tune_jobs.spec.file import load_spec
from tune_jobs.spec.sweep_spec import SweepSpec

SPACE = {"lr": {"uniform": [1e-4, 1e-2]}}
GIVEN = {"lr": 0.02}


def injected(num_points: int) -> ChosenPointRecord:
    return ChosenPointRecord(num_points=num_points, point={"lr": 0.5})


def replicated(num_points: int, *points: int) -> ReplicationRecord:
    return ReplicationRecord(num_points=num_points, points=points)


def points_of_trials(
    spec: SweepSpec, chosen: tuple[ChosenPointRecord, ...], more: tuple[ReplicationRecord, ...]
) -> list[Any]:
    points = planned_points(spec, chosen)
    return [points[place.point_index] for place in planned_places(len(points), spec.seeds_per_point, more)]


def told(changes: dict[str, Any], chosen: tuple[ChosenPointRecord, ...], more: tuple[ReplicationRecord, ...]) -> Source:
    spec = load_spec({**MINIMAL, "space": SPACE, "num_samples": 4, **changes})
    points = planned_points(spec, chosen)
    source = source_of(make_sweep(points=[dict(point or {}) for point in points], seeds_per_point=spec.seeds_per_point))
    record = source.sweep.model_copy(
        update={"spec": spec.model_dump(mode="json"), "chosen_points": chosen, "replications": more}
    )
    return dataclasses.replace(source, sweep=record)


@pytest.mark.parametrize(
    ("changes", "chosen", "more", "words"),
    [
        ({}, (), (), ""),
        ({}, (), (replicated(4, 1, 2),), ""),
        ({"points": [GIVEN]}, (ChosenPointRecord(num_points=0, point=GIVEN),), (replicated(5, 0),), ""),
        ({}, (injected(2),), (), "points were injected"),
        ({"seeds_per_point": 2}, (injected(3),), (), "points were injected"),
        ({"points": [GIVEN]}, (ChosenPointRecord(num_points=0, point=GIVEN), injected(3)), (), "points were injected"),
        ({"seeds_per_point": 2}, (), (replicated(2, 0), replicated(4, 1)), "the sweep was extended after settings"),
        ({}, (injected(3),), (replicated(3, 0, 1),), "points were injected and the sweep was extended after settings"),
    ],
)
def test_it_says_from_which_trial_on_a_launch_gives_others(
    changes: dict[str, Any], chosen: tuple[ChosenPointRecord, ...], more: tuple[ReplicationRecord, ...], words: str
) -> None:
    source = told(changes, chosen, more)
    spec = load_spec({**MINIMAL, "space": SPACE, "num_samples": 4, **changes})
    launched = points_of_trials(spec, chosen[: len(spec.points)], ())
    theirs = points_of_trials(spec, chosen, more)
    # A trial's seed follows from its number, so that with another point it is another trial.
    pairs = enumerate(zip(launched, theirs, strict=False))
    first = next((index for index, (ours, point) in pairs if ours != point), None)
    found = repeat.section(source)
    assert (first is None) == (not words)
    assert found.others.startswith(f"From t{first:04d} on a launch gives other trials, as {words}" if words else "")
    assert bool(found.others) is bool(words)
    page = make_environment().get_template("sections/repeat.html.j2").render(repeat=found)
    assert found.others in page
    assert ("Points that were injected" in page) is ("injected" in words)
    assert yaml.safe_load(found.injected_yaml or "[]") == [item.point for item in chosen[len(spec.points) :]]


@pytest.mark.parametrize("seeds", ["2", None, 0, True])
def test_of_a_record_that_does_not_number_its_trials_nothing_is_said(seeds: Any) -> None:
    source = told({}, (injected(2),), ())
    source.sweep.spec["seeds_per_point"] = seeds
    assert repeat.section(source).others == ""
