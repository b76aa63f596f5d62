"""Watching policies play on the service's page: drawn, as lines, two side by side, held still, refused."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from live_service import Live, serving, serving_a_viewer
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from policy_factory import balancing_policy, make_portable
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select
from synthetic_sweep import Synthetic, make_sweep

from analysis.records import CheckpointRecord
from policies.portable.file import PortablePolicy, save_policy
from tests.narrowing import present
from tune_jobs.service.http import play_routes

pytestmark = IN_A_BROWSER
LONG, SHORT = "t0000", "t0001"
"""The trial whose policy keeps the pole up, and the one whose policy does not."""


def checkpoints(trial_id: str, made: Synthetic) -> tuple[CheckpointRecord, ...]:
    """Those of iterations 5 and 10, which score what the trial's results say."""
    fields = ("iteration", "num_env_steps", "training_return", "evaluation_return")
    rows = [row for row in made.results[trial_id] if row.iteration in (5, 10)]
    return tuple(CheckpointRecord(trial_id=trial_id, **{name: getattr(row, name) for name in fields}) for row in rows)


def saving(policy: PortablePolicy) -> Callable[[Path], None]:
    def save(folder: Path) -> None:
        save_policy(policy, folder)

    return save


def write_playable(storage: Path, name: str, env_id: str, policies: list[PortablePolicy], *, has_best: bool) -> None:
    """Write a made-up sweep whose checkpoints hold these policies, one a trial; the first one's is the best."""
    points: list[dict[str, Any]] = [{"lr": 10.0 ** -(index + 2)} for index in range(len(policies))]
    made = make_sweep(name=name, points=points, env_id=env_id, max_steps=10_240, with_best=has_best)
    made.trials = [trial.model_copy(update={"checkpoints": checkpoints(trial.trial_id, made)}) for trial in made.trials]
    store = write_sweep(storage, made, spec={"space": {"lr": {"loguniform": [1e-6, 1e-1]}}})
    for trial, policy in zip(made.trials, policies, strict=True):
        for record in trial.checkpoints:
            store.trial(trial.trial_id).write_checkpoint(record, saving(policy))
    if has_best:
        store.write_best(present(made.best), policies[0])


def write_playables(storage: Path) -> None:
    """Write a sweep that is drawn, with a best policy, and one that can't be drawn, without one."""
    balancing = [balancing_policy("CartPole-v1", skill).portable for skill in ("good", "poor")]
    write_playable(storage, "drawn", "CartPole-v1", balancing, has_best=True)
    write_playable(storage, "not-drawn", "TestTicks-v0", [make_portable("TestTicks-v0")], has_best=False)
    write_playable(storage, "torque", "Pendulum-v1", [make_portable("Pendulum-v1")], has_best=False)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory, env_plugin: None) -> Iterator[Live]:
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    write_playables(storage)
    with serving(storage) as found:
        yield found


@pytest.fixture
def page(page: Page) -> Iterator[Page]:
    """The page; afterwards nobody plays any more."""
    yield page
    page.open("#/")
    page.until(lambda: not play_routes._playing, "nobody plays")


def player(number: int = 1) -> str:
    """The selector of a player."""
    return f".player:nth-of-type({number})"


def fact(page: Page, name: str, number: int = 1) -> str:
    script = """
        const rows = [...document.querySelectorAll(arguments[0] + " .facts div")];
        return rows.find((row) => row.firstElementChild.innerText === arguments[1])?.lastElementChild.innerText ?? "";
    """
    return str(page.run(script, player(number), name))


def num_steps(page: Page, number: int = 1) -> int:
    return int(fact(page, "Env steps", number).replace(",", "").strip("\u2013") or "0")


def ending(page: Page, number: int = 1) -> str:
    """Wait for the end of an episode, and return what is said of it."""
    return str(page.wait("return document.querySelector(arguments[0])?.innerText", f"{player(number)} .ending"))


