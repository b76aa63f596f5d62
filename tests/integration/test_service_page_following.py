"""How the service's page follows what changes: a result that is still written, a service that refuses or is away."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from selenium import webdriver
from synthetic_sweep import make_sweep

from tune_jobs.service import watching
from tune_jobs.store.sweep_store import SweepStore

pytestmark = IN_A_BROWSER
POINTS = [{"lr": lr} for lr in (1e-5, 3e-3, 2e-2)]
AWAY = """
    const [status] = arguments;
    window.fetch = async () => new Response(JSON.stringify({ detail: "The service is away." }), { status });
    location.hash = "#/sweeps/mine";
"""
HELD = """
    const ask = window.fetch;
    window.numLists = 0;
    const released = new Promise((resolve) => { window.release = resolve; });
    window.fetch = async (url, options) => {
      const answer = await ask(url, options);
      if (!new URL(url).pathname.endsWith("/api/v1/sweeps")) return answer;
      window.numLists += 1;
      if (window.numLists === 2) await released;
      return answer;
    };
    location.hash = "#/";
"""
NOTED = """
    const ask = window.fetch;
    window.moments = [];
    window.fetch = (url, options) => {
      if (String(url).includes("/curves")) window.moments.push(performance.now());
      return ask(url, options);
    };
    location.hash = "#/sweeps/mine";
"""

LATE = NOTED.replace(
    "return ask(url, options);",
    """
      if (!String(url).includes("/trials?")) return ask(url, options);
      window.isLate = true;
      return new Promise((resolve) => setTimeout(resolve, 3000)).then(() => ask(url, options));
    """,
)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service of a sweep that nobody has submitted: it was run from a terminal."""
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    write_sweep(storage, make_sweep(name="mine", points=POINTS, max_steps=20_000))
    with serving(storage) as found:
        yield found


def test_the_result_of_a_sweep_from_a_terminal_is_shown_once_it_is_written(page: Page, live: Live) -> None:
    made = make_sweep(name="concluding", points=POINTS, max_steps=20_000)
    assert made.best is not None
    # As it is when its trials have ended: the best is still confirmed and filmed.
    store = write_sweep(live.storage, make_sweep(name="concluding", points=POINTS, with_best=False, max_steps=20_000))
    with store.lock():
        page.open("#/sweeps/concluding")
        page.until(lambda: page.text(".sweep-title .state") == "running")
        page.says(".summary", "concluding")
        assert page.button("Stop").is_displayed()
        assert page.run("return document.querySelector('.finished').hidden")
        store.write_best(made.best)
        for name in ("policy.json", "policy.safetensors"):
            (store.best_folder / name).write_text("{}")
    page.until(lambda: page.text(".sweep-title .state") == "completed")
    page.says(".finished h2", "Result")
    page.says(".finished", "The policy to deploy")
    assert "earlier" not in page.text(".finished")


@pytest.mark.parametrize(("status", "told"), [(502, "Not connected"), (503, "Not connected"), (404, "")])
def test_who_is_answered_by_a_proxy_alone_is_not_connected(page: Page, status: int, told: str) -> None:
    page.open("#/new")
    page.run(AWAY, status)
    page.says("main", "The service is away.")
    assert page.text("#link-state").startswith(told)
    assert bool(page.text("#link-state")) is bool(told)


def test_a_page_whose_events_are_refused_asks_less_and_less_often(browser: webdriver.Chrome, tmp_path: Path) -> None:
    write_sweep(tmp_path / "sweeps", make_sweep(name="mine", points=POINTS, with_best=False, max_steps=5_000))
    with serving(tmp_path / "sweeps", watchers=0) as full:
        page = Page(browser, full.url)
        page.open("#/new")
        page.run(NOTED)
        page.says(".trials-card", "3 trials")
        page.says("#link-state", "Not connected")
        first, second, third = page.wait("return window.moments.length > 2 && window.moments.slice(0, 3)")
        # It waits a second, then two. A busy machine makes each longer, so that they are not compared with each other.
        assert second - first > 950
        assert third - second > 1_950


def test_a_sweep_that_takes_long_to_load_is_loaded_once(
    page: Page, live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "LINGER_S", 0.2)
    store = SweepStore(live.storage / "mine")
    record = store.read_record()
    page.open("#/new")
    page.run(LATE)
    page.wait("return window.isLate")
    try:
        # What comes while it loads is shown, too, and it goes on from there.
        store.write_record(record.model_copy(update={"state": "interrupted"}))
        page.says(".sweep-title", "interrupted")
        page.says(".trials-card", "3 trials")
        store.write_record(record)
        page.says(".sweep-title", "completed")
    finally:
        store.write_record(record)
    assert page.run("return window.moments.length") == 1


def test_a_list_that_is_older_than_an_event_takes_nothing_back(page: Page, live: Live) -> None:
    shown = "return [...document.querySelectorAll('.sweeps tbody tr')].map((row) => row.innerText).join(' ')"
    write_sweep(live.storage, make_sweep(name="leaves", points=POINTS, with_best=False, max_steps=5_000))
    store = SweepStore(live.storage / "mine")
    record = store.read_record()
    page.open("#/new")
    page.run(HELD)
    page.until(lambda: "leaves" in page.run(shown))
    page.wait("return window.numLists === 2")
    try:
        store.write_record(record.model_copy(update={"state": "interrupted"}))
        SweepStore(live.storage / "leaves").discard()
        page.until(lambda: "interrupted" in page.run(shown) and "leaves" not in page.run(shown))
        page.browser.execute_async_script("window.release(); setTimeout(arguments[0], 500)")
        assert "interrupted" in page.run(shown)
        assert "leaves" not in page.run(shown)
    finally:
        store.write_record(record)
