"""The command line against sweeps that are made up, as in tests/unit; and a browser that looks at a service's page."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from fake_sweeps import run, sweeps
from sweep_folders import sweep_template

if TYPE_CHECKING:
    from live_service import Live
    from page_browser import Page
    from selenium import webdriver

__all__ = ["browser", "live", "page", "run", "sweep_template", "sweeps"]


# Selenium may be missing: then the files that need it are skipped, and the others are not.
@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service whose storage holds sweeps of several states."""
    from live_service import serving
    from page_sweeps import write_storage

    storage = tmp_path_factory.mktemp("page") / "sweeps"
    write_storage(storage)
    with serving(storage) as found:
        yield found


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    """One Chromium for all tests here."""
    from page_browser import chromium

    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def page(browser: webdriver.Chrome, live: Live) -> Iterator[Page]:
    """The page; afterwards no script has failed, nothing was blocked, and no text was run as HTML."""
    from page_browser import Page

    found = Page(browser, live.url)
    found.errors()
    yield found
    assert found.errors() == []
    assert "run" not in browser.title.split()
    browser.execute_script("sessionStorage.clear()")
