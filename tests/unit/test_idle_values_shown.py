"""A value that doesn't act in its point is shown as nothing: in tables, files and figures."""

import dataclasses
import io
from typing import Any

import pandas as pd
import pytest
from rich.console import Console
from spec_errors import MINIMAL
from synthetic_sweep import Synthetic, make_sweep

from analysis.charts import model
from analysis.charts.columns import column
from analysis.charts.subject import Subject
from analysis.charts.what_mattered import _heat_map, make_charts
from analysis.exports.frames import SweepData, make_frame
from analysis.exports.latex import latex_table
from analysis.importance import what_mattered
from analysis.page.narrowed import narrowed_space
from analysis.page.repeat import _domain
from analysis.points import IDLE, searched_names, setting_labels, value_text
from analysis.records import CheckpointRecord, IterationRecord, TrialRecord
from analysis.report_tables import group_table, steps_table, trial_table
from analysis.tables import csv_text
from analysis.wording import NONE, number, setting_text, short_text
from tune_jobs.cli.plan_view import _plan_table
from tune_jobs.cli.trials_table import print_table
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.search.study import make_study
from tune_jobs.spec.file import load_spec
from tune_jobs.sweeps.results import Trials

SPACE: dict[str, Any] = {
    "replay": {"choice": ["uniform", "prioritized"]},
    "n_step": {"choice": [1, 2, 3], "when": {"replay": "prioritized"}},
    "prioritized_alpha": {"uniform": [0.01, 1.0], "when": {"replay": "prioritized"}},
    "lr": {"loguniform": [1e-5, 1e-1]},
}
POINTS = [
    {"replay": "uniform", "lr": 0.001},
    {"replay": "prioritized", "n_step": 3, "prioritized_alpha": 0.6, "lr": 0.002},
    {"replay": "uniform", "lr": 0.004},
    {"replay": "prioritized", "n_step": 2, "prioritized_alpha": 0.25, "lr": 0.003},
]
NO_NUMBERS = ("nan", "NaN", "None", "null", "<NA>", "3.0")


@pytest.fixture(scope="module")
def made() -> Synthetic:
    return make_sweep(name="cond", points=POINTS, with_best=False, max_steps=20_000)


@pytest.fixture(scope="module")
def data(made: Synthetic) -> SweepData:
    return SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=None)


def test_the_order_of_names_is_that_of_the_sweep_file() -> None:
    assert searched_names(POINTS) == list(SPACE)
    assert searched_names([]) == []


def test_a_terminal_has_an_empty_cell(made: Synthetic) -> None:
    console = Console(file=io.StringIO(), width=200, markup=False, highlight=False)
    print_table(console, made.trials, among=made.trials, width=200)
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    start = lines[0].index("prioritized_alpha")
    cells = {line.split()[0]: line[start : start + len("prioritized_alpha")].strip() for line in lines[2:6]}
    assert cells == {"t0000": "", "t0001": "0.6", "t0002": "", "t0003": "0.25"}
    assert value_text({}, "lr") == "-"  # not chosen yet


def test_a_plan_has_an_empty_cell() -> None:
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": SPACE, "num_samples": 6})
    console = Console(file=io.StringIO(), width=200)
    console.print(_plan_table(spec, make_plan(spec, Machine(2))))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    start = next(line for line in lines if "n_step" in line).index("n_step")
    rows = [line for line in lines if " t000" in line]
    assert {"uniform" in line for line in rows} == {True, False}
    assert all((line[start : start + 6].strip() == "") == ("uniform" in line) for line in rows)


def test_a_plan_says_which_points_a_model_will_choose() -> None:
    search = {"type": "gp", "num_startup_trials": 2}
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": SPACE, "num_samples": 3, "search": search})
    console = Console(file=io.StringIO(), width=200)
    console.print(_plan_table(spec, make_plan(spec, Machine(2))))
    rows = [line for line in console.file.getvalue().splitlines() if " t000" in line]  # type: ignore[attr-defined]
    assert [line.count("by gp") for line in rows] == [0, 0, len(SPACE)]


