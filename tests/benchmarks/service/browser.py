"""How soon the page of a sweep can be used, in Chromium, and how it bears reports; Optuna's dashboard beside it."""

from __future__ import annotations

import contextlib
import importlib.util
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from page_browser import CHROMIUM, DRIVER, chromium
from page_sweeps import write_large, write_sweep
from selenium import webdriver
from served import Served
from synthetic_sweep import make_points, make_sweep

from tune_jobs.store.sweep_store import SweepStore

REPORTS_PER_S = 20
REPORT_S = 10.0
QUIET_S = 1.0
# When a text is seen, and what kept the page busy: a task of over 50 ms delays a click.
_WATCH = """
    window.seenAt = null;
    window.busy = [];
    new PerformanceObserver((list) => {
      for (const task of list.getEntries()) window.busy.push([task.startTime, task.duration]);
    }).observe({ type: "longtask", buffered: true });
    const look = () => {
      const node = %s;
      if (node && node.checkVisibility() && node.innerText.includes(%s)) window.seenAt = performance.now();
      else requestAnimationFrame(look);
    };
    addEventListener("DOMContentLoaded", () => requestAnimationFrame(look));
"""


def rows(repeats: int) -> list[tuple[str, str, str]]:
    """Measure, where there is a browser."""
    if CHROMIUM is None or DRIVER is None:
        return [("the page in a browser", "no Chromium and chromedriver here", "")]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with chromium(folder / "profile") as browser:
            return [*_ours(browser, folder / "sweeps", repeats), *_optuna(browser, folder, repeats)]


def _ours(browser: webdriver.Chrome, storage: Path, repeats: int) -> list[tuple[str, str, str]]:
    points = make_points(250, np.random.default_rng(0))
    made = make_sweep(name="thousand", points=points, max_steps=20_000, with_best=False)
    space = {"lr": {"loguniform": [1e-7, 1e-2]}, "activation": {"grid": ["linear", "relu"]}}
    store = write_sweep(storage, made, state="running", ended_at=None, spec={"space": space})
    write_large(storage)
    served = Served(storage, "--spare-idle", "0")
    table = "document.querySelector('.trials-card [role=status]')"
    try:
        with store.lock():
            page = f"{served.url}/#/sweeps/thousand"
            thousand = statistics.median(_interactive(browser, page, table, "1,000 trials") for _ in range(repeats + 1))
            worst = _longest_task_while_reporting(browser, store)
        page = f"{served.url}/#/sweeps/large"
        large = statistics.median(_interactive(browser, page, table, "10,000 trials") for _ in range(repeats + 1))
    finally:
        served.end()
    return [
        ("page of 1,000 trials, interactive", f"{thousand:.2f} s", "1 s"),
        (f"  longest task while {REPORTS_PER_S} trials a second report", f"{worst * 1e3:.0f} ms", "200 ms"),
        ("page of 10,000 trials, interactive", f"{large:.2f} s", ""),
    ]


def _interactive(browser: webdriver.Chrome, url: str, node: str, text: str) -> float:
    """Seconds until a text is seen, and what follows it at once is drawn."""
    browser.get("about:blank")
    script = {"source": _WATCH % (node, repr(text))}
    identifier = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", script)["identifier"]
    try:
        browser.get(url)
        deadline = time.monotonic() + 120
        while browser.execute_script("return window.seenAt") is None:
            if time.monotonic() > deadline:
                raise RuntimeError(f"{url} never shows {text!r}")
            time.sleep(0.05)
        time.sleep(QUIET_S)
        seen, busy = browser.execute_script("return [window.seenAt, window.busy]")
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", {"identifier": identifier})
    ends = [begin + took for begin, took in busy if begin <= seen + 200]
    return float(max([seen, *ends])) / 1e3


def _longest_task_while_reporting(browser: webdriver.Chrome, store: SweepStore) -> float:
    """Seconds of the longest task of the page that was opened last."""
    browser.execute_script("window.busy = []")
    over = threading.Event()
    writer = threading.Thread(target=_report, args=(store, over), daemon=True)
    writer.start()
    time.sleep(REPORT_S)
    over.set()
    writer.join()
    time.sleep(QUIET_S)
    busy = browser.execute_script("return window.busy")
    return float(max([took for _, took in busy], default=0.0)) / 1e3


def _report(store: SweepStore, over: threading.Event) -> None:
    rng, known = random.Random(0), [trial for trial in store.read_trials() if trial.num_iterations]
    while not over.wait(1.0 / REPORTS_PER_S):
        index = rng.randrange(len(known))
        before = known[index]
        number, steps, reached = before.num_iterations + 1, before.num_env_steps + 1_024, rng.uniform(10.0, 200.0)
        trial = store.trial(before.trial_id)
        last = trial.read_iterations()[-1]
        changes = {"num_env_steps": steps, "training_return": reached}
        trial.append_iterations([last.model_copy(update=changes | {"iteration": number})])
        known[index] = before.model_copy(update=changes | {"num_iterations": number, "status": "running"})
        trial.write_record(known[index])


def _optuna(browser: webdriver.Chrome, folder: Path, repeats: int) -> list[tuple[str, str, str]]:
    if importlib.util.find_spec("optuna_dashboard") is None:
        return [("Optuna's dashboard", "optuna-dashboard is not installed here", "")]
    with _dashboard(folder) as url:
        # The page of a study; its chart's axis goes up to ten thousand trials.
        page = f"{url}/dashboard/studies/0"
        times = [_interactive(browser, page, "document.body", "10k") for _ in range(repeats + 1)]
    return [("  Optuna's dashboard, a study of 10,000 trials", f"{statistics.median(times):.2f} s", "")]


@contextlib.contextmanager
def _dashboard(folder: Path) -> Iterator[str]:
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    journal = folder / "journal.log"
    study = optuna.create_study(storage=JournalStorage(JournalFileBackend(str(journal))), direction="maximize")
    rng = np.random.default_rng(0)
    space = {
        "lr": optuna.distributions.FloatDistribution(1e-7, 1e-2, log=True),
        "activation": optuna.distributions.CategoricalDistribution(("linear", "relu")),
        "hidden_sizes": optuna.distributions.CategoricalDistribution(("32", "64")),
    }
    study.add_trials(
        [
            optuna.trial.create_trial(
                params={
                    "lr": float(10 ** rng.uniform(-7, -2)),
                    "activation": str(rng.choice(["linear", "relu"])),
                    "hidden_sizes": str(rng.choice(["32", "64"])),
                },
                distributions=space,
                value=float(rng.uniform(10, 200)),
            )
            for _ in range(10_000)
        ]
    )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    program = str(Path(sys.executable).parent / "optuna-dashboard")
    command = [program, str(journal), "--port", str(port), "--host", "127.0.0.1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}"
    try:
        deadline = time.monotonic() + 60
        while True:
            with contextlib.suppress(OSError):
                urllib.request.urlopen(f"{url}/api/studies", timeout=60).read()
                break
            if time.monotonic() > deadline:
                raise RuntimeError("Optuna's dashboard never answered")
            time.sleep(0.2)
        yield url
    finally:
        process.terminate()
        process.wait()
