"""Parts of the service's page by themselves: ranges of axes, lists that change, a dialog."""

from typing import Any

import pytest
from live_service import Live
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from synthetic_sweep import make_sweep

from analysis.wording import setting_text, short_text

pytestmark = IN_A_BROWSER
RANGES = """
    const [{ axesOf }, [kind, values]] = [module, given];
    const trials = values.map((value) => ({ point: { x: value }, score: null }));
    const [axis] = axesOf([{ name: "x", kind, values: [] }], trials);
    return [[0, 1], [0.5, 1], [0, 0.5]].map(([low, high]) => {
      const text = axis.rangeText(low, high);
      return [text, values.filter(axis.test(text)), axis.ends(text)];
    });
"""
RECONCILED = """
    const place = document.createElement("ul");
    place.tabIndex = -1;
    document.querySelector("main").replaceChildren(place);
    const make = (text) => {
      const node = document.createElement("li");
      node.tabIndex = 0;
      node.textContent = text;
      return node;
    };
    const told = [];
    for (const texts of given) {
      module.reconcile(place, texts, (text) => text, make, () => {});
      // The one that is named c has it from the start.
      if (!told.length) [...place.children].find((node) => node.textContent === "c")?.focus();
      told.push([[...place.children].map((node) => node.textContent).join(""), document.activeElement.textContent]);
    }
    return told;
"""
TABLE = """
    const main = document.querySelector("main");
    main.replaceChildren();
    const nothing = () => {};
    const acts = { onSort: nothing, onOpen: nothing, onChoose: nothing, onHover: nothing };
    const table = new module.TrialTable(main, acts);
    const columns = [{ key: "trial", label: "trial", text: (row) => row.trial_id }];
    const show = (ids) => table.show({
      rows: ids.map((trial_id) => ({ trial_id })), numAll: 4, columns, sort: "trial", isRising: true,
      chosen: new Map(), opened: null,
    });
    show(["t0000", "t0001", "t0002", "t0003"]);
    table.focus(3);
    return given.map((ids) => {
      show(ids);
      const { activeElement: node } = document;
      return node.dataset.key ?? node.className;
    });
"""

