"""What is believed of scores that were edited, of processes of others, and of values that a scale lacks."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from policy_factory import make_portable
from store_parts import fill, make_checkpoint, make_iteration, make_sweep, make_trial

from policies.errors import CheckpointError
from policies.files import atomic_path, is_abandoned
from policies.portable.file import save_policy
from tune_jobs.search.study import _distribution
from tune_jobs.spec.file import load_spec
from tune_jobs.store.candidates import candidates
from tune_jobs.store.sweep_store import SweepStore


@pytest.fixture
def store(tmp_path: Path) -> SweepStore:
    """Three points with two seeds each."""
    store = SweepStore(tmp_path / "mine")
    store.create()
    store.write_record(make_sweep(spec={"seeds_per_point": 2}, num_trials=6))
    for index in range(6):
        store.trial(f"t{index:04d}").write_record(make_trial(index, point_index=index // 2, seed_index=index % 2))
    return store


@pytest.mark.parametrize(
    ("says", "may_be_chosen"),
    [({}, True), ({"evaluation_return": 9.0}, False), ({"num_env_steps": 100}, False), ({"num_env_steps": 301}, False)],
)
def test_a_checkpoint_has_the_score_and_the_env_steps_of_its_line(
    store: SweepStore, says: dict[str, Any], may_be_chosen: bool
) -> None:
    trial = store.trial("t0000")
    trial.append_iterations([make_iteration(number, evaluation_return=5.0) for number in (1, 2, 3)])
    trial.write_checkpoint(make_checkpoint(3, **{"evaluation_return": 5.0, **says}), fill)
    assert [record.iteration for record in candidates(trial)] == ([3] if may_be_chosen else [])


def test_lines_that_were_written_in_another_form_count_too(store: SweepStore) -> None:
    trial = store.trial("t0000")
    line = json.loads(make_iteration(3, evaluation_return=5.0).model_dump_json())
    trial.results_path.write_text(json.dumps(dict(reversed(line.items()))) + "\n")
    assert trial.scores_of([3]) == {3: [(300, 5.0)]}


def test_what_a_process_of_another_user_writes_is_not_abandoned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(pid: int, signal: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    with atomic_path(tmp_path / "trial.json") as temporary:
        temporary.write_text("half")
        monkeypatch.setattr(os, "kill", refuses)
        assert not is_abandoned(temporary)


def test_a_study_has_a_plain_scale_where_a_point_was_chosen_that_a_logarithmic_one_lacks() -> None:
    optuna = pytest.importorskip("optuna")
    space = {"entropy_coeff": {"loguniform": [1e-4, 1e-1]}}
    domain = load_spec({"env": "CartPole-v1", "algorithm": "ppo", "space": space}).space["entropy_coeff"]
    assert _distribution(domain, [1e-3]) == optuna.distributions.FloatDistribution(1e-4, 1e-1, log=True)
    assert _distribution(domain, [1e-3, 0.0]) == optuna.distributions.FloatDistribution(0.0, 1e-1)


@pytest.mark.parametrize("clip", [0.0, -1.0, float("nan")])
def test_a_network_that_would_see_nothing_of_observations_is_not_saved(tmp_path: Path, clip: float) -> None:
    import dataclasses

    import numpy as np

    from policies.portable.file import Normalization

    policy = make_portable("CartPole-v1")
    seen = Normalization(np.zeros(4, np.float32), np.ones(4, np.float32), clip=clip)
    changed = dataclasses.replace(policy, network=dataclasses.replace(policy.network, normalization=seen))
    with pytest.raises(CheckpointError, match="clips at"):
        save_policy(changed, tmp_path)