def test_the_best_policy_is_watched_from_the_sweep(page: Page) -> None:
    page.open("#/sweeps/drawn")
    page.button("Watch it play", ".sweep-title").click()
    page.says("main h1", "Watch it play")
    page.says(".player h2", "Best policy")
    assert page.address() == "#/sweeps/drawn/play"
    page.until(lambda: num_steps(page) > 20)
    # The frame is drawn: the cart is in it.
    script = """
        const canvas = document.querySelector(".player canvas[role=img]");
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        return [canvas.width, canvas.height, new Set(new Uint32Array(data.buffer)).size];
    """
    width, height, colours = page.run(script)
    assert (width, height) == (600, 400)
    assert colours > 5
    assert fact(page, "Action") in ("push left (0)", "push right (1)")
    bars = page.text(".player .scores").splitlines()
    assert {"push left", "push right"} <= set(bars)
    assert len([text for text in bars if text.endswith("%")]) == 2
    assert page.run("return document.querySelectorAll('.scores [aria-current]').length") == 1
    assert float(fact(page, "Return so far")) > 20
    assert "CartPole-v1, played by Best policy with seed 0" in str(
        page.one(".player canvas[role=img]").get_attribute("aria-label")
    )


def test_checkpoints_and_the_result_lead_there(page: Page) -> None:
    page.open(f"#/sweeps/drawn?trial={SHORT}")
    page.says(".panel .checkpoints", "Watch iteration 10 play")
    page.button("Watch iteration 5 play", ".panel").click()
    page.says(".player h2", f"{SHORT}, iteration 5")
    assert page.address() == f"#/sweeps/drawn/play?trial={SHORT}&iteration=5"
    page.browser.back()
    page.says(".finished", "The policy to deploy")
    archive = page.button("Download it", ".finished").get_attribute("href")
    assert httpx2.get(str(archive)).headers["content-disposition"] == 'attachment; filename="drawn-policy.zip"'
    page.button("Watch it play", ".finished").click()
    page.says(".player h2", "Best policy")


def test_a_link_reproduces_the_episode(page: Page) -> None:
    page.open(f"#/sweeps/drawn/play?trial={SHORT}&iteration=5&seed=3&speed=10")
    told = ending(page)
    assert told.startswith("Return ")
    assert told.endswith("the episode ended in this state (terminated).")
    page.browser.refresh()
    assert ending(page) == told
    page.says(".player h2", f"{SHORT}, iteration 5")
    assert page.one("#seed").get_attribute("value") == "3"
    assert page.one("#speed").get_attribute("value") == "10"
    # Another seed is another episode, and has another address.
    page.button("Next seed").click()
    assert page.address() == f"#/sweeps/drawn/play?trial={SHORT}&iteration=5&seed=4&speed=10"
    page.until(lambda: ending(page) not in ("", told))
    seed = page.one("#seed")
    seed.send_keys(Keys.CONTROL, "a")
    seed.send_keys("3", Keys.TAB)
    page.until(lambda: ending(page) == told)


def test_two_are_watched_side_by_side_with_the_same_seed(page: Page) -> None:
    page.open(f"#/sweeps/drawn/play?trial={SHORT}&seed=2&speed=10")
    alone = ending(page)
    Select(page.one("#other")).select_by_value("best")
    page.says(f"{player(2)} h2", "Best policy")
    assert "with=best" in page.address()
    assert ending(page) == alone
    assert ending(page, 2) == "Return 500.0 after 500 env steps: the environment's limit cut it off (truncated)."
    place = "const box = document.querySelector(arguments[0]).getBoundingClientRect(); return [box.left, box.top]"
    (left, top), (other_left, other_top) = (page.run(place, player(number)) for number in (1, 2))
    assert (left < other_left, top) == (True, other_top)
    page.emulate(width=400)
    (left, top), (other_left, other_top) = (page.run(place, player(number)) for number in (1, 2))
    assert (left, top < other_top) == (other_left, True)
    # A random one, of any trial's checkpoint, and none.
    Select(page.one("#other")).select_by_value("random")
    page.says(f"{player(2)} h2", "Random policy")
    assert ending(page, 2) != alone
    Select(page.one("#other")).select_by_value(LONG)
    page.says(f"{player(2)} h2", f"{LONG}, iteration")
    Select(page.one("#other-checkpoint")).select_by_value("5")
    page.says(f"{player(2)} h2", f"{LONG}, iteration 5")
    assert page.address().endswith(f"with={LONG}:5")
    Select(page.one("#other")).select_by_value("")
    page.wait("return document.querySelectorAll('.player').length === 1")
    assert "with" not in page.address()


