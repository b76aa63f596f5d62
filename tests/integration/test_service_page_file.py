"""A sweep's file on the page: dropped or chosen, looked at without the service, and refused where it is not one."""

import base64
import copy
import gzip
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from live_service import Live, serving
from page_browser import IN_A_BROWSER, Page
from page_sweeps import HOSTILE
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from tune_jobs.service.access.gate import opened_gate
from tune_jobs.service.config import ServiceConfig
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.sweep_file import MAX_BYTES, sweep_file

pytestmark = IN_A_BROWSER
DROP = """
    const transfer = new DataTransfer();
    for (const [name, text] of arguments[0]) {
      transfer.items.add(new File([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))], name));
    }
    for (const kind of ["dragenter", "dragover", "drop"]) {
      const event = new DragEvent(kind, { dataTransfer: transfer, bubbles: true, cancelable: true });
      document.querySelector("main").dispatchEvent(event);
    }
"""
WATCH = """
    window.asked = [];
    const note = (what) => (...given) => { window.asked.push([what, ...given].join(" ")); throw new Error("no"); };
    window.fetch = note("fetch");
    window.EventSource = class { constructor(url) { note("events")(url); } };
    window.WebSocket = class { constructor(url) { note("socket")(url); } };
    XMLHttpRequest.prototype.open = note("request");
    navigator.sendBeacon = note("beacon");
    new PerformanceObserver((list) => window.asked.push(...list.getEntries().map((entry) => entry.name)))
      .observe({ type: "resource", buffered: false });
"""


@pytest.fixture(scope="module")
def packed(live: Live) -> bytes:
    return sweep_file(SweepStore(live.storage / "cartpole-ppo"))


def drop(page: Page, *files: tuple[str, bytes]) -> None:
    page.run(DROP, [[name, base64.b64encode(content).decode()] for name, content in files])


def changed(packed: bytes, change: Callable[[Any], Any]) -> bytes:
    """The file with other content."""
    content = copy.deepcopy(json.loads(gzip.decompress(packed)))
    change(content)
    return gzip.compress(json.dumps(content).encode())


def test_a_dropped_file_shows_its_sweep_and_nothing_is_sent(page: Page, packed: bytes) -> None:
    # A list of sweeps asks for what is new in it, until it is left.
    page.open("#/file")
    page.until(lambda: "CPU" in page.text("#where"))
    page.run(WATCH)
    drop(page, ("sent.tunejobs", packed))
    page.says("main h1", "cartpole-ppo")
    page.says(".trials-card", "60 trials")
    assert page.address().startswith("#/file")
    assert "sent.tunejobs" in page.text(".from-file")
    page.says(".importance .shares", "%")
    page.says(".finished", "The policy to deploy")
    page.says(".curves .keys", "lr ")
    # What can be done with it is to look.
    assert page.run("return document.querySelector('.actions') === null")
    assert "Save as a file" not in page.text("main")
    page.one(".trials-card input[type=search]").send_keys("status=failed")
    page.says(".trials-card", "2 of 60 trials")
    page.one(".trials tbody th").click()
    page.says(".panel .why", HOSTILE)
    page.says(".panel", "hidden_sizes")
    assert page.run("return document.querySelector('.panel [role=log]').checkVisibility()") is False
    page.keys(Keys.ESCAPE)
    page.until(lambda: "trial=" not in page.address())
    page.one(".timeline summary").click()
    page.says(".timeline .keys", "58 completed")
    assert "timeline=open" in page.address()
    assert "Watch it play" not in page.text("main")
    # The browser by itself looks for the page's icon, sooner or later.
    asked: list[str] = page.run("return window.asked")
    assert [item for item in asked if not item.endswith("/favicon.svg")] == []


def test_it_is_shown_as_the_service_shows_it(page: Page, packed: bytes) -> None:
    parts = (".summary", ".importance", ".curves .keys", ".trials tbody:has(th)")
    page.open("#/sweeps/cartpole-ppo")
    page.says(".importance .shares", "%")
    page.says(".curves .keys", "lr ")
    served = [page.text(part) for part in parts]
    drop(page, ("a.tunejobs", packed))
    page.says("main", "a.tunejobs")
    page.says(".importance .shares", "%")
    page.says(".curves .keys", "lr ")
    assert [page.text(part) for part in parts] == served


