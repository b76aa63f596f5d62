"""A storage folder with sweeps as the page meets them: finished, interrupted, failed, with several seeds, and large."""

import time
from pathlib import Path
from typing import Any

import numpy as np
from synthetic_sweep import Synthetic, make_points, make_sweep

from tune_jobs.store.sweep_store import SweepStore

HOSTILE = "<img src=x onerror=document.title='run'>"
"""A text that would run as a script where it is read as HTML."""
ERROR = f"""RuntimeError: env.step raised ZeroDivisionError: {HOSTILE}
Traceback (most recent call last):
  File "envs/cart.py", line 31, in step
    return self._advance(action / self.gap)
ZeroDivisionError: {HOSTILE}
"""


def write_sweep(storage: Path, made: Synthetic, **changes: Any) -> SweepStore:
    """Write a made-up sweep into its folder, with its iterations and logs."""
    spec = made.sweep.spec | changes.pop("spec", {})
    record = made.sweep.model_copy(update={"spec": spec} | changes)
    store = SweepStore(storage / record.name)
    store.create()
    for trial in made.trials:
        folder = store.trial(trial.trial_id)
        started = None if trial.status == "pending" else record.created_at + 2.0 * (trial.index // 2)
        ended = started + trial.time_s if started is not None and trial.status in ("completed", "failed") else None
        folder.write_record(trial.model_copy(update={"started_at": started, "ended_at": ended, "node": "192.0.2.1/a"}))
        if rows := made.results[trial.trial_id]:
            folder.append_iterations(rows)
            folder.write_log("".join(f"iteration {row.iteration}: {row.num_env_steps} env steps\n" for row in rows))
    if made.best is not None and record.state == "completed":
        store.write_best(made.best)
    store.write_record(record)
    return store


def write_storage(storage: Path) -> None:
    """Write the sweeps that the tests and the pictures share."""
    now = time.time()
    rng = np.random.default_rng(3)
    log_space = {"lr": {"loguniform": [1e-7, 1e-2]}}
    grids = {"hidden_sizes": {"grid": [[32], [64]]}, "activation": {"grid": ["linear", "relu"]}}
    one = make_sweep(name="cartpole-ppo", points=make_points(15, rng), failed={3, 17}, error=ERROR)
    write_sweep(storage, one, created_at=now - 7_200, spec={"space": grids | log_space})
    seeds = make_sweep(
        name="cartpole-seeds", points=make_points(3, rng), seeds_per_point=4, pending={46, 47}, seed=5, with_best=False
    )
    # Its driver is gone: the lock is free.
    write_sweep(
        storage, seeds, created_at=now - 600, state="interrupted", ended_at=None, spec={"space": grids | log_space}
    )
    plain = make_sweep(name="pendulum-no-space", points=[{}], env_id="Pendulum-v1", seed=7, with_best=False)
    write_sweep(storage, plain, created_at=now - 90_000, spec={"space": {}})


def write_large(storage: Path, num_trials: int = 10_000) -> SweepStore:
    """Write a sweep of many trials, whose records are all there is of them."""
    rng = np.random.default_rng(4)
    made = make_sweep(name="large", points=make_points(5, rng), max_steps=5_000, with_best=False)
    store = SweepStore(storage / "large")
    store.create()
    for index in range(num_trials):
        known = made.trials[index % len(made.trials)]
        trial_id, score = f"t{index:04d}", float(rng.uniform(10, 200))
        checkpoints = [
            item.model_copy(update={"trial_id": trial_id, "evaluation_return": score}) for item in known.checkpoints[:1]
        ]
        changes = {
            "trial_id": trial_id, "index": index, "point_index": index, "seed": 1024 * index,
            "point": known.point | {"lr": float(10 ** rng.uniform(-6, -2))}, "checkpoints": tuple(checkpoints),
            "best_evaluation_return": score,
        }  # fmt: skip
        folder = store.folder / "trials" / trial_id
        folder.mkdir(parents=True)
        # Without the store's own care for a crash, which takes a minute for so many.
        (folder / "trial.json").write_text(known.model_copy(update=changes).model_dump_json())
    created = time.time() - 86_400
    store.write_record(made.sweep.model_copy(update={"name": "large", "num_trials": num_trials, "created_at": created}))
    return store