def test_what_cannot_be_drawn_is_shown_as_lines(page: Page) -> None:
    page.open("#/sweeps/not-drawn/play?speed=0.5")
    # Without a best policy it is the leading trial's latest.
    page.says(".player h2", "t0000, iteration 10")
    page.says(".player .stage", "TestTicks-v0 can't be drawn")
    page.says(".player .observations", "observation 2")
    told = ending(page)
    assert (
        told
        == f"Return {fact(page, 'Return so far')} after 7 env steps: the environment's limit cut it off (truncated)."
    )
    # The last step was taken on the sixth observation, which counts them; actions begin at 5.
    assert page.text(".observations li .value") == "6"
    assert fact(page, "Action") in ("5", "6", "7")
    assert "action 5" in page.text(".player .scores")
    assert not page.one(player()).find_elements(By.CSS_SELECTOR, "canvas[role=img]:not([hidden])")


def test_actions_that_are_vectors_have_bars_within_their_bounds(page: Page) -> None:
    page.open("#/sweeps/torque/play?speed=2")
    page.until(lambda: num_steps(page) > 3)
    page.button("Pause").click()
    page.says(".player .state", "paused")
    page.says(".player .scores", "component 0")
    action = float(fact(page, "Action"))
    told = present(re.fullmatch(r"(-?[\d.e-]+), . ([\d.]+)", page.text(".player .scores .value")))
    assert float(told[1]) == pytest.approx(action, rel=0.01)
    assert float(told[2]) > 0
    # Torques are of -2 to 2, and zero is in the middle.
    left, width = page.run("const { left, width } = document.querySelector('.scores i').style; return [left, width]")
    assert float(width.rstrip("%")) == pytest.approx(25 * abs(action), abs=0.3)
    assert float(left.rstrip("%")) == pytest.approx(50 + 25 * min(0, action), abs=0.3)


def test_it_is_held_still_and_goes_on(page: Page) -> None:
    page.open("#/sweeps/drawn/play?seed=1&speed=0.5")
    page.until(lambda: num_steps(page) > 5)
    page.button("Pause").click()
    page.says(".player .state", "paused")
    held = num_steps(page)
    # More than a step takes.
    page.run("return new Promise((resolve) => setTimeout(resolve, 300))")
    assert num_steps(page) == held
    page.button("Play").click()
    page.until(lambda: num_steps(page) > held)
    # Another speed takes up where it was.
    before = num_steps(page)
    Select(page.one("#speed")).select_by_value("10")
    page.until(lambda: num_steps(page) > before)
    assert ending(page).startswith("Return 500.0 after 500 env steps")
    # The line has each step once.
    page.button("Play again").click()
    page.until(lambda: 0 < num_steps(page) < 400)


PLAYED = "return performance.getEntriesByType('resource').filter(({ name }) => name.includes('/play?'))"
"""The episodes that the page has asked for."""


def test_a_place_that_becomes_free_is_taken(page: Page, live: Live) -> None:
    limits = live.service.config.limits
    object.__setattr__(limits, "players", 0)
    try:
        page.open("#/sweeps/drawn/play?speed=10")
        page.wait(f"{PLAYED}.length > 0")
    finally:
        object.__setattr__(limits, "players", 4)
    assert "500 env steps" in ending(page)
    assert page.text(".player [role=alert]") == ""


def test_who_clicks_through_seeds_sees_the_last(page: Page, live: Live) -> None:
    limits = live.service.config.limits
    # No more than these two have room: those that were left have to make way first.
    object.__setattr__(limits, "players", 2)
    try:
        page.open("#/sweeps/drawn/play?with=random&speed=2")
        page.until(lambda: num_steps(page) > 5)
        next_seed = page.button("Next seed")
        page.run("for (let number = 0; number < 3; number += 1) arguments[0].click()", next_seed)
        assert "seed=3" in page.address()
        page.until(lambda: num_steps(page, 2) > 5)
        assert page.text(".player [role=alert]") == ""
        # The first two, and the last two.
        assert len(page.run(PLAYED)) <= 4
    finally:
        object.__setattr__(limits, "players", 4)


HIDE = """
    Object.defineProperty(document, "hidden", { value: arguments[0], configurable: true });
    document.dispatchEvent(new Event("visibilitychange"));
"""


def test_nothing_plays_where_nobody_looks(page: Page) -> None:
    page.open("#/sweeps/drawn/play?with=random")
    page.until(lambda: num_steps(page) > 5)
    assert play_routes._playing
    page.run(HIDE, True)
    page.until(lambda: not play_routes._playing)
    held = num_steps(page)
    page.run(HIDE, False)
    page.until(lambda: num_steps(page) > held)
    page.run("location.hash = '#/sweeps/drawn'")
    page.says("main h1", "drawn")
    page.until(lambda: not play_routes._playing)


