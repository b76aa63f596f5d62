"""The peer: Stable-Baselines3's PPO with the same settings, ten trials in each of two processes."""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from typing import Any


def run_trials(points: list[dict[str, Any]], num_env_steps: int, queue: Any) -> None:
    """Train these points one after the other in this process; puts the env steps of each into the queue."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import CheckpointCallback
    from stable_baselines3.common.env_util import make_vec_env

    from tests.benchmarks import workload

    torch.set_num_threads(1)
    activations = {"linear": torch.nn.Identity, "relu": torch.nn.ReLU}
    for seed, point in enumerate(points):
        env = make_vec_env(workload.ENV_ID, n_envs=workload.NUM_ENVS, seed=1000 * seed)
        model = PPO(
            "MlpPolicy",
            env,
            learning_rate=point["lr"],
            n_steps=workload.BATCH_SIZE // workload.NUM_ENVS,
            batch_size=workload.MINIBATCH_SIZE,
            n_epochs=workload.NUM_EPOCHS,
            gamma=workload.GAMMA,
            gae_lambda=workload.GAE_LAMBDA,
            policy_kwargs={"net_arch": [point["hidden_size"]], "activation_fn": activations[point["activation"]]},
            device="cpu",
            seed=seed,
        )
        every = workload.CHECKPOINT_EVERY * workload.BATCH_SIZE // workload.NUM_ENVS
        folder = tempfile.mkdtemp()
        model.learn(num_env_steps, callback=CheckpointCallback(every, folder))
        model.save(f"{folder}/last")
        queue.put(model.num_timesteps)


def main(num_env_steps: int) -> None:
    """Run the 20 trials in two processes."""
    from tests.benchmarks import workload

    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    points = workload.points()
    shares = [points[number :: workload.NUM_CPUS] for number in range(workload.NUM_CPUS)]
    processes = [context.Process(target=run_trials, args=(share, num_env_steps, queue)) for share in shares]
    for process in processes:
        process.start()
    steps = [queue.get() for _ in points]
    for process in processes:
        process.join()
    assert min(steps) >= num_env_steps, steps
    print(sum(steps))


if __name__ == "__main__":
    main(int(sys.argv[1]))
