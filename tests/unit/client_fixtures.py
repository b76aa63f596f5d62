"""What the tests of the client and of --server share: no long waits, and nothing of this machine's environment."""

import pytest

from tune_jobs.client import connection, event_stream
from tune_jobs.service.views import SweepView

_VARIABLES = ("TUNE_JOBS_SERVER", "TUNE_JOBS_TOKEN", "TUNE_JOBS_TOKEN_FILE", "HTTP_PROXY", "http_proxy")


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the tests of a module that imports this, the environment names no service, token or proxy."""
    for name in _VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the tests of a module that imports this, what was lost is asked again at once, and events come soon."""
    monkeypatch.setattr(connection, "_WAITS_S", (0.01, 0.01, 0.01, 0.01))
    monkeypatch.setattr(event_stream, "_WAIT_S", 0.02)
    monkeypatch.setattr(SweepView, "interval_s", 0.05)