STATES = "return given.map((sweep) => [module.stateOf(sweep).word, module.stateReason(sweep), module.isDone(sweep)]);"
SHOWN = """
    const searched = [{ name: "lr", kind: "log", values: [], isNumber: true }];
    const of = (name) => import(new URL(`static/js/${name}.js`, document.baseURI));
    return Promise.all([of("parallel_axes"), of("trial_columns")]).then(([{ axesOf }, { columnsOf }]) => {
      const column = columnsOf(searched, false).find(({ key }) => key === "lr");
      const [axis] = axesOf(searched, given);
      const data = Object.assign(new module.SweepData(null), { trials: given, spec: {} });
      const points = data.rankedPoints(given);
      const told = given.map((trial, index) => [column.text(trial), axis.valueOf(trial), points[index].point.lr]);
      return [data.findSearched().map(({ name }) => name), told];
    });
"""
NEAR_ONE = "return given.map((value) => [module.settingText(value, 3), module.settingText(value, 4)]);"
CONDITIONS = """
    return given.map(({ space, values }) =>
      [module.numCombinations(space), values.map((each) => module.acts(space, "num_epochs", { hidden_sizes: each }))]);
"""
UNSET = """
    const [space, points] = given;
    const of = (name) => import(new URL(`static/js/${name}.js`, document.baseURI));
    const names = ["trial_columns", "filter", "parallel", "format", "chosen_point"];
    return Promise.all(names.map(of)).then((modules) => {
      const [{ columnsOf }, { filterOf }, { Parallel }, { pointText }, { pointDialog }] = modules;
      const trials = points.map((point, index) => ({
        trial_id: String(index), index, point_index: index, seed_index: 0, point,
        score: 10 * index, status: "completed",
      }));
      const data = Object.assign(new module.SweepData(null), { trials, spec: { space }, summary: {} });
      const [axis, score] = [data.axes[0], data.axes.at(-1)];
      const ids = (found) => found.map((trial) => trial.trial_id).join("");
      const columns = columnsOf(data.searched, false);
      const drawn = [];
      const nothing = () => {};
      const lineTo = (left, top) => drawn.push(Number.isFinite(top));
      const context = { beginPath: nothing, stroke: nothing, moveTo: nothing, lineTo };
      Object.assign(axis, { left: 0 });
      Object.assign(score, { left: 100 });
      const parallel = { axes: [axis, score], trials, matching: new Set(trials.map((trial) => trial.trial_id)) };
      Parallel.prototype.trace.call(parallel, context, trials, false);
      const near = trials.map((trial) => [30, 284].map((top) => Parallel.prototype.nearest.call(parallel, 100, top)));
      const dialog = pointDialog({ name: "a", spec: { space }, trials, post: null });
      return {
        ticks: axis.ticks.map(({ text }) => text),
        places: trials.map((trial) => axis.place(axis.valueOf(trial)) ?? null),
        unscored: score.place(null) ?? null,
        lines: drawn,
        near: near[0],
        range: axis.rangeText(-0.1, 0.1),
        cells: trials.map((trial) => columns.find(({ key }) => key === axis.name).text(trial)),
        filtered: ["=null", "!=null", "=0.5", "!=0.5", "<1"].map((test) =>
          ids(trials.filter(filterOf(axis.name + test, columns)))),
        told: pointText(points[0]),
        filled: dialog.fields[0].value ?? null,
      };
    });
"""
AXIS_TICKS = """
    const [kind, values] = given;
    const trials = values.map((x) => ({ point: { x }, score: null }));
    return module.axesOf([{ name: "x", kind, values: [] }], trials)[0].ticks.map(({ text }) => text);
"""
TICKS = """
    const host = document.querySelector("main");
    host.replaceChildren();
    const texts = [];
    const { fillText } = CanvasRenderingContext2D.prototype;
    CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {
      texts.push(text);
      return fillText.call(this, text, ...place);
    };
    const frames = (left, then) => (left ? requestAnimationFrame(() => frames(left - 1, then)) : then());
    const drawn = (show) => new Promise((resolve) => {
      frames(3, () => {
        texts.length = 0;
        show();
        frames(3, () => resolve([...texts]));
      });
    });
"""
PLOT_TICKS = f"""{TICKS}
    const plot = new module.Plot(host, {{ label: "A", height: 300, paint() {{}}, find: () => null }});
    return drawn(() => plot.setRange({{ x: given, y: given }}));
"""
FRONT_TICKS = """
    const host = document.querySelector("main");
    const chart = new module.FrontChart(host, { onOpen() {} });
    return given.map((values) => chart.plot.u.axes[0].values(chart.plot.u, values));
"""
TIMELINE_TICKS = f"""{TICKS}
    host.style.width = "1000px";
    const timeline = new module.Timeline(host, {{ isOpen: true, onOpen() {{}} }});
    const trials = [{{ trial_id: "t0000", index: 0, status: "completed", started_at: 1e9, ended_at: 1e9 + 86400 * given,
      node: "a", pid: 1, num_env_steps: 1, score: null }}];
    return drawn(() => timeline.show({{ data: {{ trials, now: () => 2e9 }}, matching: trials }}));
"""


def run_module(page: Page, name: str, script: str, given: Any) -> Any:
    """Run a script with a module of the page and something that is given to it."""
    page.open("#/file")
    made = f"""
        const [name, given, done] = arguments;
        import(new URL(`static/js/${{name}}.js`, document.baseURI))
          .then((module) => {{ {script} }}).then(done, (error) => done(String(error)));
    """
    return page.browser.execute_async_script(made, name, given)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("linear", [-123.456789, 7.5, 196.987654]),
        ("log", [1.23456789e-7, 1e-4, 9.87654321e-3]),
        ("near one", [0.9123456789, 0.99, 0.99912345678]),
    ],
)
def test_a_range_to_the_end_of_an_axis_has_the_trial_that_lies_there(
    page: Page, kind: str, values: list[float]
) -> None:
    low, _, high = values
    whole, upper, lower = run_module(page, "parallel_axes", RANGES, [kind, values])
    assert [float(end) for end in whole[0].split("..")] == [low, high]
    assert whole[1:] == [values, [0, 1]]
    assert high in upper[1]
    assert low not in upper[1]
    assert upper[2][1] == 1
    assert low in lower[1]
    assert high not in lower[1]
    assert lower[2][0] == 0


def test_a_trial_is_shown_with_the_values_that_its_score_was_reached_with(page: Page) -> None:
    trial = {"status": "completed", "seed_index": 0, "training_return": None, "num_env_steps": 1, "time_s": 1.0}
    given = [
        {**trial, "trial_id": "t0000", "index": 0, "point_index": 0, "score": 480.0, "point": {"lr": 0.0005},
         "score_point": {"lr": 0.01}},
        {**trial, "trial_id": "t0001", "index": 1, "point_index": 1, "score": 20.0, "point": {"lr": 0.002},
         "score_point": None},
    ]  # fmt: skip
    names, told = run_module(page, "sweep_data", SHOWN, given)
    assert names == ["lr"]
    assert told == [["0.01", 0.01, 0.01], ["0.002", 0.002, 0.002]]


