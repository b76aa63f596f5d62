"""The page of a service whose object store is away: what it says, and that it goes on by itself."""

from pathlib import Path

import pytest
from live_service import serving
from page_browser import IN_A_BROWSER, Page
from s3_faults import Faults, faults, url  # noqa: F401 (fixtures)
from selenium import webdriver
from store_parts import make_sweep

from tune_jobs.store.objects.object_sweep import ObjectSweep
from tune_jobs.store.objects.url import ObjectUrl

# ruff: noqa: F811 - fixtures are named as arguments
pytestmark = IN_A_BROWSER
AGAIN = "The page goes on by itself once it is there."


@pytest.mark.parametrize(
    ("view", "done", "shown"),
    [("#/", "cannot be listed", "table.sweeps"), ("#/sweeps/mine", "cannot be read", ".sweep-title")],
)
def test_it_says_that_the_store_is_away_until_it_is_back(  # noqa: PLR0917 (fixtures)
    browser: webdriver.Chrome, faults: Faults, url: ObjectUrl, tmp_path: Path, view: str, done: str, shown: str
) -> None:
    ObjectSweep(url).write_record(make_sweep(state="created"))
    with serving(str(url.parent), own_folder=tmp_path / "own") as live:
        page = Page(browser, live.url)
        page.open("#/new")
        faults.away()
        page.run("location.hash = arguments[0]", view)
        page.says(".notice.bad", f"{done}: the connection was refused.")
        page.says(".notice.bad", AGAIN)
        assert page.violations() == []
        faults.back()
        page.says(shown, "mine")
        assert AGAIN not in page.text("main")