def test_a_plan_has_a_column_of_what_a_model_alone_may_choose() -> None:
    search = {"type": "gp", "num_startup_trials": 2}
    fields = {**MINIMAL, "algorithm": "dqn", "space": SPACE, "num_samples": 3, "search": search}
    specs = [load_spec({**fields, "seed": seed}) for seed in range(20)]
    plans = [(spec, make_plan(spec, Machine(2))) for spec in specs]
    spec, plan = next(
        each for each in plans if all(trial.point.get("replay") != "prioritized" for trial in each[1].trials)
    )
    console = Console(file=io.StringIO(), width=200)
    console.print(_plan_table(spec, plan))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    (header,) = (line.split() for line in text.splitlines() if "replay" in line)
    assert header == ["trial", "seed", *SPACE]
    (chosen,) = (line for line in text.splitlines() if " t0002" in line)
    assert chosen.count("by gp") == len(SPACE)


def test_files_have_empty_cells_and_whole_numbers_stay_whole(data: SweepData) -> None:
    for rows in ("trials", "settings"):
        text = csv_text(make_frame(data, rows))
        frame = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
        of_uniform = frame[frame["replay"] == "uniform"]
        assert set(of_uniform["n_step"]) == set(of_uniform["prioritized_alpha"]) == {""}
        assert set(frame[frame["replay"] == "prioritized"]["n_step"]) == {"2", "3"}
    assert make_frame(data, "trials")["n_step"].dtype == "Int64"


def test_latex_and_notebooks_have_empty_cells(data: SweepData, made: Synthetic) -> None:
    table = latex_table(data, name="cond", env_id="CartPole-v1", top=4)
    row = next(line for line in table.splitlines() if line.startswith("uniform"))
    assert row.startswith("uniform &  &  & 0.00")
    html = Trials(made.trials)._repr_html_()
    assert not any(text in html for text in NO_NUMBERS)


def test_the_report_has_empty_cells(made: Synthetic) -> None:
    table = trial_table(made.trials, made.results, goal=None, best=None, core_seconds={}, errors={})
    at = table.headings.index("n_step")
    assert sorted(row[at].text for row in table.rows) == ["", "", "2", "3"]
    assert table.numeric[at]
    groups = group_table(made.trials, made.results, ["replay", "n_step"], goal=None)
    assert sorted(row[1].text for row in groups.rows) == ["", "2", "3"]
    assert setting_labels(POINTS[:2])[0] == "replay uniform, lr 0.001"


def test_the_report_tells_a_searched_null_from_what_does_not_act() -> None:
    points: list[dict[str, Any]] = [
        {"grad_clip": None, "activation": "tanh"}, {"grad_clip": 0.5, "activation": "tanh"},
        {"activation": "tanh"}, {"activation": "relu"},
    ]  # fmt: skip
    trials, results = [], {}
    for index, (point, score) in enumerate(zip(points, (10.0, 50.0, 500.0, 20.0), strict=True)):
        trial_id = f"t{index:04d}"
        kept = CheckpointRecord(trial_id=trial_id, iteration=1, num_env_steps=100, evaluation_return=score)
        trials.append(
            TrialRecord(
                trial_id=trial_id, index=index, point_index=index, seed=index, point=point, status="completed",
                checkpoints=(kept,),
            )
        )  # fmt: skip
        results[trial_id] = [
            IterationRecord(iteration=1, num_env_steps=100, num_episodes=200, time_s=1.0, training_return=score)
        ]
    groups = group_table(trials, results, ["grad_clip", "activation"], goal=None)
    assert groups.headings == ["grad_clip", "activation", "trials", "failed", "best score", "mean score"]
    assert [[row[at].text for at in (0, 1, 2, 5)] for row in groups.rows] == [
        ["", "tanh", "1", "500.0"],
        ["0.5", "tanh", "1", "50.0"],
        ["", "relu", "1", "20.0"],
        [NONE, "tanh", "1", "10.0"],
    ]
    steps = steps_table(trials, results, goal=5.0)
    assert steps.headings[:2] == ["grad_clip", "activation"]
    assert [[cell.text for cell in row[:2]] for row in steps.rows] == [
        [NONE, "tanh"], ["0.5", "tanh"], ["", "tanh"], ["", "relu"]
    ]  # fmt: skip


