"""The report in a browser, driven as a reader would: sort, filter, brush, film; and nothing in its console."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from synthetic_sweep import make_points, make_sweep

from analysis.report import build_report
from analysis.settings import judge_settings
from policies.acting.movies import Mp4Writer
from tests.narrowing import present

selenium = pytest.importorskip("selenium", reason="selenium is not installed (make install)")

from page_browser import CHROMIUM, DRIVER  # noqa: E402
from selenium import webdriver  # noqa: E402
from selenium.webdriver import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

SECONDS = 120

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.skipif(DRIVER is None, reason="no chromedriver on this machine"),
]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of 60 trials: some failed, some cut early, all with times; and a film."""
    import numpy as np

    folder = tmp_path_factory.mktemp("browser")
    made = make_sweep(points=make_points(15, np.random.default_rng(3)), failed={3}, max_steps=20_000)
    for index, trial in enumerate(made.trials):
        times = {"started_at": 1e9 + 10 * (index // 4), "ended_at": 1e9 + 10 * (index // 4) + 8, "node": "192.0.2.1/a"}
        status = {"status": "stopped"} if index % 7 == 1 else {}
        made.trials[index] = trial.model_copy(update=times | status)
    with Mp4Writer(folder / "after.mp4", fps=10.0) as film:
        for shade in range(0, 250, 10):
            film.add(Image.new("RGB", (64, 48), (shade, 0, 0)))
    return build_report(
        str(folder), target=folder / "report", sweep=made.sweep, trials=made.trials, results=made.results,
        best=present(made.best), videos={"after": folder / "after.mp4"},
    )  # fmt: skip


@pytest.fixture
def page(browser: webdriver.Chrome, report: Path) -> Iterator[webdriver.Chrome]:
    """The report, opened anew at 1,280 px in the light; afterwards its console is empty."""
    emulate(browser, width=1280, theme="light")
    browser.get_log("browser")
    browser.get(report.as_uri())
    yield browser
    assert browser.get_log("browser") == []


def emulate(browser: webdriver.Chrome, *, width: int, theme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": theme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


def wait(browser: webdriver.Chrome, script: str, *arguments: Any) -> Any:
    """Wait until a script returns something true, and return it."""
    return WebDriverWait(browser, SECONDS).until(lambda driver: driver.execute_script(script, *arguments))


def drawn(browser: webdriver.Chrome, chart: str) -> Any:
    """Bring a chart into view, wait until it is drawn and return its first plot."""
    plot = browser.find_element(By.CSS_SELECTOR, f"[data-chart='{chart}'] .plot")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    wait(browser, "return arguments[0].querySelector('svg path') !== null", plot)
    return plot


def column(browser: webdriver.Chrome, heading: str) -> list[str]:
    """The values of a column of the table of trials, as they are shown."""
    script = """
        const table = document.querySelector("table.sortable");
        const column = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent.trim() === arguments[0]);
        return [...table.tBodies[0].rows].map((row) => row.cells[column].dataset.value);
    """
    found: list[str] = browser.execute_script(script, heading)
    return found


def test_a_heading_sorts_and_the_field_filters(page: webdriver.Chrome) -> None:
    heading = page.find_element(By.XPATH, "//table[contains(@class, 'sortable')]//th/button[text()='score']")
    page.execute_script("arguments[0].click()", heading)
    scores = [float(value) for value in column(page, "score") if value]
    assert scores == sorted(scores)
    page.execute_script("arguments[0].click()", heading)
    assert [float(value) for value in column(page, "score") if value] == sorted(
        (float(value) for value in column(page, "score") if value), reverse=True
    )
    field = page.find_element(By.CSS_SELECTOR, "#trial-controls input")
    page.execute_script("arguments[0].scrollIntoView({block: 'center'})", field)
    field.send_keys("relu score>100")
    assert set(column(page, "activation")) == {"relu"}
    assert all(float(value) > 100 for value in column(page, "score"))


def test_a_range_on_an_axis_keeps_the_table_to_its_trials(page: webdriver.Chrome) -> None:
    plot = drawn(page, "parallel_coordinates")
    before = column(page, "trial")
    # The first axis is 50 px from the left; a press and a move make a range.
    left, middle = 50 - plot.size["width"] // 2, 60 - plot.size["height"] // 2
    drag = ActionChains(page).move_to_element_with_offset(plot, left, middle).click_and_hold()
    drag.move_by_offset(0, 40).move_by_offset(0, 60).release().perform()
    said = wait(page, "return document.querySelector('#chart-parallel_coordinates .said').textContent")
    num_chosen = int(said.split(" ")[0])
    assert 0 < num_chosen < 60
    assert len(column(page, "trial")) == min(num_chosen, len(before))
    assert f"({num_chosen} match)" in page.find_element(By.ID, "trial-controls").text
    ActionChains(page).move_to_element_with_offset(plot, left, 200 - plot.size["height"] // 2).click().perform()
    wait(page, "return document.querySelector('#chart-parallel_coordinates .said').textContent === ''")
    assert column(page, "trial") == before


def test_the_film_plays(page: webdriver.Chrome) -> None:
    film = page.find_element(By.TAG_NAME, "video")
    page.execute_script("arguments[0].scrollIntoView(); arguments[0].play()", film)
    assert wait(page, "return arguments[0].currentTime > 0 && arguments[0].videoWidth === 64", film)


def test_marks_tell_their_numbers_and_a_legend_hides_lines(page: webdriver.Chrome) -> None:
    plot = drawn(page, "heat_map")
    ActionChains(page).move_to_element_with_offset(plot, -plot.size["width"] // 4, 0).perform()
    assert "mean score" in wait(page, "return arguments[0].querySelector('.tip')?.innerText", plot)
    plot = drawn(page, "curves_of_settings")
    num_paths = page.execute_script("return arguments[0].querySelectorAll('path').length", plot)
    key = page.find_element(By.XPATH, "//*[@id='chart-curves_of_settings']//button[starts-with(., '1.')]")
    page.execute_script("arguments[0].click()", key)
    assert key.get_attribute("aria-pressed") == "false"
    assert wait(page, "return arguments[0].querySelectorAll('path').length < arguments[1]", plot, num_paths)


def test_whole_numbers_are_told_with_all_of_their_digits(browser: webdriver.Chrome, tmp_path: Path) -> None:
    sizes = (65536, 1000, 12345)
    points = [{"train_batch_size": size, "lr": lr} for size, lr in zip(sizes, (0.0012341, 0.002, 0.003), strict=True)]
    made = make_sweep(points=points, with_best=False)
    space = {"train_batch_size": {"lograndint": [1000, 70000]}, "lr": {"loguniform": [1e-4, 1e-2]}}
    sweep = made.sweep.model_copy(update={"spec": made.sweep.spec | {"space": space}})
    report = build_report(
        str(tmp_path), target=tmp_path / "report", sweep=sweep, trials=made.trials, results=made.results,
        best=None, videos={},
    )  # fmt: skip
    browser.get(report.as_uri())
    plot = drawn(browser, "hyperparameters")
    tip = """
        const chart = echarts.getInstanceByDom(arguments[0]);
        chart.dispatchAction({ type: "showTip", seriesIndex: 0, dataIndex: arguments[1] });
        return arguments[0].querySelector(".tip")?.innerText;
    """
    for index, (size, lr) in enumerate([("65,536", "0.001234"), ("1,000", "0.002"), ("12,345", "0.003")]):
        told = wait(browser, tip, plot, index).splitlines()
        assert {f"train_batch_size: {size}", f"lr: {lr}"} <= set(told)


def test_a_goal_above_all_scores_is_in_every_chart_of_scores(browser: webdriver.Chrome, tmp_path: Path) -> None:
    made = make_sweep(points=[{"lr": 1e-7}, {"lr": 2e-7}])
    # So short that costs are drawn to a logarithmic scale.
    made.results["t0000"] = made.results["t0000"][:1]
    made.trials[0] = made.trials[0].model_copy(update={"num_env_steps": 1024, "num_iterations": 1})
    spec = made.sweep.spec | {"objective": {"type": "final", "cost": "env_steps"}}
    settings = judge_settings(made.trials, made.results, num_env_steps=50_000, threshold=195.0, cost="env_steps")
    report = build_report(
        str(tmp_path), target=tmp_path / "report", sweep=made.sweep.model_copy(update={"spec": spec}),
        trials=made.trials, results=made.results, best=present(made.best).model_copy(update={"settings": settings}),
        videos={},
    )  # fmt: skip
    browser.get(report.as_uri())
    top = """
        const chart = echarts.getInstanceByDom(arguments[0]);
        return chart.getModel().getComponent("yAxis").axis.scale.getExtent()[1];
    """
    tip = """
        const chart = echarts.getInstanceByDom(arguments[0]), { series } = chart.getOption();
        const [x, y] = chart.convertToPixel("grid", series.at(-1).data[0]);
        chart.dispatchAction({ type: "showTip", x, y });
        return arguments[0].querySelector(".tip")?.innerText;
    """
    for name in ("curves_of_settings", "best_so_far", "score_against_cost"):
        plot = drawn(browser, name)
        assert wait(browser, top, plot) >= 195
        assert "goal 195" in browser.execute_script("return arguments[0].textContent", plot)
        # What keeps the goal within the axis is no value that a tooltip tells.
        assert "195" not in wait(browser, tip, plot)
    scale = "return echarts.getInstanceByDom(arguments[0]).getOption().xAxis[0].type"
    assert browser.execute_script(scale, plot) == "log"


def test_of_many_categories_those_with_colors_have_keys(browser: webdriver.Chrome, tmp_path: Path) -> None:
    made = make_sweep(points=[{"activation": f"a{i:02d}", "lr": 1e-3} for i in range(30)], with_best=False)
    report = build_report(
        str(tmp_path), target=tmp_path / "report", sweep=made.sweep, trials=made.trials, results=made.results,
        best=None, videos={},
    )  # fmt: skip
    browser.get(report.as_uri())
    plot = drawn(browser, "hyperparameters")
    keys = browser.find_elements(By.CSS_SELECTOR, "#chart-hyperparameters .keys li")
    assert [key.text for key in keys] == [*(f"activation a{i:02d}" for i in range(6)), "24 other values"]
    boxes = browser.execute_script(
        """
        return [...arguments[0].querySelectorAll("svg text")].filter((text) => /^a\\d\\d$/.test(text.textContent))
          .map((text) => text.getBoundingClientRect()).map(({ left, right }) => [left, right]);
        """,
        plot,
    )
    assert 2 < len(boxes) <= 30
    assert all(one[1] <= two[0] for one, two in itertools.pairwise(sorted(boxes)))


@pytest.mark.parametrize("width", [400, 1280, 1920])
def test_charts_fit_and_follow_width_and_theme(page: webdriver.Chrome, width: int) -> None:
    emulate(page, width=width, theme="light")
    fits = "const svg = arguments[0].querySelector('svg'); return svg.clientWidth === arguments[0].clientWidth"
    charts = [box.get_attribute("data-chart") for box in page.find_elements(By.CSS_SELECTOR, "[data-chart]")]
    assert len(charts) == 7
    for chart in charts:
        assert wait(page, fits, drawn(page, present(chart)))
    assert page.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    ink = "return arguments[0].querySelector('svg text').getAttribute('fill')"
    plot = drawn(page, "hyperparameters")
    assert page.execute_script(ink, plot) == "#24292f"
    emulate(page, width=width, theme="dark")
    assert wait(page, f"{ink} === '#e6edf3'", plot)


def test_paper_has_every_chart_in_the_light(page: webdriver.Chrome) -> None:
    emulate(page, width=1280, theme="dark")
    page.execute_script("dispatchEvent(new Event('beforeprint'))")
    plots = page.execute_script("""
        const ink = (plot) => plot.querySelector("svg text").getAttribute("fill");
        return [...document.querySelectorAll(".plot")].map(ink);
    """)
    assert len(plots) > 7
    assert set(plots) == {"#24292f"}
    page.execute_script("dispatchEvent(new Event('afterprint'))")
    assert wait(page, "return document.querySelector('.plot svg text').getAttribute('fill') === '#e6edf3'")


def test_without_scripts_there_are_pictures(browser: webdriver.Chrome, report: Path) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.get(report.as_uri())
        pictures = browser.find_elements(By.CSS_SELECTOR, ".chart noscript svg")
        assert len(pictures) == 7
        assert all(picture.size["height"] > 100 for picture in pictures)
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
