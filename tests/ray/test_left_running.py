"""A Ray that is started for a restored Algorithm, and stays: its process is as before but for that."""

from __future__ import annotations

import logging
import os

import pytest

from policies.errors import CannotRunError
from tune_jobs.plan.machine import Machine

pytestmark = pytest.mark.ray

NICENESS = "RAY_worker_niceness"


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("given", [None, "7"])
def test_it_has_a_sweeps_niceness_and_leaves_rays_logger_and_variables(
    monkeypatch: pytest.MonkeyPatch, given: str | None, *, fails: bool
) -> None:
    import ray

    from tune_jobs.ray_tune import cluster, local_ray

    logger, seen = logging.getLogger("ray"), list[str]()
    monkeypatch.setattr(logger, "level", logging.INFO)
    for name in (NICENESS, "RAY_USAGE_STATS_ENABLED"):
        monkeypatch.delenv(name, raising=False)
        if given is not None:
            monkeypatch.setenv(name, given)
    before = dict(os.environ)

    def init(**settings: str) -> None:
        seen.append(os.environ[NICENESS])
        logger.setLevel(settings["logging_level"].upper())
        if fails:
            raise OSError("no space left")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", init)
    monkeypatch.setattr(local_ray, "provide_token", lambda: None)
    if fails:
        with pytest.raises(CannotRunError, match="no space left"), cluster.left_running(Machine(1)):
            pass
    else:
        with cluster.left_running(Machine(1)):
            assert logger.level == logging.INFO
    assert seen == [given or "0"]
    assert logger.level == logging.INFO
    assert dict(os.environ) == before
