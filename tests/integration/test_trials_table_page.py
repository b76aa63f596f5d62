"""The table of trials in a browser: sorted, filtered, kept to what a chart chose, and all of it."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from report_sources import source_of
from synthetic_sweep import make_sweep

from analysis.page import all_trials
from analysis.page_templates import template_file
from analysis.report import _environment
from tests.narrowing import present

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# What is pressed one after the other, and what the table shows then.
STEPS = """
const seen = {}, rows = () => [...document.querySelectorAll("table.sortable tbody tr")];
const ids = () => rows().map((row) => row.cells[1].textContent);
const buttons = () => [...document.querySelectorAll("button")];
const press = (text) => buttons().find((one) => one.textContent.startsWith(text)).click();
const type = (text) => {
  const field = document.querySelector("#trial-controls input");
  field.value = text;
  field.dispatchEvent(new Event("input"));
};
const said = () => document.querySelector("#trial-controls span").textContent;
seen.first = [ids().length, said(), document.getElementById("shown") === null];
press("Show all 60");
seen.all = [new Set(ids()).size, said()];
press("lr");
seen.rising = ids();
press("lr");
seen.falling = ids();
type("tanh lr<0.003");
seen.filtered = ids();
seen.filtered_said = said();
type("activation=relu");
seen.relu = ids().length;
type("");
document.dispatchEvent(new CustomEvent("trials-chosen", { detail: new Set(["t0007", "t0055"]) }));
seen.chosen = ids();
document.dispatchEvent(new CustomEvent("trials-chosen", { detail: null }));
type("failed");
seen.failed = [ids(), rows()[0].querySelector("a").getAttribute("href")];
document.title = JSON.stringify(seen);
"""


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_table_is_sorted_filtered_and_shown_whole(tmp_path: Path) -> None:
    points = [{"activation": ("relu", "tanh")[index % 2], "lr": 1e-4 * (index + 1)} for index in range(60)]
    synthetic = make_sweep(points=points, max_steps=6_000, failed={9})
    source = source_of(synthetic)
    environment = _environment()
    section = environment.get_template("sections/trials.html.j2").render(
        source=source, trials=all_trials.section(source)
    )
    script = template_file("report.js")
    page = tmp_path / "table.html"
    page.write_text(f"<title></title>{section}<script>{script}</script><script>{STEPS}</script>", encoding="utf-8")
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-sync"
    done = subprocess.run(
        [present(CHROMIUM), *flags.split(), f"--user-data-dir={tmp_path}/profile", "--dump-dom", page.as_uri()],
        capture_output=True, text=True, check=True, timeout=600,
    )  # fmt: skip
    seen = json.loads(html.unescape(present(re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)).group(1)))
    by_lr = [f"t{index:04d}" for index in range(60)]
    assert seen["first"] == [50, "50 of 60 trials", True]
    assert seen["all"] == [60, "60 of 60 trials"]
    assert seen["rising"] == by_lr
    assert seen["falling"] == by_lr[::-1]
    assert seen["filtered"] == [f"t{index:04d}" for index in range(27, 0, -2)]
    assert seen["filtered_said"] == "14 of 60 trials (14 match)"
    assert seen["relu"] == 30
    assert seen["chosen"] == ["t0055", "t0007"]
    assert seen["failed"] == [["t0009"], "#error-t0009"]
