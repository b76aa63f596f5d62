"""Score against cost on the page of a sweep: the front as it is drawn and listed, live and from a file."""

import gzip
import json
import time
from pathlib import Path

import pytest
from live_service import Live
from page_browser import IN_A_BROWSER, Page
from page_sweeps import HOSTILE, write_sweep
from selenium.webdriver import ActionChains
from synthetic_sweep import make_sweep

from analysis.records import TrialRecord
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.results import front_view_of
from tune_jobs.sweeps.sweep_file import sweep_file

pytestmark = IN_A_BROWSER
VIEW = "#/sweeps/both"
CELLS = (
    "return [...document.querySelectorAll('.front tbody tr')].map((row) => [...row.cells].map((at) => at.innerText))"
)
COST = {"objective": {"type": "final", "cost": "env_steps"}}


@pytest.fixture(scope="module")
def store(live: Live) -> SweepStore:
    """Settings with a condition, a hostile value and one that is long."""
    points = [
        {"lr": 10.0 ** -(2 + index / 2), "hidden_sizes": [64]} | ({"entropy_coeff": 0.25 * index} if index % 2 else {})
        for index in range(6)
    ]
    points[0] |= {"activation": HOSTILE}
    points[1] |= {"activation": "long " * 60}
    made = make_sweep(name="both", points=points, seeds_per_point=3)
    space = {"lr": {"loguniform": [1e-5, 1e-1]}, "hidden_sizes": {"choice": [[64]]}, "activation": {"choice": ["relu"]}}
    return write_sweep(live.storage, made, created_at=time.time() - 60, spec=COST | {"space": space})


