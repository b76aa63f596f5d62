"""A slow environment with CPUs to spare: it is planned to run in processes of its own, and does."""

from pathlib import Path

import pytest

from policies.envs import modules as env_modules
from policies.envs.modules import allow_modules
from tests.narrowing import present
from tune_jobs.plan.machine import Machine
from tune_jobs.plan.sweep_plan import make_plan
from tune_jobs.spec.file import load_spec
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.drive import write_new

pytestmark = [pytest.mark.ray, pytest.mark.usefixtures("ray_session")]

NUM_ENVS = 4


def test_one_trial_alone_has_its_slow_environment_stepped_by_the_idle_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tune_jobs.ray_tune.run_trials import RunJob, run_trials

    monkeypatch.setattr(env_modules, "_allowed", set())
    allow_modules(["tune_jobs_test_own"])
    pids = tmp_path / "pids"
    spec = load_spec(
        {
            "env": {"id": "tune_jobs_test_own:SlowEdge", "args": {"pids": str(pids)}},
            "algorithm": "ppo",
            "hyperparams": {
                "num_envs": NUM_ENVS, "train_batch_size": 64, "minibatch_size": 64, "num_epochs": 1,
                "hidden_sizes": [4],
            },
            "stop": {"num_iterations": 2},
            "evaluation": {"num_episodes": 1},
        }
    )  # fmt: skip
    plan = make_plan(spec, Machine(2))
    packs = present(plan.packs)
    assert (packs.num_packs, packs.env_kind, packs.num_env_processes, packs.cpus_per_pack) == (1, "processes", 1, 2)
    store = SweepStore(tmp_path / "mine")
    store.create()
    write_new(store, spec, plan, None)
    pids.unlink()
    job = RunJob(
        store.place, ("t0000",), plan.cpus_per_trial, plan.gpus_per_trial, plan.max_concurrent, packs=packs
    )  # fmt: skip
    run_trials(job, lambda record: None)
    (record,) = store.read_trials()
    assert (record.status, record.error) == ("completed", None)
    stepped = [tuple(map(int, line.split())) for line in pids.read_text().splitlines()]
    in_processes = [pid for pid, parent in stepped if parent == record.pid]
    # The pack's own process has the other half.
    assert len(in_processes) == NUM_ENVS // 2
    assert len(set(in_processes)) == 1
    assert len([pid for pid, _ in stepped if pid == record.pid]) >= NUM_ENVS // 2