def test_the_score_of_its_setting_is_shown(page: Page, packed: bytes) -> None:
    def change(content: Any) -> None:
        content["best"]["settings"]["ranking"][0] |= {"score": 123.4, "expected": 120.0}

    page.open("#/file")
    drop(page, ("a.tunejobs", changed(packed, change)))
    page.says(".finished", "123.4 return")


def test_it_is_chosen_with_the_keyboard_and_kept_while_the_page_is_open(
    page: Page, packed: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "chosen.tunejobs"
    path.write_bytes(packed)
    page.open()
    page.button("Open a file", "nav").send_keys(Keys.ENTER)
    page.says("main h1", "Sweep file")
    assert page.focused() != ""
    button = page.button("Open a file…", "main")
    page.run("window.clicks = 0; document.querySelector('#chosen-file').click = () => { window.clicks += 1; }")
    button.send_keys(Keys.ENTER)
    assert page.run("return window.clicks") == 1
    page.browser.find_element(By.ID, "chosen-file").send_keys(str(path))
    page.says("main h1", "cartpole-ppo")
    page.button("lr", ".trials").click()
    assert page.address() == "#/file?sort=lr"
    page.button("Sweeps", "nav").click()
    page.says("main h1", "Sweeps")
    page.run("history.back()")
    page.says("main", "chosen.tunejobs")
    # It is nowhere else: a page that is loaded again asks for it.
    page.browser.refresh()
    page.says("main", "Drop the file of a sweep")


def test_another_file_takes_the_place_of_the_first(page: Page, packed: bytes, live: Live) -> None:
    page.open("#/file")
    drop(page, ("one.tunejobs", packed))
    page.says("main h1", "cartpole-ppo")
    page.one(".trials-card input[type=search]").send_keys("relu")
    drop(page, ("two.tunejobs", sweep_file(SweepStore(live.storage / "cartpole-seeds"))))
    page.says("main h1", "cartpole-seeds")
    assert page.address() == "#/file"
    page.says(".trials-card", "48 trials")
    assert len(page.browser.find_elements(By.CSS_SELECTOR, "main h1")) == 1


def test_it_is_shown_when_the_service_is_gone(browser: webdriver.Chrome, tmp_path: Path, packed: bytes) -> None:
    page = Page(browser, "")
    with serving(tmp_path / "sweeps") as gone:
        page.url = gone.url
        page.open()
        page.says("main h1", "Sweeps")
    drop(page, ("alone.tunejobs", packed))
    page.says("main h1", "cartpole-ppo")
    page.says(".trials-card", "60 trials")
    assert page.text("#link-state") == ""


def test_it_is_shown_to_whoever_has_no_token(browser: webdriver.Chrome, tmp_path: Path, packed: bytes) -> None:
    with opened_gate(ServiceConfig(storage=tmp_path / "sweeps")) as gate:
        gate.tokens.make("ann", "admin")
    with serving(tmp_path / "sweeps", require_token=True) as closed:
        page = Page(browser, closed.url)
        page.open()
        page.says("main h1", "Log in")
        drop(page, ("mine.tunejobs", packed))
        page.says("main h1", "cartpole-ppo")
        page.run("location.hash = '#/'")
        page.says("main h1", "Log in")
        page.open("#/file")
        page.says("main h1", "Sweep file")


def test_texts_of_a_file_are_texts(page: Page, packed: bytes) -> None:
    def change(content: Any) -> None:
        content["sweep"]["name"] = f"name {HOSTILE}"
        content["sweep"]["spec"]["env"]["id"] = f"env {HOSTILE}"
        content["sweep"]["spec"]["space"] = {
            f"lr{HOSTILE}": {"grid": [HOSTILE, "__proto__"]},
            "__proto__": {"grid": [1]},
        }
        for trial in content["trials"]:
            trial["point"] = {f"lr{HOSTILE}": HOSTILE, "__proto__": 1, "constructor": [[HOSTILE]], "big": 1e308}
            trial["hyperparams"] = {HOSTILE: {"toString": HOSTILE}}
            trial["notes"] = [HOSTILE]
            trial["node"] = trial["stop_reason"] = HOSTILE
        content["trials"][0]["point"]["big"] = -1e308
        content["importance"]["hyperparams"][0]["name"] = HOSTILE
        content["importance"]["notes"] = [f"note {HOSTILE}"]
        content["best"]["settings"]["ranking"][0]["point"] = {HOSTILE: HOSTILE}

    page.open("#/file")
    drop(page, (f"{HOSTILE}.tunejobs".replace("/", ""), changed(packed, change)))
    page.says("main h1", HOSTILE)
    page.says(".from-file", "<img src=x")
    page.says(".importance", f"note {HOSTILE}")
    page.says(".finished", HOSTILE)
    page.one(".trials tbody th").click()
    page.says(".panel", HOSTILE)
    assert page.run("return document.querySelectorAll('main img, main script').length") == 0
    assert page.run("return ({}).grid === undefined && ({}).big === undefined")


def test_numbers_beyond_all_axes_stop_nothing(page: Page, packed: bytes) -> None:
    def change(content: Any) -> None:
        for index, (trial, curve) in enumerate(zip(content["trials"], content["curves"].values(), strict=True)):
            trial["point"]["lr"] = 1e16 + 4 * (index % 2)
            trial["score"] = 1e308 if index % 2 else -1e308
            curve["training_return"] = [1e16 + 2 * (place % 3) for place in range(len(curve["iteration"]))]
            curve["evaluation_return"] = [(-1) ** place * 1.7e308 for place in range(len(curve["iteration"]))]
        content["sweep"]["spec"]["space"] = {"lr": {"uniform": [1, 2]}}

    page.open("#/file")
    drop(page, ("huge.tunejobs", changed(packed, change)))
    page.says(".trials-card", "60 trials")
    page.button("Evaluation", ".curves").click()
    page.until(lambda: page.run("return document.querySelector('[data-metric=evaluation]').ariaPressed") == "true")
    page.one(".trials tbody th").click()
    page.says(".panel", "Values")


def bomb() -> bytes:
    """More than readers take, in less than a megabyte."""
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    parts = [packer.compress(b'{"format": "tune-jobs sweep", "version": 1, "as_of": "')]
    parts += [packer.compress(b"a" * 2**20) for _ in range(MAX_BYTES // 2**20 + 1)]
    return b"".join([*parts, packer.compress(b'"}'), packer.flush()])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda _: b"", "it is empty"),
        (lambda _: b"algorithm: ppo\n", "is no sweep file"),
        (lambda packed: packed[: len(packed) // 2], "it ends too early"),
        (lambda packed: packed[:5000] + b"?" * 50 + packed[5050:], "is damaged"),
        (lambda packed: packed[:-6] + b"123456", "is damaged"),
        (lambda _: gzip.compress(b"\xff\xfe\x00"), "is no text"),
        (lambda _: gzip.compress(b'{"format": '), "is no JSON"),
        (lambda _: gzip.compress(b"[]"), "another format"),
        (lambda _: gzip.compress(b"null"), "another format"),
    ],
)
def test_what_is_no_sweep_is_said(page: Page, packed: bytes, make: Callable[[bytes], bytes], said: str) -> None:
    assert said in refusal(page, make(packed))


def refusal(page: Page, content: bytes) -> str:
    """Drop a file, and return what is said of it."""
    page.open()
    drop(page, ("wrong.tunejobs", content))
    page.says("dialog", "This file can't be opened")
    said = page.text("dialog")
    assert "wrong.tunejobs" in said
    assert page.focused() == "Choose another…"
    page.keys(Keys.ESCAPE)
    page.wait("return document.querySelector('.dialog') === null")
    # The reader is where they were.
    assert page.text("main h1") == "Sweeps"
    return said


NESTED = json.loads("[" * 900 + "]" * 900)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("version",), 2, "a newer tune-jobs: its format is 2, and this page reads 1"),
        (("version",), "1", "no version"),
        (("trials",), None, "trials is null, not a list"),
        (("trials", 3, "score"), "9", "trials[3].score is a text, not a finite number"),
        (("trials", 3, "trial_id"), "t0002", "trials has an id twice"),
        (("trials", 3, "trial_id"), "../x", "trials[3].trial_id is a text, not a trial's id"),
        (("trials", 0, "point"), [], "trials[0].point is a list, not an object"),
        (("trials", 0, "point", "deep"), NESTED, "nested too deeply"),
        (("trials", 0, "point"), {f"p{n}": 1 for n in range(300)}, "300 names, and no more than 200"),
        (("curves", "t0001", "iteration", 2), None, "curves.t0001.iteration[2] is null, not a whole number"),
        (("curves", "t0001", "iteration"), [1], "numbers, and iteration has 1"),
        (("trials", 3, "ended_at"), 1e300, "trials[3].ended_at is a number, not a Unix time"),
        (("status", "state"), "gone", "status.state is a text, not one of created"),
        (("sweep", "spec", "space"), {"lr": {"grid": 3}}, "sweep.spec.space.lr.grid is a number, not a list"),
        (("best", "settings", "ranking"), [], "best.settings.ranking is empty"),
        (("best", "settings", "ranking", 0, "score"), "9", "best.settings.ranking[0].score is a text, not a finite"),
    ],
)
def test_what_is_wrong_in_a_sweep_is_said_with_its_place(
    page: Page, packed: bytes, place: tuple[str | int, ...], value: Any, said: str
) -> None:
    def change(content: Any) -> None:
        for name in place[:-1]:
            content = content[name]
        content[place[-1]] = value

    assert said in refusal(page, changed(packed, change))