def test_who_holds_still_for_long_gives_their_place_up(page: Page) -> None:
    page.open("#/")
    page.browser.execute_async_script("""
        const done = arguments[arguments.length - 1];
        import(new URL("static/js/play_view.js", document.baseURI).href).then(({ held }) => {
          window.held = held;
          done();
        });
    """)
    assert page.run("return window.held.ms") == 30_000
    page.run("window.held.ms = 600")
    page.run("location.hash = '#/sweeps/drawn/play?speed=0.5'")
    page.until(lambda: num_steps(page) > 5)
    page.button("Pause").click()
    # For a moment it stays where it is, at the service too.
    assert play_routes._playing
    page.until(lambda: not play_routes._playing)
    page.says(".player .state", "paused")
    stopped = num_steps(page)
    page.run("window.held.ms = 30_000")
    page.button("Play").click()
    page.until(lambda: num_steps(page) > stopped)
    # Who goes on in time keeps their place.
    page.button("Pause").click()
    page.button("Play").click()
    page.says(".player .state", "playing")
    assert play_routes._playing
    page.run("window.held.ms = 100")
    page.button("Pause").click()
    # There were two, and the second went on from the step that was seen.
    page.wait(f"{PLAYED}.length === 2")
    assert page.run(f"{PLAYED}.at(-1).name").endswith(f"&start={stopped + 1}")


def test_it_is_said_why_a_policy_is_not_played(page: Page, live: Live) -> None:
    page.open("#/sweeps/drawn/play?trial=t0001&iteration=77")
    page.says(
        ".player [role=alert]", "Trial t0001 of sweep drawn has no such checkpoint: it has those of iterations 5, 10"
    )
    assert "iteration 77, not there" in page.text("#policy-checkpoint")
    page.open("#/sweeps/drawn/play?trial=t0099")
    page.says(".player [role=alert]", "t0099")
    page.open("#/sweeps/nothing/play")
    page.says("main [role=alert]", "There is no sweep 'nothing'.")
    # Of two, one has no room; it is played once there is.
    limits = live.service.config.limits
    object.__setattr__(limits, "players", 0)
    try:
        page.open("#/sweeps/drawn/play?speed=10")
        page.says(".player [role=alert]", "0 episodes are being played.")
        page.says(".player .state", "failed")
    finally:
        object.__setattr__(limits, "players", 4)
    page.button("Play").click()
    assert "500 env steps" in ending(page)
    assert page.text(".player [role=alert]") == ""


def test_who_wants_less_motion_starts_it(page: Page) -> None:
    features = [{"name": "prefers-reduced-motion", "value": "reduce"}]
    page.open("#/")
    page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    page.run("location.hash = '#/sweeps/drawn/play?speed=10'")
    page.says(".player .state", "not begun")
    page.run("return new Promise((resolve) => setTimeout(resolve, 300))")
    assert not play_routes._playing
    # By keys alone.
    page.run("document.querySelector('#speed').focus()")
    page.keys(Keys.TAB)
    assert page.focused() == "Play"
    page.keys(Keys.ENTER)
    assert "500 env steps" in ending(page)


@pytest.mark.parametrize("view", ["drawn/play?with=random&speed=10", "not-drawn/play?speed=10"])
def test_it_has_no_barriers_and_fits_each_width(page: Page, view: str) -> None:
    for width, theme in ((400, "light"), (400, "dark"), (1280, "light"), (1280, "dark")):
        page.open(f"#/sweeps/{view}", width=width, theme=theme)
        page.until(lambda: num_steps(page) > 3)
        assert page.violations() == [], width
        ending(page)
        assert page.violations() == [], width
        assert page.run("return document.documentElement.scrollWidth <= innerWidth"), width


def test_a_viewer_may_watch(browser: webdriver.Chrome, tmp_path: Path, env_plugin: None) -> None:
    storage = tmp_path / "sweeps"
    write_playables(storage)
    with serving_a_viewer(storage, "vera") as (closed, secret):
        page = Page(browser, closed.url)
        page.errors()
        page.open("#/sweeps/drawn/play?speed=10")
        page.says("main h1", "Log in")
        page.keys(secret, Keys.ENTER)
        assert "500 env steps" in ending(page)
        assert page.errors() == []
        browser.get("about:blank")
