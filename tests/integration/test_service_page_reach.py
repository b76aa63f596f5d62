"""Who reaches the service's page: with a keyboard, a screen reader, a phone, a token of their own."""

import pytest
from live_service import Live, serving_a_viewer
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_storage
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

pytestmark = IN_A_BROWSER
FAILED = "#/sweeps/cartpole-ppo?trial=t0003"


def test_all_is_reached_with_the_tab_key_and_the_focus_is_seen(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo")
    page.says(".trials-card", "60 trials")
    can_be_reached = """
        const wanted = "a[href], button, input, select, textarea, summary, [tabindex]";
        const isThere = (node) => node.checkVisibility({ visibilityProperty: true }) && !node.closest("[popover]");
        const isReached = (node) => isThere(node) && node.tabIndex >= 0 && !node.disabled;
        return [...document.querySelectorAll(wanted)].filter(isReached).length;
    """
    expected = page.run(can_be_reached)
    seen: list[str] = []
    page.run("document.body.tabIndex = -1; document.body.focus(); document.body.removeAttribute('tabindex')")
    for _ in range(expected + 1):
        page.keys(Keys.TAB)
        key, outline = page.run("""
            const node = document.activeElement;
            node.dataset.seen ??= String(Math.random());
            const style = getComputedStyle(node);
            const isShown = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) > 0;
            return [node === document.body ? "" : node.dataset.seen, isShown || node.outerHTML.slice(0, 150)];
        """)
        if not key:
            break
        seen.append(key)
        assert outline is True
    assert len(set(seen)) >= expected - 1
    # A list that is typed at first shows where the focus is, too.
    page.open("#/")
    page.says("main", "cartpole-ppo")
    page.keys(Keys.TAB)
    assert page.focused() == "Skip to content"
    page.keys(Keys.ENTER)
    assert page.run("return document.activeElement.id") == "main"
    assert page.address() in ("", "#/")


@pytest.mark.parametrize("view", ["#/", "#/sweeps/cartpole-ppo", FAILED, "#/sweeps/cartpole-seeds", "#/new"])
def test_views_have_no_barriers_and_fit_each_width(page: Page, view: str) -> None:
    for width, theme in ((400, "light"), (1280, "dark"), (1920, "light")):
        page.open(view, width=width, theme=theme)
        wait_for = {"#/": "cartpole-ppo", "#/new": "At once"}.get(view, "How the leading settings learn")
        page.says("main", wait_for)
        if view == FAILED:
            page.says(".panel", "Why it failed")
        assert page.violations() == [], width
        assert page.run("return document.documentElement.scrollWidth <= innerWidth"), width


@pytest.mark.parametrize("label", ["Delete…", "Extend…", "Note, tags, priority…"])
def test_dialogs_have_no_barriers(page: Page, label: str) -> None:
    page.open("#/sweeps/cartpole-ppo")
    page.button("More").click()
    assert page.violations() == []
    page.button(label).click()
    page.one("dialog")
    assert page.violations() == []


def test_a_name_that_is_not_there_is_said(page: Page) -> None:
    page.open("#/")
    page.run("location.hash = '#/sweeps/nothing%3Cb%3E'")
    page.says("main", "There is no sweep 'nothing<b>'.")


def test_who_has_no_token_logs_in_and_a_viewer_changes_nothing(
    browser: webdriver.Chrome, tmp_path_factory: pytest.TempPathFactory
) -> None:
    storage = tmp_path_factory.mktemp("closed") / "sweeps"
    write_storage(storage)
    with serving_a_viewer(storage, "vera") as (closed, secret):
        page = Page(browser, closed.url)
        page.errors()
        page.open("#/sweeps/cartpole-ppo")
        page.says("main h1", "Log in")
        assert page.violations() == []
        assert "Token" in page.focused()
        page.keys("wrong", Keys.ENTER)
        page.says("[role=alert]", "This token is wrong")
        page.keys(secret, Keys.ENTER)
        # What the link named is there.
        page.says("main h1", "cartpole-ppo")
        page.says(".where", "vera, viewer")
        assert not page.one(".sweep-title").find_elements(By.CSS_SELECTOR, ".actions:not([hidden])")
        page.open("#/new")
        page.says("main", "it may look, and submit nothing")
        assert not page.one("button[type=submit]").is_enabled()
        page.button("Log out").click()
        page.says("main h1", "Log in")
        assert page.errors() == []


def test_the_focus_stays_with_who_goes_by_keys_alone(page: Page) -> None:
    page.open("#/sweeps/cartpole-seeds")
    page.says(".sweep-title", "interrupted")
    # What a dialog was opened from is gone with the menu: the focus goes back to what opened that.
    page.run("arguments[0].focus()", page.button("More"))
    page.keys(Keys.ENTER, Keys.TAB, Keys.ENTER)
    assert page.focused() == "More samples"
    page.keys(Keys.ESCAPE)
    page.until(lambda: page.focused() == "More")
    # What was pressed is gone: the other one has its place.
    page.run("arguments[0].focus()", page.button("Resume"))
    page.keys(Keys.ENTER)
    page.says(".sweep-title", "waiting")
    page.until(lambda: page.focused() == "Stop")
    page.keys(Keys.ENTER)
    page.says(".sweep-title", "stopped")
    page.until(lambda: page.focused() == "Resume")


def test_who_goes_back_leaves_a_dialog_behind(page: Page) -> None:
    page.open("#/")
    page.button("cartpole-ppo").click()
    page.button("More").click()
    page.button("Delete…").click()
    page.one("dialog form")
    page.browser.back()
    page.says("main h1", "Sweeps")
    page.wait("return document.querySelector('dialog') === null")


def test_the_report_is_downloaded(page: Page, live: Live) -> None:
    report = live.storage / "cartpole-ppo" / "report"
    report.mkdir(exist_ok=True)
    (report / "index.html").write_text("<!DOCTYPE html><title>Report</title>")
    page.open("#/sweeps/cartpole-ppo")
    link = page.button("Download the report")
    address = link.get_attribute("href")
    assert link.get_attribute("download") == "cartpole-ppo-report.html"
    assert "<title>Report" in page.browser.execute_async_script(
        "fetch(arguments[0]).then((answer) => answer.text()).then(arguments[arguments.length - 1])", address
    )
