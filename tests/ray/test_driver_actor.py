"""The driver of a `ray://` client's sweep, which is an actor on the cluster; that it runs is seen in tests/cluster."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from analysis.records import TrialRecord
from tune_jobs.ray_tune import driver_actor
from tune_jobs.ray_tune.run_trials import RunJob
from tune_jobs.store.objects.held import held, holding
from tune_jobs.store.objects.url import ObjectUrl

pytestmark = pytest.mark.ray

_PLACE = "s3://bucket/sweeps/driven?endpoint=http://127.0.0.1:1"


class FakeRay:
    """As much of Ray as the client asks for: an actor whose run is over at once, and that changed nothing."""

    def __init__(self, run: Any) -> None:
        self._run = run

    def remote(self, **_: Any) -> Any:
        actor = SimpleNamespace(
            run=SimpleNamespace(remote=self._run), changes=SimpleNamespace(remote=list[TrialRecord])
        )
        return lambda _: SimpleNamespace(remote=lambda: actor)

    def wait(self, running: list[Any], timeout: float) -> tuple[list[Any], list[Any]]:
        return running, []

    def get(self, answer: Any) -> Any:
        return answer

    def kill(self, actor: Any) -> None:
        pass


def test_a_client_reads_anew_what_the_actor_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a sweep that has ended is interrupted to its client, with all trials pending as they were before."""
    url, known = ObjectUrl.parse(_PLACE), []

    def run(_: RunJob) -> None:
        ours = held(url)
        assert ours is not None
        known.append(ours.is_known)

    monkeypatch.setattr(driver_actor, "ray", FakeRay(run))
    monkeypatch.setattr(driver_actor, "_POLL_INTERVAL_S", 0.0)
    with holding(url, lambda: True):
        driver_actor.run_trials_remotely(cast("RunJob", SimpleNamespace(sweep_place=_PLACE)), lambda _: None)
    assert known == [False]
