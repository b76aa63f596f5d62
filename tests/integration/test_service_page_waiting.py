"""A sweep that waits for nodes of a cluster, on the page: for what, how long already, and how much longer."""

import time
from collections.abc import Iterator

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from synthetic_sweep import make_sweep

from analysis.waits import WaitRecord
from tune_jobs.store.sweep_store import SweepStore

pytestmark = IN_A_BROWSER
LACKING = "One trial needs 3 CPUs; the cluster at auto has 1. Missing: 2 CPUs."


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service beside which a job of a cluster is about to run a sweep."""
    storage = tmp_path_factory.mktemp("page") / "sweeps"
    now = time.time()
    wait = WaitRecord(since=now - 240, until=now + 3_570, resources={"CPU": 3.0, "GPU": 0.5}, lacking=LACKING)
    made = make_sweep(name="mine", points=[{"lr": 1e-3}], with_best=False, pending={0})
    store = write_sweep(storage, made, state="created", started_at=None, ended_at=None, waiting=wait)
    with store.lock(), serving(storage) as found:
        yield found


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280])
def test_it_says_for_what_it_waits_and_how_much_longer(page: Page, width: int, theme: str) -> None:
    page.open("#/sweeps/mine", width=width, theme=theme)
    told = "It waits for nodes with room for one trial (3 CPUs and 0.5 GPUs): for 4 min, and at most 59 min more."
    page.says(".notice", f"{told} {LACKING}")
    assert page.text(".sweep-title .state") == "waiting"
    assert "waits for nodes" in page.text(".summary")
    # It is a process that can be stopped.
    assert page.button("Stop").is_displayed()
    assert page.violations() == []
    assert page.run("return document.documentElement.scrollWidth") <= width


def test_the_list_has_it_among_those_that_wait_until_nothing_waits(page: Page, live: Live) -> None:
    page.open("#/")
    page.says("main", "for nodes")
    assert page.text(".state") == "waiting"
    store = SweepStore(live.storage / "mine")
    record = store.read_record()
    page.open("#/sweeps/mine")
    page.says(".notice", "It waits for nodes")
    try:
        store.write_record(record.model_copy(update={"waiting": None, "state": "running"}))
        page.until(lambda: page.text(".sweep-title .state") == "running")
    finally:
        store.write_record(record)
