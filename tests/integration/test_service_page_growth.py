"""A sweep that grows, on the page: how many trials are added, and the result that it had while it goes on."""

from collections.abc import Iterator

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from selenium.webdriver.common.keys import Keys
from synthetic_sweep import make_sweep

from analysis.best_records import SettingRecord, SettingsRecord
from analysis.page.scores import interval_of, score_text
from analysis.records import Objective
from tune_jobs.store.sweep_store import SweepStore

pytestmark = IN_A_BROWSER
SPACE = {
    "lr": {"loguniform": [1e-5, 1e-1]},
    "hidden_sizes": {"grid": [[32], [64]]},
    "activation": {"grid": ["relu", "tanh"]},
}
POINTS = [{"lr": lr, "hidden_sizes": [32], "activation": "relu"} for lr in (1e-5, 3e-3, 2e-2)]


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    spec = {"space": SPACE, "seeds_per_point": 2}
    store = write_sweep(storage, make_sweep(name="mine", points=POINTS, seeds_per_point=2, max_steps=20_000), spec=spec)
    for name in ("policy.json", "policy.safetensors"):
        (store.best_folder / name).write_text("{}")
    made = make_sweep(name="tpe", points=POINTS, with_best=False, max_steps=5_000)
    write_sweep(storage, made, spec={"space": SPACE, "search": {"type": "tpe"}, "seeds_per_point": 1})
    with serving(storage) as found:
        yield found


def open_dialog(page: Page, label: str, sweep: str = "mine", **how: object) -> None:
    page.open(f"#/sweeps/{sweep}", **how)  # type: ignore[arg-type]
    page.says(".trials-card", "trials")
    page.button("More").click()
    page.button(label).click()


def test_an_extension_says_how_many_trials_come_of_the_number_as_it_is_typed(page: Page) -> None:
    open_dialog(page, "Extend…")
    page.says("dialog .told", "Adds 32 trials: 16 points, each with 2 seeds.")
    # What stands there is replaced.
    page.keys("1")
    assert page.one("dialog input").get_attribute("value") == "1"
    page.says("dialog .told", "Adds 8 trials: 4 points, each with 2 seeds.")
    page.keys("2")
    page.says("dialog .told", "Adds 96 trials: 48 points, each with 2 seeds.")
    page.keys(Keys.BACKSPACE, Keys.BACKSPACE)
    assert page.text("dialog .told") == ""
    # TPE draws from the grids too.
    open_dialog(page, "Extend…", "tpe")
    page.says("dialog .told", "Adds 4 trials: 4 points, each with 1 seed.")


def test_a_replication_says_how_many_trials_there_are_at_most(page: Page) -> None:
    open_dialog(page, "Replicate leaders…")
    page.says("dialog .told", "Adds at most 15 trials: 3 settings, each with up to 5 more seeds.")
    page.keys("2", Keys.TAB, "1")
    page.says("dialog .told", "Adds at most 2 trials: 2 settings, each with up to 1 more seed.")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280])
def test_the_dialog_is_accessible_and_fits(page: Page, width: int, theme: str) -> None:
    open_dialog(page, "Replicate leaders…", width=width, theme=theme)
    assert page.violations() == []
    box = page.run("return document.querySelector('dialog').getBoundingClientRect().toJSON()")
    assert box["left"] >= 0
    assert box["right"] <= width


def test_the_result_stays_and_is_told_as_an_earlier_one_until_there_is_a_new_one(page: Page, live: Live) -> None:
    store = SweepStore(live.storage / "mine")
    record = store.read_record()
    page.open("#/sweeps/mine")
    page.says(".finished h2", "Result")
    assert "earlier result" not in page.text(".finished")
    score = page.text(".finished .score")
    try:
        store.write_record(record.model_copy(update={"state": "interrupted", "ended_at": None}))
        page.says(".finished .notice", "An earlier result, from before the trials that have not ended yet.")
        assert page.text(".finished .score") == score
        # Who comes only now sees the same.
        page.open("#/sweeps/mine")
        page.says(".finished .notice", "Resume the sweep for a new one.")
        assert page.violations() == []
    finally:
        store.write_record(record)
    page.wait("return document.querySelector('.finished .notice') === null")
    assert page.text(".finished .score") == score


@pytest.mark.parametrize(
    ("objective", "score", "expected", "lower", "upper"),
    [("final", 197.04, 195.4, 181.3, 212.6), ("steps_to_threshold", -51_200.0, -53_000.0, -60_000.0, -44_000.0)],
)
def test_the_score_of_the_setting_is_that_of_the_report(
    page: Page, live: Live, *, objective: Objective, score: float, expected: float, lower: float, upper: float
) -> None:
    store = SweepStore(live.storage / "mine")
    best = store.read_best()
    setting = SettingRecord(
        point_index=0, point=best.point, trial_ids=("t0000",), scores=(score,), num_failed=0, score=score,
        expected=expected, lower=lower, upper=upper,
    )  # fmt: skip
    settings = SettingsRecord(objective=objective, num_settings=3, num_may_be_best=1, ranking=(setting,))
    try:
        store.write_best(best.model_copy(update={"settings": settings}))
        page.open("#/sweeps/mine")
        page.says(".finished h2", "Result")
        told = page.text(".finished .answers")
        assert f"{score_text(settings, score)} " in told
        assert f"(95 % interval {interval_of(settings, setting)}), from 1 seed" in told
    finally:
        store.write_best(best)