def test_a_front_of_which_some_are_listed_is_drawn_whole(
    page: Page, live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_sweep(name="cut", points=[{"lr": 10.0 ** -(2 + index / 2)} for index in range(6)], seeds_per_point=3)
    spec = COST | {"space": {"lr": {"loguniform": [1e-5, 1e-1]}}}
    store = write_sweep(live.storage, made, created_at=time.time() - 60, spec=spec)
    whole = front_view_of(store).front
    assert whole is not None
    assert len(whole.points) > 1
    monkeypatch.setattr("analysis.front._NUM_LISTED", 1)
    page.open("#/sweeps/cut")
    page.says(".front", "The cheapest near the best:")
    assert len(page.run(CELLS)) == 1 + len(whole.undecided)
    drawn = str(page.one(".front .plot").get_attribute("aria-label"))
    dearest = f"for {round(whole.points[-1].num_env_steps):,} env steps"
    assert f"on the front {len(whole.points)} settings from " in drawn
    assert drawn.removesuffix(".").endswith(dearest), drawn


def test_the_front_is_drawn_and_listed(page: Page, store: SweepStore) -> None:
    front = front_view_of(store).front
    assert front is not None
    page.open(VIEW)
    page.says(".front", "The cheapest near the best:")
    rows = page.run(CELLS)
    assert len(rows) == len(front.points) + len(front.undecided)
    heads = page.run("return [...document.querySelectorAll('.front thead th')].map((head) => head.innerText)")
    assert heads[:5] == ["env steps", "score", "95 % interval", "rank", "on the front"]
    assert [row[4] for row in rows].count("yes, the cheapest near the best") == 1
    listed = {row[3]: dict(zip(heads, row, strict=True)) for row in rows}
    for item in (*front.points, *front.undecided):
        row = listed[str(item.rank)]
        assert row["env steps"] == f"{round(item.num_env_steps):,}"
        assert row["score"] == f"{item.score:.1f}"
        # What does not act in a setting is empty.
        for name in ("entropy_coeff", "activation"):
            assert (row.get(name, "") != "") == (name in item.point)
        assert row["hidden_sizes"] == "64"
    assert any("entropy_coeff" in item.point for item in front.points)
    assert any("entropy_coeff" not in item.point for item in front.points)
    drawn = page.one(".front .plot").get_attribute("aria-label")
    assert f"on the front {front.num_on_front} settings" in str(drawn)
    assert "the front" in page.text(".front .keys")


def test_a_setting_is_named_under_the_cursor_and_opens(page: Page, store: SweepStore) -> None:
    front = front_view_of(store).front
    assert front is not None
    page.open(VIEW)
    page.says(".front", "The cheapest near the best:")
    over = page.one(".front .u-over")
    # The dearest of the front is the best, at its right upper end.
    width, height = over.size["width"], over.size["height"]
    share = front.points[-1].num_env_steps / (1.03 * 50_176)
    for down in range(6, 60, 6):
        place = (round(width * share - width / 2), round(down - height / 2))
        ActionChains(page.browser).move_to_element_with_offset(over, *place).perform()
        if page.run("return !document.querySelector('.front .tip').hidden"):
            break
    page.says(".front .tip", "rank 1, the best")
    assert f"{round(front.points[-1].num_env_steps):,} env steps a training" in page.text(".front .tip")
    assert "lr " in page.text(".front .tip")
    over.click()
    # Whoever has no mouse opens it from the table.
    page.open(VIEW)
    page.says(".front", "The cheapest near the best:")
    link = page.one(".front tbody button")
    trial = link.text
    link.click()
    page.says("#trial-title", trial)


@pytest.mark.parametrize(("width", "theme"), [(400, "light"), (1280, "dark"), (1920, "light")])
def test_it_has_no_barriers_and_fits_each_width(page: Page, store: SweepStore, width: int, theme: str) -> None:
    page.open(VIEW, width=width, theme=theme)
    page.says(".front", "The cheapest near the best:")
    assert page.violations() == []
    assert page.run("return document.documentElement.scrollWidth <= innerWidth")


def test_who_asks_for_no_cost_sees_nothing_of_it(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo")
    page.says(".importance .shares", "%")
    assert page.run("return document.querySelector('.front').checkVisibility()") is False


def test_a_file_shows_the_same(page: Page, store: SweepStore, tmp_path: Path) -> None:
    page.open(VIEW)
    page.says(".front", "The cheapest near the best:")
    served = page.run(CELLS), page.text(".front .keys"), page.text(".front > p")
    (tmp_path / "both.tunejobs").write_bytes(sweep_file(store))
    page.open("#/file")
    page.browser.find_element("id", "chosen-file").send_keys(str(tmp_path / "both.tunejobs"))
    page.says(".front", "The cheapest near the best:")
    assert (page.run(CELLS), page.text(".front .keys"), page.text(".front > p")) == served


def test_costs_of_a_file_that_are_beyond_all_axes_stop_nothing(page: Page, store: SweepStore, tmp_path: Path) -> None:
    content = json.loads(gzip.decompress(sweep_file(store)))
    content["front"]["costs_lie_far_apart"] = True
    content["front"]["cheapest_near"] = HOSTILE
    for costs in ((0.0, 1e-300, 1.7e308), (1e-300, 1.7e308, 1.0), (5.0, 5.0, 5.0 + 1e-12)):
        for index, item in enumerate(content["front"]["front"]["points"]):
            item["num_env_steps"] = costs[index % 3]
            item["expected"] = (-1) ** index * 1.7e308
        (tmp_path / "odd.tunejobs").write_bytes(gzip.compress(json.dumps(content).encode()))
        page.open("#/file")
        page.browser.find_element("id", "chosen-file").send_keys(str(tmp_path / "odd.tunejobs"))
        page.says(".front > p", HOSTILE)


# How many dots of the canvas have the front's colour.
PAINTED = """
    const canvas = document.querySelector(".front canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const told = getComputedStyle(document.documentElement).getPropertyValue("--series-0").trim();
    const of = [1, 3, 5].map((start) => parseInt(told.slice(start, start + 2), 16));
    let count = 0;
    for (let at = 0; at < data.length; at += 4) count += of.every((value, index) => data[at + index] === value);
    return count;
"""


def test_costs_of_a_file_that_begin_at_nothing_are_drawn(page: Page, store: SweepStore, tmp_path: Path) -> None:
    content = json.loads(gzip.decompress(sweep_file(store)))
    # No logarithm has room for the first, whatever a file says.
    content["front"]["costs_lie_far_apart"] = True
    for index, item in enumerate(content["front"]["front"]["points"]):
        item["num_env_steps"] = index * 1000.0
    (tmp_path / "free.tunejobs").write_bytes(gzip.compress(json.dumps(content).encode()))
    page.open("#/file")
    page.browser.find_element("id", "chosen-file").send_keys(str(tmp_path / "free.tunejobs"))
    page.says(".front", "The cheapest near the best:")
    # A line of 2 from side to side, and more.
    page.until(lambda: page.run(PAINTED) > 200, "the front is not painted")


def test_it_comes_as_trials_end(page: Page, live: Live, store: SweepStore) -> None:
    made = make_sweep(name="runs", points=[{"lr": 0.01}, {"lr": 0.001}, {"lr": 0.02}], with_best=False)
    told = made.trials.copy()
    made.trials[1:] = [_pending(trial) for trial in told[1:]]
    rows = {name: made.results[name] for name in ("t0001", "t0002")}
    made.results |= {name: [] for name in rows}
    runs = write_sweep(live.storage, made, created_at=time.time(), state="running", ended_at=None, spec=COST)
    with runs.lock():
        page.open("#/sweeps/runs")
        page.says(".front", "Said once trials of two settings have ended.")
        for trial in told[1:]:
            runs.trial(trial.trial_id).append_iterations(rows[trial.trial_id])
            runs.trial(trial.trial_id).write_record(trial)
        page.says(".front", "The cheapest near the best:")
    runs.delete()


def _pending(trial: TrialRecord) -> TrialRecord:
    return TrialRecord.model_validate(
        {name: getattr(trial, name) for name in ("trial_id", "index", "point_index", "seed_index", "seed", "point")}
        | {"status": "pending"}
    )
