"""The benchmarks: what they need is installed for them, and what they measure is what their page says."""

from __future__ import annotations

import importlib.metadata
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from test_loading import WITHOUT_THE_REST

from tests.benchmarks import beside, ppo
from tests.benchmarks.measure import Run

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "benchmarks.md").read_text()


def packages_of(*extras: str) -> set[str]:
    """Return the names of what is installed with some extras of the project, and of all that these need."""
    found: set[str] = set()
    left: list[tuple[str, str]] = [("tune-jobs", extra) for extra in ("", *extras)]
    seen = set(left)
    while left:
        name, extra = left.pop()
        try:
            needed = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        found.add(name)
        for one in map(Requirement, needed):
            if one.marker is None or one.marker.evaluate({"extra": extra}):
                known = re.sub("[-_.]+", "-", one.name).lower()
                new = {(known, also) for also in ("", *one.extras)} - seen
                seen |= new
                left += new
    return found


def extras_of(target: str) -> set[str]:
    """Return the extras that a target of the Makefile installs, with those of the targets that it needs."""
    rules = re.findall(rf"^\$\(VENV\)/{target}: (.*)\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    ((needed, recipe),) = rules
    extras = {extra for some in re.findall(r"'\.\[([\w,]+)\]'", recipe) for extra in some.split(",")}
    return extras.union(*(extras_of(other) for other in re.findall(r"\$\(VENV\)/(installed-\w+)", needed)))


def test_the_benchmarks_begin_with_what_is_installed_for_them() -> None:
    extras = extras_of("installed-bench")
    # LunarLander is among the works.
    assert {"bench", "box2d"} <= extras
    code = f"{WITHOUT_THE_REST}\nimport runpy\nsys.argv = ['benchmarks', '--help']\n"
    code += "runpy.run_module('tests.benchmarks', run_name='__main__')"
    command = [sys.executable, "-c", code, json.dumps(sorted(packages_of(*extras)))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "--only" in done.stdout


NAMED = {
    "SB3's DQN lacks td_loss mse.": "its loss is Huber's and not `mse`",
    "SB3's DQN lacks double_q, td_loss mse.": "is not in Stable-Baselines3",
    "The target network is updated once for each training phase, with tau 0.3439, not 4 times in it.":
        "is updated once in a phase of training where ours is four times",
    "SB3's actions are all random until learning_starts, ours as epsilon says.":
        "its actions are all random until learning starts",
    "SB3 standardises advantages over each minibatch, ours over the whole train batch.":
        "it standardises advantages over each minibatch",
    "entropy_coeff stays at its first value: SB3 has no schedule for ent_coef.":
        "it has no schedule of the entropy's weight",
}  # fmt: skip


@pytest.mark.parametrize("work", beside.WORKS.values(), ids=beside.WORKS)
def test_the_page_names_what_the_peer_does_otherwise(work: beside.Work) -> None:
    for note in beside.peer_notes(work):
        assert NAMED[note] in PAGE


def test_single_runs_are_called_so_and_launches_are_timed_as_the_page_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    written: list[str] = []

    def run(command: list[str], **_: Any) -> Run:
        written.append(Path(command[2]).read_text())
        return Run(2.0, 1, None, "")

    monkeypatch.setattr(ppo, "run", run)
    monkeypatch.setattr(ppo, "records", lambda _: [{"started_at": 1.0, "ended_at": 2.0}])
    monkeypatch.setattr("tempfile.mkdtemp", lambda: str(tmp_path))
    assert all("(one run)" in name for name, *_ in ppo.many_rows(1_000))
    assert len(written) == 2
    assert all("confirm: none" in text for text in written)
    assert "It has `confirm: none`" in PAGE
