from __future__ import annotations

import pytest

from tune_jobs.sweeps import drive
from tune_jobs.sweeps.drive import cpus_for_episodes, within_cpus


@pytest.fixture(autouse=True)
def _this_machine_has_eight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive, "usable_cpus", lambda: 8.0)


def test_a_sweep_of_this_machine_may_use_what_it_has() -> None:
    assert cpus_for_episodes(None) == 8


@pytest.mark.parametrize(("most", "num"), [(3.0, 3), (3.5, 3), (0.5, 1), (20.0, 8)])
def test_a_job_of_a_service_may_use_its_own(most: float, num: int) -> None:
    with within_cpus(most):
        assert cpus_for_episodes(None) == num


def test_on_a_clusters_node_it_is_one() -> None:
    assert cpus_for_episodes("auto") == 1
