"""A sweep's report in a browser, opened from the service: the same at each visit."""

from pathlib import Path

import pytest
from live_service import serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import write_sweep
from selenium import webdriver
from synthetic_sweep import make_sweep

pytestmark = IN_A_BROWSER
REPORT = """<!DOCTYPE html><html lang="en"><title>Report</title><style>h1 { color: rgb(1, 2, 3) }</style>
<h1>mine</h1><script>document.querySelector("h1").textContent = "drawn"</script></html>
"""
FIGURE = """<svg xmlns="http://www.w3.org/2000/svg"><style>circle { fill: rgb(1, 2, 3) }</style><circle r="9"/></svg>"""
SEEN = """
    const node = document.querySelector("h1, circle");
    const style = getComputedStyle(node);
    return [node.textContent, node.localName === "h1" ? style.color : style.fill, self.origin];
"""


@pytest.mark.parametrize(("path", "text"), [("", "drawn"), ("figure.svg", "")])
def test_a_report_is_the_same_at_the_second_visit(
    browser: webdriver.Chrome, tmp_path: Path, path: str, text: str
) -> None:
    store = write_sweep(tmp_path / "sweeps", make_sweep(name="mine", points=[{}], with_best=False))
    with store.writing_report() as folder:
        folder.mkdir()
        (folder / "index.html").write_text(REPORT)
        (folder / "figure.svg").write_text(FIGURE)
    with serving(tmp_path / "sweeps") as live:
        page = Page(browser, live.url)
        page.errors()
        for _ in range(3):
            browser.get("about:blank")
            browser.get(f"{live.url}/api/v1/sweeps/mine/report/{path}")
            # An origin of its own: it is in a sandbox.
            assert page.run(SEEN) == [text, "rgb(1, 2, 3)", "null"]
        assert page.errors() == []
