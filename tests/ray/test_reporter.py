"""In a notebook Ray Tune shows nothing of its own; elsewhere it is silent by itself."""

import pytest

from tune_jobs.ray_tune import reporter as reporting

pytestmark = pytest.mark.ray


def test_tune_gets_a_reporter_that_reports_nothing_in_a_notebook_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reporting.reporter() is None
    monkeypatch.setattr(reporting, "in_notebook", lambda: True)
    silent = reporting.reporter()
    assert silent is not None
    silent.setup(start_time=0.0, total_samples=1, metric=None, mode=None)
    assert silent.should_report([], done=True) is False