def test_axes_have_no_place_for_it(made: Synthetic) -> None:
    assert column("a", [IDLE, 0.5, IDLE, 1.0], {}).values == (None, 0.5, None, 1.0)
    listed = column("n_step", [IDLE, 3, IDLE, 2], SPACE)
    assert (listed.axis.labels, listed.values) == (("2", "3"), (None, 1, None, 0))
    assert column("a", [IDLE, IDLE], {}).values == (None, None)
    near = column("gamma", [0.9, 0.99, IDLE], {"gamma": {"one_minus_loguniform": [0.9, 0.999]}})
    assert (near.axis.name, near.axis.kind, near.values) == ("1 - gamma", "log", (0.1, 0.01, None))
    sweep = made.sweep.model_copy(update={"spec": {**made.sweep.spec, "space": SPACE}})
    subject = Subject(sweep, made.trials, made.results, None, what_mattered(sweep, made.trials, made.results))
    panels, heat_map, parallel = make_charts(subject)
    assert "Where a line is pale" in parallel.caption
    assert not any("not set" in str(chart.data) for chart in (panels, heat_map, parallel))


def test_a_heat_map_is_of_two_that_act_together() -> None:
    values = {"a": (1.0, 2.0, None, None), "b": (None, None, 0.1, 0.2), "c": (3, 4, 3, 4)}
    columns = tuple(model.Column(model.Axis(name), found) for name, found in values.items())
    endings: tuple[model.Ending, ...] = ("whole", "whole", "whole", "whole")
    score = model.Axis("score")
    trials = model.Trials(("t0000", "t0001", "t0002", "t0003"), score, (1, 2, 3, 4), endings, columns, (0, 1, 2, 3))
    assert _heat_map(trials, "").title == "Mean score by a and c"
    never = _heat_map(dataclasses.replace(trials, columns=columns[:2]), "")
    assert never.title == "Mean score by a and b"
    assert "Fewer than two trials in which both act" in never.missing


def test_a_study_of_optuna_lacks_it(data: SweepData) -> None:
    pytest.importorskip("optuna")
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": SPACE})
    trials = make_study(spec, data, "cond").trials
    assert [sorted(trial.params) for trial in trials] == [sorted(point) for point in POINTS]


def test_layers_are_parameters_of_a_study_one_by_one() -> None:
    pytest.importorskip("optuna")
    space = {"hidden_sizes": {"layers": {"number": [1, 2], "sizes": [16, 32]}}}
    made = make_sweep(name="l", points=[{"hidden_sizes": [16]}, {"hidden_sizes": [32, 16]}], with_best=False)
    data = SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=None)
    spec = load_spec({**MINIMAL, "algorithm": "dqn", "space": space})
    first, second = (trial.params for trial in make_study(spec, data, "l").trials)
    assert first == {"hidden_sizes.number": 1, "hidden_sizes.1": 16}
    assert second == {"hidden_sizes.number": 2, "hidden_sizes.1": 32, "hidden_sizes.2": 16}


# -- the next search, and words


