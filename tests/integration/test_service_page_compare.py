"""The service's page in a browser: sweeps side by side, and the timeline of a sweep."""

from collections.abc import Iterator

import numpy as np
import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_large, write_storage, write_sweep
from selenium.webdriver import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from synthetic_sweep import make_points, make_sweep

pytestmark = IN_A_BROWSER
BOTH = "#/compare?sweeps=cartpole-ppo,cartpole-seeds"
TIMELINE = "#/sweeps/cartpole-seeds?timeline=open"


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    write_storage(storage)
    for number in range(5):
        made = make_sweep(
            name=f"other-{number}", points=make_points(2, np.random.default_rng(number)), seeds_per_point=3,
            seed=number, max_steps=30_000 + 5_000 * number,
        )  # fmt: skip
        stop = {"num_env_steps": 30_000 + 5_000 * number}
        write_sweep(storage, made, spec={"space": {"lr": {"loguniform": [1e-7, 1e-2]}}, "stop": stop})
    with serving(storage) as found:
        yield found


def box(page: Page, name: str) -> str:
    """Choose a sweep by the keyboard, as a reader without a mouse would."""
    page.one(f'[data-compare="{name}"]')
    page.run('document.querySelector(`[data-compare="${arguments[0]}"]`).focus()', name)
    page.keys(Keys.SPACE)
    return page.text(".compare-bar")


# -- compare


def test_sweeps_are_chosen_on_the_list_and_compared(page: Page) -> None:
    page.open()
    assert "1 sweep chosen: cartpole-ppo. Choose another" in box(page, "cartpole-ppo")
    assert page.one(".compare-bar .primary").get_attribute("href") is None
    assert "different environments (CartPole-v0, Pendulum-v1)" in box(page, "pendulum-no-space")
    box(page, "pendulum-no-space")
    assert "2 sweeps chosen" in box(page, "cartpole-seeds")
    assert "compare=cartpole-ppo,cartpole-seeds" in page.address()
    page.browser.refresh()
    page.button("Compare", ".compare-bar").click()
    page.says("h1", "Compare cartpole-ppo, cartpole-seeds")
    assert page.address() == BOTH
    page.says(".verdicts", "P(A > B)")
    page.says(".compared", "PPO on CartPole-v0")
    page.says(".notes", "A leads")
    page.says(".curves .keys", "B: cartpole-seeds")
    page.browser.back()
    page.says(".compare-bar", "2 sweeps chosen")


def test_a_curve_of_some_of_the_seeds_says_so(page: Page, live: Live) -> None:
    made = make_sweep(name="crashed", points=[{"lr": 3e-3}], seeds_per_point=3, failed={1, 2})
    for trial_id in ("t0001", "t0002"):
        # They failed before their first evaluation.
        made.results[trial_id] = made.results[trial_id][:4]
    write_sweep(live.storage, made)
    page.open("#/compare?sweeps=cartpole-seeds,crashed")
    page.says(".curves", "one that failed before it showed any is left out")
    page.says(".curves", "B is of 1 of 3 seeds.")
    assert "A is of" not in page.text(".curves")


def test_another_address_shows_nothing_of_the_comparison_before(page: Page) -> None:
    page.open(BOTH)
    page.says(".verdicts", "P(A > B)")
    # The next answer never comes.
    page.run("window.fetch = () => new Promise(() => {})")
    page.run("location.hash = arguments[0]", "#/compare?sweeps=other-0,other-1")
    page.wait("return document.querySelector('.compare-grid').hidden")


def test_at_most_six_are_chosen(page: Page) -> None:
    page.open("#/?compare=cartpole-ppo,cartpole-seeds,other-0,other-1,other-2,other-3")
    page.says(".compare-bar", "6 sweeps chosen")
    seventh = page.one('[data-compare="other-4"]')
    assert not seventh.is_enabled()
    page.one('[data-compare="other-0"]').click()
    page.until(seventh.is_enabled)
    page.button("Clear", ".compare-bar").click()
    page.wait("return document.querySelector('.compare-bar').hidden")
    assert page.address() == "#/"


def test_a_box_chooses_and_the_rest_of_the_row_opens_the_sweep(page: Page) -> None:
    page.open()
    page.one('[data-compare="other-1"]').click()
    page.says(".compare-bar", "1 sweep chosen")
    row = page.browser.find_element(By.CSS_SELECTOR, 'tr[data-key="other-1"] .created')
    # The whole row is the link's.
    ActionChains(page.browser).move_to_element(row).click().perform()
    page.says("h1", "other-1")


