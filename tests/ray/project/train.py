"""A user's script beside folders called `policies` and `analysis`: one launch for each engine that is named."""

import sys

import analysis.rewards
import ray
from policies.walk import Walk

import tune_jobs

SPEC = {
    "env": Walk,
    "algorithm": "ppo",
    "seed": 1,
    "hyperparams": {"hidden_sizes": [4], "train_batch_size": 64, "minibatch_size": 32, "num_envs": 2},
    "space": {"lr": {"grid": [0.001, 0.01]}},
    "stop": {"num_env_steps": 128},
    "evaluation": {"num_episodes": 2},
}

if __name__ == "__main__":
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="error")
    for engine in sys.argv[1:]:
        # In processes of their own too.
        resources = {"num_env_runners": 1} if engine == "rllib" else {}
        # The first is finished by its launch, the others are by the calls that do the same.
        is_first = engine == sys.argv[1]
        spec = {**SPEC, "engine": engine, "resources": resources}
        tune_jobs.launch(spec, name=engine, progress="none", finish=is_first)
        if not is_first:
            tune_jobs.report(engine)
            tune_jobs.video(engine)
        print(engine, *(trial.status for trial in tune_jobs.trials(engine)), analysis.rewards.reward_of(1))