def test_what_is_nearly_one_has_the_digits_that_the_command_line_gives(page: Page) -> None:
    values = [0.9, 0.9904, 0.99, 0.9994, 0.9995537, 0.99999, 0.95, 0.912345, 0.89, 1.0, 0.5, 123.456]
    told = run_module(page, "format", NEAR_ONE, values)
    assert told == [[short_text(value), setting_text(value)] for value in values]


def test_a_searched_null_is_a_value_and_not_what_does_not_act(page: Page) -> None:
    points: list[dict[str, Any]] = [{"grad_clip": None}, {"grad_clip": 0.5}, {"lr": 1}, {"grad_clip": None}]
    told = run_module(page, "sweep_data", UNSET, [{"grad_clip": {"grid": [None, 0.5]}, "lr": {"grid": [1]}}, points])
    assert told == {
        "ticks": ["not set", "0.5"], "places": [0, 1, None, 0], "unscored": None,
        # Those with a value of both axes, by which a line is found, too.
        "lines": [True] * 3, "near": ["3", "0"],
        "range": "not set", "cells": ["not set", "0.5", "", "not set"],
        "filtered": ["03", "12", "1", "03", "1"], "told": "grad_clip not set", "filled": None,
    }  # fmt: skip


def test_a_null_beside_a_range_has_no_place_on_it(page: Page) -> None:
    points: list[dict[str, Any]] = [{"lr": None}, {"lr": 0.1}, {"lr": 0.001}]
    told = run_module(page, "sweep_data", UNSET, [{"lr": {"loguniform": [0.001, 0.1]}}, points])
    assert told["places"] == [None, 1, 0]
    assert told["cells"] == ["not set", "0.1", "0.001"]
    assert told["lines"] == [True] * 2


def test_a_range_of_what_is_not_set_keeps_its_trials(page: Page, live: Live) -> None:
    values: list[Any] = [None, 0.5, None, 0.5, 1.0]
    made = make_sweep(name="clipped", points=[{"grad_clip": value} for value in values], with_best=False)
    write_sweep(live.storage, made, spec={"space": {"grad_clip": {"grid": [None, 0.5, 1.0]}}})
    page.open("#/sweeps/clipped?in.grad_clip=not+set")
    page.says(".trials-card", "2 of 5 trials")
    assert page.text(".trials-card").count("not set") == 2


def test_ticks_beside_each_other_have_different_labels(page: Page) -> None:
    given = [[498, 498.5, 499, 499.5, 500], [1_200_000, 1_202_000, 1_204_000], [495, 497.5, 500], [0, 0.5, 1], [7], []]
    assert run_module(page, "front_chart", FRONT_TICKS, given) == [
        ["498", "498.5", "499", "499.5", "500"], ["1.2M", "1.202M", "1.204M"], ["495", "497.5", "500"],
        ["0", "0.5", "1"], ["7"], [],
    ]  # fmt: skip
    told = run_module(page, "plot", PLOT_TICKS, [498, 500])
    assert {"498.5", "499", "499.5", "500"} <= set(told)
    whole = run_module(page, "plot", PLOT_TICKS, [15_000, 15_200])
    assert {"15.05K", "15.1K", "15.15K"} <= set(whole)


@pytest.mark.parametrize(
    ("kind", "values", "ticks"),
    [
        ("linear", [199, 201], ["199", "199.5", "200", "200.5", "201"]),
        ("linear", [0, 1000], ["0", "500", "1000"]),
        ("linear", [0.12, 0.121], ["0.12", "0.1205", "0.121"]),
        ("log", [1e-5, 1e-2], ["1e-5", "1e-4", "0.001", "0.01"]),
        ("near one", [0.9, 0.9999], ["0.9999", "0.999", "0.99", "0.9"]),
    ],
)
def test_ticks_of_an_axis_of_values_have_different_labels(
    page: Page, kind: str, values: list[float], ticks: list[str]
) -> None:
    assert run_module(page, "parallel_axes", AXIS_TICKS, [kind, values]) == ticks


@pytest.mark.parametrize(("days", "tick"), [(3, "2 d"), (30, "20 d"), (2000, "1000 d")])
def test_a_timeline_of_weeks_has_its_axis(page: Page, days: int, tick: str) -> None:
    assert tick in run_module(page, "timeline", TIMELINE_TICKS, days)