def test_six_sweeps_have_six_colours_and_lines_open_them(page: Page) -> None:
    names = ["cartpole-ppo", "cartpole-seeds", "other-0", "other-1", "other-2", "other-3"]
    page.open(f"#/compare?sweeps={','.join(names)}")
    page.says(".best-card .keys", "F: other-3")
    marks = page.run("""
        const colourOf = (mark) => getComputedStyle(mark).backgroundColor;
        return [...document.querySelectorAll(".best-card .keys .mark")].map(colourOf);
    """)
    assert len(set(marks)) == 6
    page.says(".compared", "stop.num_env_steps")
    over = page.one(".curves .u-over")
    right = over.size["width"] // 2 - 30
    # The best are at the upper end.
    for down in range(-over.size["height"] // 2 + 4, 0, 6):
        ActionChains(page.browser).move_to_element_with_offset(over, right, down).perform()
        if not page.run("return document.querySelector('.curves .tip').hidden"):
            break
    page.says(".curves .tip", "env steps")
    page.browser.find_element(By.CSS_SELECTOR, ".best-card .keys li:nth-child(3) button").click()
    page.says("h1", "other-0")


def test_what_cannot_be_compared_is_said_on_the_page(page: Page) -> None:
    page.open("#/compare?sweeps=cartpole-ppo,pendulum-no-space")
    page.says("[role=alert]", "cartpole-ppo is on CartPole-v0, pendulum-no-space on Pendulum-v1")
    page.open("#/compare?sweeps=cartpole-ppo,nothing%3Cb%3E")
    page.says("[role=alert]", "There is no sweep 'nothing<b>'.")
    page.open("#/compare")
    page.says("[role=alert]", "0 sweeps were given")
    # Another address in the same view is another comparison.
    page.run(f"location.hash = '{BOTH}'")
    page.says(".verdicts", "P(A > B)")
    page.wait("return document.querySelector('[role=alert]').hidden")


def test_a_comparison_of_running_sweeps_is_kept_up_to_date(page: Page, live: Live) -> None:
    made = make_sweep(name="growing", points=[{"lr": 1e-3}, {"lr": 3e-3}], with_best=False, max_steps=20_000)
    store = write_sweep(
        live.storage, made, state="running", ended_at=None, spec={"space": {"lr": {"grid": [1e-3, 3e-3]}}}
    )
    trial = store.trial("t0001")
    record, rows = trial.read_record(), trial.read_iterations()
    trial.write_record(record.model_copy(update={"status": "running", "ended_at": None}))
    with store.lock():
        page.open("#/compare?sweeps=growing,cartpole-ppo")
        page.says(".notes", "1 of 2 trials have ended")
        last = rows[-1].model_copy(
            update={"iteration": len(rows) + 1, "num_env_steps": 25_000, "evaluation_return": 654.3}
        )
        trial.append_iterations([last])
        trial.write_record(record.model_copy(update={"status": "running", "ended_at": None, "num_env_steps": 25_000}))
        page.says(".best-card .keys", "654.3")
    store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))


# -- the timeline


def bars(page: Page) -> str:
    return str(page.one(".walker").get_attribute("aria-valuetext"))


def test_the_timeline_unfolds_and_is_walked_by_keys(page: Page) -> None:
    page.open("#/sweeps/cartpole-seeds")
    page.says(".timeline", "Which trial ran when")
    assert page.run("return document.querySelector('.timeline canvas')") is None
    page.run("document.querySelector('.timeline summary').focus()")
    page.keys(Keys.ENTER)
    page.says(".timeline", "Each bar is a trial, from its first start to its last end")
    page.says(".timeline .keys", "46 completed")
    assert "timeline=open" in page.address()
    page.keys(Keys.TAB)
    page.until(lambda: "Trial, by when it began" in page.focused())
    assert bars(page).startswith("t0000, completed, ")
    page.keys(Keys.ARROW_RIGHT)
    assert bars(page).startswith("t0001, completed, ")
    page.says(".timeline .tip", "t0001, completed")
    page.says(".timeline .tip", "50,176 env steps")
    page.says(".timeline .tip", "192.0.2.1")
    page.keys(Keys.END)
    assert bars(page).startswith("t0045, completed, ")
    page.keys(Keys.HOME, Keys.ARROW_DOWN)
    assert bars(page).startswith("t0001")
    page.keys(Keys.ENTER)
    page.says("#trial-title", "t0001")
    page.browser.refresh()
    page.says(".timeline", "Each bar is a trial")


def test_a_trial_is_hovered_and_clicked(page: Page) -> None:
    page.open(TIMELINE)
    page.says(".timeline", "Each bar is a trial")
    over = page.one(".timeline .u-over")
    page.run("arguments[0].scrollIntoView({ block: 'center' })", over)
    left, top = over.size["width"] // 2, over.size["height"] // 2
    ActionChains(page.browser).move_to_element_with_offset(over, 4 - left, 5 - top).perform()
    page.wait("return !document.querySelector('.timeline .tip').hidden")
    shown = page.text(".timeline .tip b").split(",")[0]
    ActionChains(page.browser).click().perform()
    page.says("#trial-title", shown)


