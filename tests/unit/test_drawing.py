"""What a report is drawn with is imported by one thread, for which the others wait."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from sweep_folders import make_sweep_folder

from analysis.report_data import goal_of
from tune_jobs.sweeps import drawing
from tune_jobs.sweeps.drawing import ReportMatter, import_ahead


def test_a_report_waits_until_all_is_imported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[str] = []
    writing = threading.Event()

    def slow(name: str) -> None:
        assert writing.wait(10)
        seen.append(name)

    def build(*_: Any, **__: Any) -> Path:
        seen.append("the report")
        return tmp_path / "index.html"

    monkeypatch.setattr(drawing, "importlib", SimpleNamespace(import_module=slow))
    monkeypatch.setattr(drawing, "_importing", [])
    monkeypatch.setattr("analysis.report.build_report", build)
    import_ahead()
    # Released by another thread, as this one is to be waiting by then.
    threading.Timer(0.2, writing.set).start()
    matter = ReportMatter("here", cast("Any", None), [], {}, None, None, None)
    assert matter.write(tmp_path, {}) == "index.html"
    assert seen[-1] == "the report"
    assert "matplotlib.figure" in seen[:-1]


def test_without_a_winner_an_env_of_ones_own_has_the_threshold_it_was_planned_with(tmp_path: Path) -> None:
    """The process that draws has not made the env, so Gymnasium doesn't know it."""
    store = make_sweep_folder(
        tmp_path / "mine",
        objective="steps_to_threshold",
        stop={"num_env_steps": 10_000, "evaluation_return": 12.0},
    )
    record = store.read_record()
    assert record.env_threshold == 475.0
    elsewhere = record.model_copy(update={"spec": {**record.spec, "env": {"id": "elsewhere:Mine-v0", "args": {}}}})
    store.write_record(elsewhere)
    settings = ReportMatter.read(store, None, None).settings
    assert settings is not None
    assert (settings.threshold, goal_of(elsewhere, None)) == (475.0, 475.0)
    # One of a former version, of which nobody knows the threshold any more: no settings, and a report all the same.
    spec = {**elsewhere.spec, "stop": {"num_env_steps": 10_000}}
    store.write_record(elsewhere.model_copy(update={"spec": spec, "env_threshold": None}))
    matter = ReportMatter.read(store, None, None)
    assert matter.settings is None
    assert matter.write(tmp_path / "report", {}) == "index.html"