def test_a_condition_may_name_a_list_of_one_layer_by_its_number(page: Page) -> None:
    def space(sizes: list[Any], named: Any) -> dict[str, Any]:
        return {"hidden_sizes": {"grid": sizes}, "num_epochs": {"grid": [2, 4, 8], "when": {"hidden_sizes": named}}}

    given = [space([[64], [64, 64]], 64), space([64, [64, 64]], [64]), space([[64], [64, 64]], [64, 64])]
    values = [[64], 64, [64, 64], [32]]
    told = run_module(page, "domains", CONDITIONS, [{"space": each, "values": values} for each in given])
    assert told == [[4, [True, True, False, False]]] * 2 + [[4, [False, False, True, False]]]


def test_a_list_with_one_key_twice_stays_as_long_as_it_is(page: Page) -> None:
    told = run_module(page, "dom", RECONCILED, [["a", "a", "b"]] * 4 + [["b"]])
    assert [texts for texts, _ in told] == ["aab"] * 4 + ["b"]


def test_the_focus_stays_where_what_was_before_it_leaves_or_moves(page: Page) -> None:
    lists = [["a", "b", "c"], ["b", "c"], ["c"], ["c", "a"], ["a", "c"], ["x", "c", "a"], ["a"]]
    told = run_module(page, "dom", RECONCILED, [list(texts) for texts in lists])
    assert [texts for texts, _ in told] == ["".join(texts) for texts in lists]
    assert [focused for _, focused in told[:-1]] == ["c"] * 6


def test_the_focus_goes_with_a_row_and_to_the_table_where_it_leaves(page: Page) -> None:
    shown = [["t0001", "t0002", "t0003"], ["t0003", "t0001"], ["t0001", "t0003"], ["t0001"]]
    told = run_module(page, "trial_table", TABLE, shown)
    assert told == ["t0003", "t0003", "t0003", "scroller"]


def test_what_a_job_says_of_its_sweep_holds_until_somebody_resumes_it_elsewhere(page: Page) -> None:
    def sweep(ended_at: float, outcome: str, **job: Any) -> dict[str, Any]:
        told = {"state": "ended", "outcome": outcome, "ended_at": 200, "finish_failed": None, "message": None, **job}
        return {"state": "completed", "alive": False, "waiting": None, "ended_at": ended_at, "job": told}

    no_best = {"message": "No best policy: it broke.", "finish_failed": True}
    died = {"message": "The process that ran the sweep died 5 times."}
    told = run_module(page, "states", STATES, [
        sweep(190, "completed", **no_best), sweep(900, "completed", **no_best),
        sweep(190, "completed", message="1 of 4 trials failed.", finish_failed=False),
        sweep(190, "failed", **died), sweep(900, "failed", **died),
        sweep(190, "stopped"), {**sweep(190, "completed"), "job": None},
    ])  # fmt: skip
    assert told == [
        ["completed", "No best policy: it broke.", False], ["completed", "", True],
        ["completed", "1 of 4 trials failed.", True],
        ["failed", "The process that ran the sweep died 5 times.", False], ["completed", "", True],
        ["completed", "", True], ["completed", "", True],
    ]  # fmt: skip


def test_a_sweep_without_a_policy_says_why_and_can_be_resumed(page: Page, live: Live) -> None:
    name, queue = "pendulum-no-space", live.service.queue
    page.open(f"#/sweeps/{name}")
    page.button("More")
    resume = "return [...document.querySelectorAll('.actions button')].find((node) => node.textContent === 'Resume')"
    assert not page.run(f"{resume}.checkVisibility()")
    job = queue.begin(name, "drive", {}, owner="ann", num_cpus=1.0)[0]
    try:
        queue.end(job.id, "completed", "No best policy: it broke.", finish_failed=True)
        page.open(f"#/sweeps/{name}")
        page.says(".notice", "No best policy: it broke.")
        assert page.button("Resume", ".actions").is_displayed()
        assert page.violations() == []
    finally:
        queue.remove_sweep(name)


def test_a_dialog_stays_when_a_selection_in_it_ends_outside(page: Page) -> None:
    page.open("#/sweeps/pendulum-no-space")
    page.button("More").click()
    page.button("Note, tags, priority…").click()
    heading = page.one(".dialog h2")
    page.drag(heading, (20, 8), (-20, 0), (-300, 0))
    assert page.one(".dialog").is_displayed()
    # A click that is outside altogether closes it.
    page.drag(heading, (20, 8))
    assert page.one(".dialog").is_displayed()
    page.drag(heading, (-300, 8))
    page.wait("return document.querySelector('.dialog') === null")