def test_a_small_file_that_would_fill_the_memory_is_refused(page: Page, tmp_path: Path) -> None:
    packed = bomb()
    assert len(packed) < 2**20
    path = tmp_path / "bomb.tunejobs"
    path.write_bytes(packed)
    page.open("#/file")
    page.browser.find_element(By.ID, "chosen-file").send_keys(str(path))
    page.says("dialog", "there is more in it than the 268.4 MB are read at most")
    path = tmp_path / "large.tunejobs"
    with path.open("wb") as file:
        file.write(b"\x1f\x8b")
        file.truncate(65 * 2**20)
    page.browser.find_element(By.ID, "chosen-file").send_keys(str(path))
    page.says("dialog", "it has 68.2 MB")


def test_one_file_is_opened_at_a_time(page: Page, packed: bytes) -> None:
    page.open()
    drop(page, ("a.tunejobs", packed), ("b.tunejobs", packed))
    page.says("dialog", "2 files were given")


def test_a_text_that_is_dragged_is_no_file(page: Page) -> None:
    page.open()
    page.run("""
        const transfer = new DataTransfer();
        transfer.setData("text/plain", "a");
        const event = new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true });
        window.isTaken = !document.body.dispatchEvent(event);
    """)
    assert page.run("return window.isTaken") is False
    assert page.run("return document.querySelector('dialog') === null")


