"""What a report is drawn with is imported by one thread, for which the others wait."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

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
