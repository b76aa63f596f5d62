"""Score against cost as the web page is told it: over HTTP, and in a sweep's file."""

import dataclasses
import gzip
import json
from typing import Any

import numpy as np
import pytest
from live_service import live  # noqa: F401
from page_sweeps import write_sweep
from synthetic_sweep import make_points, make_sweep

from analysis import front_view as module
from analysis.charts.front import make_charts
from analysis.charts.model import Plots
from analysis.charts.subject import Subject
from analysis.exports.frames import SweepData, ranked_settings
from analysis.front_view import FrontView, front_view
from analysis.front_words import cheapest_near_text
from analysis.importance import what_mattered
from analysis.objectives import SettingScores
from analysis.settings import judge_settings
from tests.narrowing import present
from tune_jobs.sweeps.plain import to_json
from tune_jobs.sweeps.sweep_file import sweep_file

COST = {"objective": {"type": "final", "cost": "env_steps"}}


def data_of(num_samples: int, seeds: int) -> SweepData:
    made = make_sweep(points=make_points(num_samples, np.random.default_rng(2)), seeds_per_point=seeds, with_best=False)
    return SweepData(made.trials, made.results, "final", 50_000, 195.0)


@pytest.mark.parametrize("seeds", [1, 3])
def test_it_has_the_front_of_the_records_and_all_other_settings(seeds: int) -> None:
    data = data_of(5, seeds)
    found = front_view(data, "env_steps")
    settings = present(
        judge_settings(data.trials, data.results, num_env_steps=50_000, threshold=195.0, cost="env_steps")
    )
    front = present(settings.front)
    assert found.front == front
    listed = [item.rank for item in (*front.points, *front.undecided)]
    assert sorted([*listed, *(item.rank for item in found.others)]) == list(range(1, found.num_settings + 1))
    by_point = {item.point_index: item for item in ranked_settings(data)}
    for item in found.others:
        known = by_point[item.point_index]
        assert (item.expected, item.num_env_steps) == (known.expected, known.cost)
    assert found.cheapest_near == cheapest_near_text(front) != ""
    assert "On the front are the settings than which no other" in found.about[0]


def test_of_very_many_settings_some_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    data = data_of(10, 1)
    all_others = front_view(data, "env_steps").others
    monkeypatch.setattr(module, "_MOST_OTHERS", 5)
    some = front_view(data, "env_steps").others
    assert len(some) == 5
    assert (some[0], some[-1]) == (all_others[0], all_others[-1])


def test_all_of_a_long_front_is_told_and_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    # Each is dearer than the one before, and better.
    settings = [SettingScores(i, {"lr": i}, (float(i),), (f"t{i:04d}",), 0, float(i), (1000 + i,)) for i in range(60)]
    ranking = [*settings[::-1], dataclasses.replace(settings[0], point_index=60, expected=-1.0)]
    monkeypatch.setattr(module, "ranked_settings", lambda _: ranking)
    data = data_of(1, 1)
    found = front_view(data, "env_steps")
    front = present(found.front)
    assert (len(front.points), front.num_on_front) == (50, 60)
    told = [item.point_index for item in front.points] + [item.point_index for item in found.more_on_front]
    assert told == list(range(60))
    assert [(item.rank, item.expected, item.num_env_steps) for item in found.more_on_front[-1:]] == [(1, 59.0, 1059.0)]
    assert [item.point_index for item in found.others] == [60]
    made = make_sweep()
    sweep = made.sweep.model_copy(update={"spec": {**made.sweep.spec, **COST}})
    importance = what_mattered(sweep, made.trials, made.results, threshold=None)
    monkeypatch.setattr(Subject, "settings", ranking)
    subject = Subject(sweep, made.trials, made.results, None, importance)
    (chart,) = make_charts(subject)
    assert isinstance(chart.data, Plots)
    (plot,) = chart.data.plots
    (line,) = [item for item in plot.lines if item.is_stepped]
    assert list(line.x) == [1000.0 + i for i in [*range(60), 59]]
    assert list(line.y) == [float(i) for i in [*range(60), 59]]
    drawn = {item.name: len(item.x) for item in plot.lines if not item.is_stepped}
    assert drawn["the front"] == 60
    assert drawn["other settings"] == 1


def test_who_asks_for_no_cost_or_has_no_scores_has_none() -> None:
    data = data_of(2, 1)
    assert front_view(data, None).front is None
    assert front_view(data, None).others == ()
    pending = [trial.model_copy(update={"status": "pending"}) for trial in data.trials]
    assert front_view(dataclasses.replace(data, trials=pending, results={}), "env_steps").front is None


def test_the_service_and_the_file_of_a_sweep_tell_it(live: Any) -> None:  # noqa: F811
    made = make_sweep(name="both", seeds_per_point=2)
    store = write_sweep(live.storage, made, spec=COST)
    write_sweep(live.storage, make_sweep(name="score"))
    found = live.get("/sweeps/both/front").json()
    assert FrontView.model_validate(found).front is not None
    assert found == json.loads(gzip.decompress(sweep_file(store)))["front"]
    data = SweepData(made.trials, made.results, "final", 50_000, 195.0)
    assert found == to_json(front_view(data, "env_steps"))
    assert live.get("/sweeps/score/front").json()["front"] is None
    assert live.get("/sweeps/none/front").status_code == 404
