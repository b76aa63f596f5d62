"""How soon a submitted sweep trains, and what watching costs it."""

from __future__ import annotations

import functools
import multiprocessing
import os
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from served import Served

from tune_jobs.store.sweep_store import SweepStore

NUM_WATCHERS = 100
FIRST: dict[str, Any] = {
    "env": "CartPole-v1", "algorithm": "ppo", "space": {"lr": {"loguniform": [1e-3, 1e-2]}}, "num_samples": 4,
    "hyperparams": {"train_batch_size": 256, "num_envs": 2}, "stop": {"num_env_steps": 20_480}, "confirm": "none",
}  # fmt: skip
WATCHED = FIRST | {"num_samples": 20, "hyperparams": {}, "stop": {"num_env_steps": 200_000, "evaluation_return": 1_000}}


def first_step_rows(repeats: int) -> list[tuple[str, str, str]]:
    """From a request to the first env step: right after the service's start, and once a process is kept warm."""
    cold, warm = [], []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as name:
            served = Served(Path(name) / "sweeps")
            try:
                cold.append(_until_first_step(served, "cold"))
                served.wait(functools.partial(_is_warm, served), "no process is kept warm")
                # Ray's own processes are busy for some seconds after they have begun.
                time.sleep(5.0)
                warm.append(_until_first_step(served, "warm"))
            finally:
                served.end()
    return [
        ("request to first env step, warm", f"{statistics.median(warm):.2f} s", "1 s"),
        ("  right after the service's start", f"{statistics.median(cold):.1f} s", "5 s"),
    ]


def _is_warm(served: Served) -> bool:
    spare = served.ask("GET", "me")["spare"]
    return spare is not None and bool(spare["warm"])


def _until_first_step(served: Served, name: str) -> float:
    """Submit a sweep, and wait for its first iteration, which is a small one: the first env step was before that."""
    begin = time.perf_counter()
    served.ask("POST", "sweeps", {"spec": FIRST, "name": name})
    store = SweepStore(served.folder / name)
    served.wait(lambda: any(trial.read_iterations() for trial in _trials(store)), "no trial has begun")
    took = time.perf_counter() - begin
    assert served.wait_for_job()["outcome"] == "completed"
    return took


def _trials(store: SweepStore) -> list[Any]:
    return [store.trial(f"t{index:04d}") for index in range(int(FIRST["num_samples"]))]


def watcher_rows(repeats: int) -> list[tuple[str, str, str]]:
    """Env steps/s of a sweep that nobody watches, and of one that many do, in turns.

    On a machine that others share, env steps/s of one and the same sweep differ by more than what is looked for. So the
    CPU time that the service takes is given too, as a share of what all cores could do meanwhile.
    """
    alone: list[_Cost] = []
    watched: list[_Cost] = []
    with tempfile.TemporaryDirectory() as name:
        served = Served(Path(name) / "sweeps", "--spare-idle", "0")
        try:
            # The first sweep of a machine is slower than those that follow.
            _run_watched(served, "first", 0)
            for number in range(repeats):
                for count, costs in ((0, alone), (NUM_WATCHERS, watched))[:: 1 if number % 2 else -1]:
                    costs.append(_run_watched(served, f"sweep-{number}-{count}", count))
        finally:
            served.end()
    cost = 1.0 - statistics.median(b.env_steps_per_s / a.env_steps_per_s for a, b in zip(alone, watched, strict=True))
    before, after = (statistics.median(item.share for item in costs) for costs in (alone, watched))
    return [
        (f"{NUM_WATCHERS} live watchers cost the trials", f"{100 * cost:.1f} % of env steps/s", "2 %"),
        ("  the service's share of all cores without and with them", f"{100 * before:.1f} and {100 * after:.1f} %", ""),
        ("  env steps/s, nobody watching", f"{statistics.median(a.env_steps_per_s for a in alone):,.0f}", ""),
    ]


@dataclass(frozen=True)
class _Cost:
    env_steps_per_s: float
    share: float
    """Of the service's process, of all that the cores could do."""


def _run_watched(served: Served, sweep: str, count: int) -> _Cost:
    served.ask("POST", "sweeps", {"spec": WATCHED, "name": sweep})
    begin, used = time.perf_counter(), _cpu_s(served.process.pid)
    with _watching(served.url, sweep, count):
        # To ask fifty times a second takes more of the service than a hundred watchers.
        while served.ask("GET", "jobs")[-1]["state"] != "ended":
            time.sleep(1.0)
    assert served.wait_for_job()["outcome"] == "completed"
    share = (_cpu_s(served.process.pid) - used) / (time.perf_counter() - begin) / (os.cpu_count() or 1)
    return _Cost(_env_steps_per_s(SweepStore(served.folder / sweep)), share)


def _cpu_s(pid: int) -> float:
    """CPU time of one process (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _env_steps_per_s(store: SweepStore) -> float:
    trials = store.read_trials()
    begin = min(trial.started_at for trial in trials if trial.started_at)
    end = max(trial.ended_at for trial in trials if trial.ended_at)
    return sum(trial.num_env_steps for trial in trials) / float(end - begin)


@contextmanager
def _watching(url: str, sweep: str, count: int) -> Iterator[None]:
    """Watchers that read a sweep's events and do nothing with them, in a process of the lowest priority."""
    if count == 0:
        yield
        return
    process = multiprocessing.get_context("spawn").Process(target=_watch, args=(url, sweep, count), daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def _watch(url: str, sweep: str, count: int) -> None:
    # They are other people's machines: reading here must take no time from the trials.
    os.nice(19)
    at: Any = urlsplit(url)
    for _ in range(count):
        connection = socket.create_connection((at.hostname, at.port))
        head = f"Host: {at.netloc}\r\nAccept: text/event-stream"
        connection.sendall(f"GET /api/v1/sweeps/{sweep}/events HTTP/1.1\r\n{head}\r\n\r\n".encode())
        threading.Thread(target=_drain, args=(connection,), daemon=True).start()
    threading.Event().wait()


def _drain(connection: socket.socket) -> None:
    while connection.recv(1 << 18):
        time.sleep(0.5)
