"""A sweep from Python: launch it, look at its trials, and let the best policy act."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import gymnasium

import tune_jobs

SWEEP = {
    "env": "CartPole-v1",
    "algorithm": "ppo",
    "space": {"lr": {"loguniform": [1e-4, 1e-2]}, "activation": {"grid": ["tanh", "relu"]}},
    "num_samples": 2,
    "stop": {"evaluation_return": 475, "num_env_steps": 50_000},
}


def main(storage: str | Path = "sweeps", overrides: Sequence[str] = ()) -> float:
    """Run the sweep and one episode of its best policy; returns what the episode gave."""
    result = tune_jobs.launch(SWEEP, name="from-python", storage=storage, overrides=overrides)
    trials = tune_jobs.dataframe(result.folder)  # pandas, one row a trial
    print(trials[["trial_id", "lr", "activation", "status", "score"]].to_string(index=False))

    policy = tune_jobs.load_policy(result.folder / "best")  # no Ray, no torch
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(policy.act(observation))
        total, done = total + float(reward), terminated or truncated
    env.close()  # type: ignore[no-untyped-call]
    print(f"one episode of the best policy: {total:g}")
    return total


# Ray's processes import this file, too, and must not launch the sweep again.
if __name__ == "__main__":
    main()