def test_a_narrower_space_drops_what_could_never_act_in_it() -> None:
    uniform = [point for point in POINTS if point["replay"] == "uniform"]
    narrowed = narrowed_space(SPACE, uniform)
    assert list(narrowed) == ["replay", "lr"]
    assert narrowed["replay"] == {"choice": ["uniform"]}
    other = narrowed_space(SPACE, [point for point in POINTS if point["replay"] == "prioritized"])
    assert other["n_step"] == {"choice": [2, 3], "when": {"replay": "prioritized"}}
    assert load_spec({**MINIMAL, "algorithm": "dqn", "space": other, "num_samples": 3})
    chained = SPACE | {"double_q": {"choice": [True, False], "when": {"n_step": [1, 2]}}}
    assert "double_q" not in narrowed_space(chained, uniform)
    kept = narrowed_space(chained, [POINTS[3]])
    assert kept["double_q"]["when"] == {"n_step": 2}


@pytest.mark.parametrize(
    ("values", "named", "place"),
    [([1000.0, 2000.0], 2000, 1), ([1000, 2000], 2e3, 1), ([[64], [64, 64]], 64, 0), ([64, [64, 64]], [64], 0)],
)
def test_a_condition_may_write_a_value_in_another_form_than_the_list(values: list[Any], named: Any, place: int) -> None:
    space = {"x": {"choice": values}, "n_step": {"choice": [1, 2], "when": {"x": named}}}
    points = [{"x": value, "n_step": 1} for value in values]
    assert narrowed_space(space, points) == {"x": {"choice": values}, "n_step": {"choice": [1], "when": {"x": named}}}
    narrowed = narrowed_space(space, [{"x": named, "n_step": 1}])
    assert narrowed == {"x": {"choice": [values[place]]}, "n_step": {"choice": [1], "when": {"x": named}}}


@pytest.mark.parametrize(
    ("values", "named"), [([[64], [64, 64]], [64, 64]), ([[64], [32, 64]], [32, 64]), ([64, [32, 64]], [32, 64])]
)
def test_a_condition_on_a_list_that_is_gone_is_none_on_the_numbers_in_it(values: list[Any], named: list[int]) -> None:
    space = {"x": {"choice": values}, "n_step": {"choice": [1, 2], "when": {"x": named}}}
    assert narrowed_space(space, [{"x": values[0]}]) == {"x": {"choice": values[:1]}}
    kept = {"x": {"choice": values[1:]}, "n_step": {"choice": [1], "when": {"x": named}}}
    assert narrowed_space(space, [{"x": values[1], "n_step": 1}]) == kept


LAYERS = {"layers": {"number": [1, 2], "sizes": {"choice": [8]}}}


@pytest.mark.parametrize(
    ("domain", "values", "narrowed"),
    [
        ({"power_of_two": [16, 1024]}, [64, 128], {"power_of_two": [32, 256]}),
        ({"power_of_two": [16, 64]}, [16], {"power_of_two": [16, 32]}),
        ({"one_minus_loguniform": [0.9, 0.9999]}, [0.99, 0.99], {"one_minus_loguniform": [0.9763, 0.995]}),
        (LAYERS, [[8]], LAYERS),
    ],
)
def test_domains_are_narrowed_on_their_scale(domain: Any, values: list[Any], narrowed: Any) -> None:
    assert narrowed_space({"x": domain}, [{"x": value} for value in values]) == {"x": narrowed}


def test_domains_in_words() -> None:
    assert _domain(SPACE["prioritized_alpha"]) == "uniform from 0.01 to 1, when replay is prioritized"
    assert _domain({"choice": [1], "when": {"a": [1, 2], "b": True}}) == "choice of 1, when a is 1 or 2, and b is true"
    layers = {"layers": {"number": [1, 3], "sizes": {"choice": [16, 32]}}}
    assert _domain(layers) == "1 to 3 layers, the size of each choice of 16, 32"


def test_what_is_nearly_one_is_not_called_one() -> None:
    assert [short_text(value) for value in (0.9999, 0.99987, 0.9994, 1.0, 1.00001)] == [
        "0.9999", "0.99987", "0.9994", "1", "1",
    ]  # fmt: skip
    assert (setting_text(0.99996), number(0.99996)) == ("0.99996", "0.99996")
