"""Chromium for the tests of the service's page: opens views, waits, and reads what they show."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

selenium = pytest.importorskip("selenium", reason="selenium is not installed (make install)")

from selenium import webdriver  # noqa: E402
from selenium.webdriver import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.remote.webelement import WebElement  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

from tests.narrowing import present  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
IN_A_BROWSER = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
    pytest.mark.skipif(DRIVER is None, reason="no chromedriver on this machine"),
]
"""The marks of tests that open a page."""
AXE = Path(__file__).parents[1] / "vendor" / "axe-core" / "axe.min.js"
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run",
    "--disable-background-networking", "--disable-sync", "--autoplay-policy=no-user-gesture-required",
)  # fmt: skip
SECONDS = 60
_ValueT = TypeVar("_ValueT")


class Page:
    """The page of a service in a browser.

    Args:
        browser: The browser.
        url: The service's.
    """

    def __init__(self, browser: webdriver.Chrome, url: str) -> None:
        self.browser, self.url = browser, url

    def open(self, view: str = "#/", *, width: int = 1280, height: int = 900, theme: str = "light") -> None:
        """Open a view anew."""
        self.emulate(width=width, height=height, theme=theme)
        # Another fragment alone would load nothing.
        self.browser.get("about:blank")
        self.browser.get(f"{self.url}/{view}")
        self.wait("return document.querySelector('main h1') !== null")

    def emulate(self, *, width: int, height: int = 900, theme: str = "light") -> None:
        features = [{"name": "prefers-color-scheme", "value": theme}]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def run(self, script: str, *arguments: Any) -> Any:
        return self.browser.execute_script(script, *arguments)

    def wait(self, script: str, *arguments: Any) -> Any:
        """Wait until a script returns something true, and return it."""
        return self.until(lambda: self.run(script, *arguments), script)

    def until(self, found: Callable[[], _ValueT], what: str = "") -> _ValueT:
        """Wait until something is true, and return it."""
        value: _ValueT = WebDriverWait(self.browser, SECONDS, poll_frequency=0.05).until(lambda _: found(), what)
        return value

    def one(self, selector: str) -> WebElement:
        """Wait for an element that is seen."""

        def seen() -> WebElement | None:
            found = self.browser.find_elements(By.CSS_SELECTOR, selector)
            return next((item for item in found if item.is_displayed()), None)

        return present(self.until(seen, selector))

    def button(self, text: str, within: str = "body") -> WebElement:
        """Wait for a button or link with this text that is seen."""

        def seen() -> WebElement | None:
            found = self.browser.find_elements(By.CSS_SELECTOR, f"{within} :is(button, a)")
            return next((item for item in found if item.is_displayed() and item.text.strip() == text), None)

        return present(self.until(seen, text))

    def text(self, selector: str) -> str:
        return str(self.run("return document.querySelector(arguments[0])?.innerText ?? ''", selector))

    def says(self, selector: str, text: str) -> None:
        """Wait until an element that is seen has a text in it."""
        script = """
            return [...document.querySelectorAll(arguments[0])].some((node) =>
              node.checkVisibility() && node.innerText.includes(arguments[1]))
        """
        self.until(lambda: self.run(script, selector, text), f"{selector}: {text}")

    def keys(self, *keys: str) -> None:
        """Press keys one after the other."""
        for key in keys:
            ActionChains(self.browser).send_keys(key).perform()

    def drag(self, node: WebElement, begin: tuple[float, float], *moves: tuple[float, float]) -> None:
        """Press in a node, pixels from its left upper corner, move by each of the moves, and release."""
        left, top = begin[0] - node.size["width"] / 2, begin[1] - node.size["height"] / 2
        chain = ActionChains(self.browser).move_to_element_with_offset(node, round(left), round(top)).click_and_hold()
        for across, down in moves:
            chain.move_by_offset(round(across), round(down))
        chain.release().perform()

    def address(self) -> str:
        return str(self.run("return decodeURIComponent(location.hash)"))

    def focused(self) -> str:
        """What has the focus: its label or its text."""
        return str(
            self.run("""
                const node = document.activeElement;
                return node.getAttribute("aria-label") || node.labels?.[0]?.innerText || node.innerText || node.tagName;
            """)
        )

    def violations(self) -> list[Any]:
        """What axe finds wrong for people who use a keyboard or a screen reader, or see little."""
        self.run(AXE.read_text(encoding="utf-8"))
        found: list[Any] = self.browser.execute_async_script("""
            const done = arguments[arguments.length - 1];
            axe.run(document, { resultTypes: ["violations"] }).then(({ violations }) => done(violations.map((item) =>
              [item.id, item.help, item.nodes.slice(0, 3).map((node) => node.target.join(" "))])));
        """)
        return found

    def errors(self) -> list[str]:
        """What scripts and the policy complained about; what the service refuses, the browser lists too."""
        return [str(entry["message"]) for entry in self.browser.get_log("browser") if entry["source"] != "network"]


@contextmanager
def chromium(profile: Path) -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.binary_location = present(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(present(DRIVER)))
    driver.set_page_load_timeout(SECONDS)
    driver.set_script_timeout(SECONDS)
    try:
        yield driver
    finally:
        driver.quit()