def test_a_running_sweep_is_shown_as_it_was(page: Page, packed: bytes) -> None:
    def change(content: Any) -> None:
        content["status"].update(state="running", time_left_s=100.0)
        content["as_of"] = 1_700_000_000.0

    page.open("#/file")
    drop(page, ("running.tunejobs", changed(packed, change)))
    page.says(".from-file", "It was running; this is how it was on 14 November 2023")


def test_the_page_of_a_sweep_saves_it_as_a_file(page: Page) -> None:
    page.open("#/sweeps/cartpole-ppo")
    link = page.button("Save as a file")
    assert str(link.get_attribute("href")).endswith("/api/v1/sweeps/cartpole-ppo/file")
    assert link.get_attribute("download") is not None


def test_the_drop_is_offered_while_a_file_is_over_the_page(page: Page) -> None:
    page.open()
    over = """
        const transfer = new DataTransfer();
        transfer.items.add(new File(["a"], "a"));
        document.body.dispatchEvent(new DragEvent(arguments[0], { dataTransfer: transfer, bubbles: true }));
        return document.querySelector(".drop-here").hidden;
    """
    assert page.run(over, "dragenter") is False
    assert page.run(over, "dragleave") is True


@pytest.mark.parametrize("view", ["none", "sweep", "trial", "refused"])
def test_views_have_no_barriers_and_fit_each_width(page: Page, packed: bytes, view: str) -> None:
    for width, theme in ((400, "light"), (1280, "dark"), (1920, "light")):
        page.open("#/file", width=width, theme=theme)
        page.says("main h1", "Sweep file")
        if view == "refused":
            drop(page, ("a.tunejobs", b"no"))
            page.says("dialog", "is no sweep file")
        elif view != "none":
            drop(page, ("a.tunejobs", packed))
            page.says(".trials-card", "60 trials")
            page.says(".curves .keys", "lr ")
        if view == "trial":
            page.one(".trials tbody th").click()
            page.says(".panel", "Values")
        assert page.violations() == [], width
        assert page.run("return document.documentElement.scrollWidth <= innerWidth"), width