def test_a_timeline_grows_while_trials_run(page: Page, live: Live) -> None:
    made = make_sweep(name="busy", points=[{"lr": 1e-3}, {"lr": 1e-2}], with_best=False, max_steps=20_000, pending={1})
    store = write_sweep(
        live.storage, made, state="running", ended_at=None, spec={"space": {"lr": {"grid": [1e-3, 1e-2]}}}
    )
    with store.lock():
        page.open("#/sweeps/busy?timeline=open")
        page.says(".timeline .keys", "1 completed")
        assert "running" not in page.text(".timeline .keys")
        trial = store.trial("t0001")
        record = store.trial("t0000").read_record()
        changes = {"status": "running", "started_at": record.started_at, "time_s": 2.0, "node": "192.0.2.1/a", "pid": 7}
        trial.write_record(trial.read_record().model_copy(update=changes))
        page.says(".timeline .keys", "1 running")
    store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))


def test_a_timeline_of_ten_thousand_trials_is_drawn_at_once(page: Page, live: Live) -> None:
    write_large(live.storage)
    page.open("#/sweeps/large?timeline=open")
    page.says(".trials-card", "10,000 trials")
    page.says(".timeline", "The records hold no times of trials.")
    took = page.browser.execute_async_script("""
        const done = arguments[arguments.length - 1];
        import(new URL("static/js/timeline_layout.js", document.baseURI).href).then(({ layOut }) => {
          const trials = Array.from({ length: 10000 }, (_, index) => ({
            trial_id: `t${index}`, index, status: "completed", time_s: 9, node: `192.0.2.${index % 4}/x`, pid: index,
            started_at: 1000 + 10 * Math.floor(index / 64), ended_at: 1009 + 10 * Math.floor(index / 64),
          }));
          const began = performance.now();
          const found = layOut(trials);
          done([performance.now() - began, found.numRows, found.bars.length, found.nodes.length]);
        });
    """)
    assert took[1:] == [64, 10_000, 4]
    assert took[0] < 1_000


def test_rows_are_places_of_nodes_that_processes_keep(page: Page) -> None:
    page.open()
    lay_out = """
        const done = arguments[arguments.length - 1];
        const trials = arguments[0].map(([node, pid, started_at, ended_at], index) => ({
          trial_id: `t${index}`, index, status: ended_at === null ? "running" : "completed", time_s: 5,
          node, pid, started_at, ended_at,
        }));
        import(new URL("static/js/timeline_layout.js", document.baseURI).href).then(({ layOut }) => {
          const found = layOut(trials);
          done([
            Object.fromEntries(found.bars.map((bar) => [bar.trial.trial_id, [bar.row, bar.from, bar.to]])),
            found.nodes.map((node) => [node.name, node.first, node.numRows]),
            found.cuts, found.paused, found.numWithout,
          ]);
        });
    """
    rows = [
        ["b/1", 7, 100, 110], ["b/1", 7, 100, 108], ["b/1", 8, 101, 109], ["b/1", 7, 108, 112], ["a/2", 1, 100, 104],
        ["a/2", 2, 104, 106], ["b/1", 7, 1000, 1004], ["a/2", 3, 1000, None], [None, None, None, None],
    ]  # fmt: skip
    placed, nodes, cuts, paused, without = page.browser.execute_async_script(lay_out, rows)
    assert nodes == [["a", 0, 1], ["b", 1, 3]]
    # A pack's members are neighbours, and the next one takes the place of who has ended.
    assert [placed[f"t{index}"][0] for index in range(8)] == [1, 2, 3, 2, 0, 0, 1, 0]
    assert (cuts, paused) == ([12], 888)
    assert placed["t6"] == [1, 12, 16]
    # What runs has lasted as long as it has trained.
    assert placed["t7"] == [0, 12, 17]
    assert without == 1


# -- for everybody


@pytest.mark.parametrize("view", [BOTH, TIMELINE, "#/?compare=cartpole-ppo,cartpole-seeds"])
def test_views_have_no_barriers_and_fit_each_width(page: Page, view: str) -> None:
    for width, theme in ((400, "light"), (1280, "dark"), (1920, "light")):
        page.open(view, width=width, theme=theme)
        page.says("main", {BOTH: "P(A > B)", TIMELINE: "Each bar is a trial"}.get(view, "2 sweeps chosen"))
        assert page.violations() == [], width
        assert page.run("return document.documentElement.scrollWidth <= innerWidth"), width
