"""`objective: [return, env_steps]` in sweep files, plans, the report and its chart."""

import dataclasses
from typing import Any

import pytest
from report_sources import source_of
from rich.console import Console
from spec_errors import errors
from synthetic_sweep import Synthetic, make_sweep

from analysis.charts import Subject, make_charts
from analysis.charts.model import Plots
from analysis.page import front
from analysis.settings import judge_settings
from policies.errors import SpecError
from tests.narrowing import present
from tune_jobs.cli import output
from tune_jobs.spec.file import json_schema, load_spec
from tune_jobs.spec.rules import idle_settings

SWEEP = {"env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-4, 1e-2]}}}


def wanted(objective: Any) -> tuple[str, str | None]:
    found = load_spec({**SWEEP, "objective": objective}).objective
    assert load_spec({**SWEEP, "objective": found.model_dump(mode="json")}).objective == found
    return found.type, found.cost


def test_a_score_and_its_cost_are_written_in_several_ways() -> None:
    for pair in (["return", "env_steps"], ["env_steps", "return"], ["final", "env_steps"], {"cost": "env_steps"}):
        assert wanted(pair) == ("final", "env_steps")
    assert wanted(["area", "env_steps"]) == wanted({"type": "area", "cost": "env_steps"}) == ("area", "env_steps")
    assert wanted("return") == wanted("final") == wanted(None) == ("final", None)
    assert load_spec({**SWEEP, "objective": "area"}, ["objective.cost=env_steps"]).objective.cost == "env_steps"
    schema = json_schema()["properties"]["objective"]["anyOf"][0]["anyOf"]
    assert [one.get("type", "$ref") for one in schema] == ["string", "array", "$ref"]


@pytest.mark.parametrize(
    ("objective", "said"),
    [
        ([], "objective: [] names nothing: write a score and its cost, such as [return, env_steps]"),
        (["env_steps"], "objective: ['env_steps'] is a cost alone: write a score and its cost"),
        (["return"], "is one objective, and no list: write a score and its cost, such as [return, env_steps]; for a "),
        (["return", "return"], "names one objective twice: "),
        (["env_steps", "env_steps"], "names one objective twice: "),
        (["final", "return"], "names one objective twice (final and return are the same): "),
        (["return", "area"], "has no cost, of which there is env_steps: "),
        (["return", "env_steps", "time"], "has 3 objectives: "),
        (["nonsense", "env_steps"], "objective.type: 'nonsense' is not allowed: it should be 'final', 'area'"),
        ([1, 2], "has no cost, of which there is env_steps"),
        ([{}, "env_steps"], "has no cost, of which there is env_steps"),
        ({"cost": "seconds"}, "objective.cost: 'seconds' is not allowed: it should be 'env_steps'"),
        (["steps_to_threshold", "env_steps"], "objective.cost: cannot be used with steps_to_threshold"),
        (5, "objective: 5 is not allowed: give final, area, best or steps_to_threshold, a list of one of them and "),
    ],
)  # fmt: skip
def test_what_is_no_score_and_cost_is_refused_with_what_to_write(objective: Any, said: str) -> None:
    assert said in errors(objective=objective)


def test_a_population_has_no_settings_to_set_against_a_cost() -> None:
    with pytest.raises(SpecError, match=r"objective\.cost: cannot be used with pbt"):
        load_spec({**SWEEP, "num_samples": 4, "scheduler": "pbt", "objective": ["return", "env_steps"]})


def test_a_cost_in_which_trainings_can_not_differ_is_noted() -> None:
    def notes(**fields: Any) -> list[str]:
        return idle_settings(load_spec({**SWEEP, **fields}))

    pair = ["return", "env_steps"]
    (told,) = notes(objective=pair)
    assert "all trainings are to be as long" in told
    assert notes(objective="final") == notes(objective=pair, stop={"training_return": 5}) == []
    assert notes(objective=pair, stop={"evaluation_return": 5}) == []
    assert notes(objective=pair, space={"stop.num_env_steps": {"choice": [5_000, 9_000]}}) == []


def test_no_cost_is_noted_in_which_trainings_differ_by_another_end_than_a_goal() -> None:
    def notes(algorithm: str = "ppo", **fields: Any) -> list[str]:
        return idle_settings(
            load_spec({**SWEEP, "algorithm": algorithm, "objective": ["return", "env_steps"], **fields})
        )

    assert notes(stop={"num_episodes": 100}) == notes(stop={"time_s": 60}) == []
    assert notes(stop={"time_s": 3600})
    sizes, steps = {"train_batch_size": {"choice": [512, 1024]}}, {"env_steps_per_iteration": {"choice": [500, 1000]}}
    assert (
        notes(space=sizes, stop={"num_iterations": 20}) == notes("dqn", space=steps, stop={"num_iterations": 20}) == []
    )
    # Iterations of one length, as many for all, are as long; and an iteration of DQN is no longer with larger batches.
    assert notes(stop={"num_iterations": 20})
    assert notes("dqn", space={"train_batch_size": {"choice": [32, 64]}}, stop={"num_iterations": 20})
    assert notes(space=sizes)


def test_with_hyperband_no_length_is_proposed_that_it_refuses() -> None:
    length: dict[str, Any] = {"stop.num_env_steps": {"choice": [20_000, 50_000]}}
    given = {**SWEEP, "objective": ["return", "env_steps"]}
    assert "search their length" in idle_settings(load_spec({**given, "scheduler": "asha"}))[0]
    assert idle_settings(load_spec({**given, "scheduler": "asha", "space": length})) == []
    (told,) = idle_settings(load_spec({**given, "scheduler": "hyperband"}))
    assert told.endswith("as long: end them at a goal (stop.training_return, stop.evaluation_return).")
    assert idle_settings(load_spec({**given, "scheduler": "hyperband", "stop": {"training_return": 5}})) == []
    with pytest.raises(SpecError, match=r"cannot be used with scheduler\.type hyperband"):
        load_spec({**given, "scheduler": "hyperband", "space": length})


def with_cost(made: Synthetic, cost: str | None = "env_steps") -> Synthetic:
    spec = {**made.sweep.spec, "objective": {"type": "final", "cost": cost}}
    return dataclasses.replace(made, sweep=made.sweep.model_copy(update={"spec": spec}))


def test_the_page_and_its_chart_show_the_front() -> None:
    made = with_cost(make_sweep(seeds_per_point=3))
    settings = judge_settings(made.trials, made.results, num_env_steps=50_000, threshold=195.0, cost="env_steps")
    found = present(present(settings).front)
    source = source_of(made, settings)
    shown = front.section(source)
    assert shown.cheapest_near
    at = shown.table.headings.index("on the front")
    assert [row[at].text for row in shown.table.rows].count("yes, the cheapest near the best") == 1
    assert len(shown.table.rows) == len(found.points) + len(found.undecided)
    assert [row[0].value for row in shown.table.rows] == sorted(row[0].value for row in shown.table.rows)

    subject = Subject(made.sweep, made.trials, made.results, 195.0, source.importance)
    (chart,) = [chart for chart in make_charts(subject) if chart.section == "front"]
    assert isinstance(chart.data, Plots)
    # The line of the front comes behind its dots.
    lines = {line.name: line for line in chart.data.plots[0].lines}
    assert lines["the front"].is_stepped
    assert lines["the front"].x[:-1] == tuple(item.num_env_steps for item in found.points)
    assert lines["the front"].y[:-1] == tuple(item.expected for item in found.points)
    drawn = {name: len(line.x) for name, line in lines.items() if name in ("other settings", "may be on the front")}
    assert sum(drawn.values()) + found.num_on_front == present(settings).num_settings


@pytest.mark.parametrize(("cheapest", "scale"), [(2_000, "value"), (1_000, "log")])
def test_costs_that_lie_far_apart_are_drawn_on_a_log_scale(cheapest: int, scale: str) -> None:
    made = with_cost(make_sweep(points=[{"lr": 0.1}, {"lr": 0.2}], max_steps=30_000))
    made.trials[0] = made.trials[0].model_copy(update={"status": "completed", "num_env_steps": cheapest})
    made.trials[1] = made.trials[1].model_copy(update={"status": "completed", "num_env_steps": 30_000})
    subject = Subject(made.sweep, made.trials, made.results, 195.0, source_of(made).importance)
    (chart,) = [chart for chart in make_charts(subject) if chart.section == "front"]
    assert isinstance(chart.data, Plots)
    assert chart.data.plots[0].x.kind == scale


def test_what_does_not_act_is_an_empty_cell_though_it_does_not_act_in_the_best(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The best setting lacks a name that the cheapest has."""
    points = [{"lr": 0.1}, {"lr": 0.2, "prioritized_alpha": 0.5}]
    made = with_cost(make_sweep(points=points, seeds_per_point=2))
    settings = present(
        judge_settings(made.trials, made.results, num_env_steps=50_000, threshold=195.0, cost="env_steps")
    )
    front_of = present(settings.front)
    item = front_of.cheapest_near
    both = tuple(
        item.model_copy(update={"point": point, "point_index": index, "num_env_steps": 1000.0 * (index + 1)})
        for index, point in enumerate(points)
    )
    best = settings.best.model_copy(update={"point": points[0], "point_index": 0})
    found = front_of.model_copy(update={"points": both, "undecided": (), "cheapest_near": both[1]})
    settings = settings.model_copy(update={"front": found, "best": best})
    table = front.section(source_of(made, settings)).table
    at = table.headings.index("prioritized_alpha")
    assert [row[at].text for row in table.rows] == ["", "0.5"]
    for width in (80, 200):
        output._print_front(Console(width=width), settings)
        assert "None" not in (shown := capsys.readouterr().out)
        assert "…" not in shown
    assert "lr 0.2, prioritized_alpha 0.5" in shown


def test_who_does_not_ask_for_cost_sees_nothing_of_it() -> None:
    made = make_sweep()
    for sweep in (made, with_cost(made, None)):
        subject = Subject(sweep.sweep, sweep.trials, sweep.results, 195.0, source_of(sweep).importance)
        assert not [chart for chart in make_charts(subject) if chart.section == "front"]
        assert not front.section(source_of(sweep)).table.rows
