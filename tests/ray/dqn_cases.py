"""The cases of DQN's hyperparameters; see `rllib_cases`."""

import numpy as np
import pytest
import torch
from rllib_cases import (
    MODULE,
    count_updates,
    env_steps,
    learner_of,
    loss_config,
    module_of,
    optimizer_of,
    reaches,
)


def sampled_batches(algo, num_iterations=1):
    """What the loss was computed from, update by update."""
    batches = []
    learner = learner_of(algo)
    update = learner._update

    def spied(batch, *args, **kwargs):
        batches.append({key: value.numpy().copy() for key, value in batch[MODULE].items()})
        return update(batch, *args, **kwargs)

    learner._update = spied
    for _ in range(num_iterations):
        algo.train()
    return batches


@reaches("dqn", field="gamma")
def check_dqn_gamma(build, _):
    algo = build("dqn", gamma=0.5, n_step=3)
    rewards = np.concatenate([batch["rewards"] for batch in sampled_batches(algo, 3)])
    # CartPole gives 1 a step: three steps of it, discounted; fewer at the end of what was sampled.
    assert set(np.round(rewards, 6)) == {1.0, 1.5, 1.75}
    assert np.mean(rewards == 1.75) > 0.5
    assert q_target(algo, next_online=[0.0, 1.0], next_target=[3.0, 2.0], n_step=2) == pytest.approx(0.5**2 * 2.0)


@reaches("dqn", field="n_step")
def check_n_step(build, _):
    batches = sampled_batches(build("dqn", gamma=1.0, n_step=4), 3)
    assert set(np.concatenate([batch["n_step"] for batch in batches])) == {4}
    rewards = np.concatenate([batch["rewards"] for batch in batches])
    assert max(rewards) == np.median(rewards) == 4.0


def q_target(algo, *, next_online, next_target, n_step=1):
    """What Q(s, a) = 0 is moved to for reward 0, given the next state's Q-values; from the Huber loss beyond 1."""
    learner = learner_of(algo)
    batch = {
        "actions": torch.zeros(2, dtype=torch.long),
        "rewards": torch.zeros(2),
        "terminateds": torch.zeros(2),
        "n_step": torch.full((2,), float(n_step)),
        "weights": torch.ones(2),
    }
    out = {
        "qf_preds": torch.zeros(2, 2),
        "qf_next_preds": torch.tensor([next_online] * 2),
        "qf_target_next_preds": torch.tensor([next_target] * 2),
    }
    loss = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=batch, fwd_out=out)
    loss = float(loss)
    return (2 * loss) ** 0.5 if loss < 0.5 else loss + 0.5


@reaches("dqn", field="double_q")
def check_double_q(build, _):
    for double_q, expected in ((True, 2.0), (False, 6.0)):
        algo = build("dqn", double_q=double_q, gamma=1.0)
        # The online network prefers action 0, the target network action 1.
        assert q_target(algo, next_online=[1.0, 0.0], next_target=[2.0, 6.0]) == pytest.approx(expected)


@reaches("dqn", field="dueling")
def check_dueling(build, _):
    obs = torch.randn(5, 4)
    for dueling in (True, False):
        module = module_of(build("dqn", dueling=dueling))
        assert any(name.startswith("vf.") for name in module.state_dict()) == dueling
        raw = module.af(module.encoder({"obs": obs})["encoder_out"])
        q_values = module.compute_q_values({"obs": obs})["qf_preds"]
        if dueling:
            value = module.vf(module.encoder({"obs": obs})["encoder_out"])
            raw = value + raw - raw.mean(dim=1, keepdim=True)
        torch.testing.assert_close(q_values, raw)


@reaches("dqn", field="train_batch_size")
def check_dqn_train_batch_size(build, _):
    batches = sampled_batches(build("dqn", train_batch_size=13))
    assert {len(batch["obs"]) for batch in batches} == {13}


@reaches("dqn", field="env_steps_per_iteration")
def check_env_steps_per_iteration(build, _):
    algo = build("dqn", env_steps_per_iteration=37)
    assert [env_steps(algo.train()) for _ in range(2)] == [37, 74]


@reaches("dqn", field="training_intensity")
def check_training_intensity(build, _):
    # (intensity, sub-environments): updates for 48 env steps, 8 transitions an update
    for intensity, num_envs, expected in ((None, 1, 48), (None, 4, 12), (2.0, 1, 12), (16.0, 4, 96)):
        algo = build("dqn", training_intensity=intensity, env_steps_per_iteration=48, num_envs=num_envs)
        sizes = count_updates(algo)
        steps = env_steps(algo.train())
        assert abs(len(sizes) - expected * steps / 48) <= 1 + 0.1 * expected, (intensity, num_envs, len(sizes), steps)


@reaches("dqn", field="adam_epsilon")
def check_adam_epsilon(build, _):
    algo = build("dqn", adam_epsilon=1e-4)
    assert [group["eps"] for group in optimizer_of(algo).param_groups] == [1e-4]


def target_update(algo, num_env_steps):
    """(online, target before, target after) of one weight, when an update ends at so many env steps."""
    module = module_of(algo)
    online, target = module.af.net.mlp[0].weight, module._target_af.net.mlp[0].weight
    with torch.no_grad():
        online += 1.0
    before = target.clone()
    learner_of(algo).after_gradient_based_update(timesteps={"num_env_steps_sampled_lifetime": num_env_steps})
    return online, before, target


@reaches("dqn", field="target_network_update_freq")
def check_target_network_update_freq(build, _):
    algo = build("dqn", target_network_update_freq=70)
    changed = {}
    for num_env_steps in (60, 69, 70, 100, 139, 140):
        _, before, after = target_update(algo, num_env_steps)
        changed[num_env_steps] = not torch.equal(before, after)
    assert changed == {60: False, 69: False, 70: True, 100: False, 139: False, 140: True}


@reaches("dqn", field="tau")
def check_tau(build, _):
    for tau in (0.25, 1.0):
        online, before, after = target_update(build("dqn", tau=tau, target_network_update_freq=1), 10)
        torch.testing.assert_close(after, tau * online + (1 - tau) * before)
        assert not torch.equal(before, after)


@reaches("dqn", field="replay_capacity")
def check_replay_capacity(build, _):
    algo = build("dqn", replay_capacity=60, env_steps_per_iteration=400)
    assert algo.local_replay_buffer.capacity == 60
    algo.train()
    # It drops whole episodes and never the one being added to, so it may be over by one.
    assert algo.local_replay_buffer.get_num_timesteps() < 400 / 2


@reaches("dqn", field="learning_starts")
def check_learning_starts(build, _):
    algo = build("dqn", learning_starts=50)
    sizes = count_updates(algo)
    counts = []
    for _ in range(4):
        algo.train()
        counts.append(len(sizes))
    assert counts == [0, 0, 11, 31]


@reaches("dqn", field="prioritized_replay")
def check_prioritized_replay(build, _):
    from ray.rllib.utils.replay_buffers import EpisodeReplayBuffer, PrioritizedEpisodeReplayBuffer

    for prioritized, kind in ((False, EpisodeReplayBuffer), (True, PrioritizedEpisodeReplayBuffer)):
        algo = build("dqn", prioritized_replay=prioritized)
        assert type(algo.local_replay_buffer) is kind
        batches = sampled_batches(algo, 2)
        weights = np.concatenate([batch["weights"] for batch in batches]) if "weights" in batches[0] else np.ones(1)
        assert bool(np.ptp(weights)) == prioritized


def epsilon_at(algo, num_env_steps):
    schedule = algo.env_runner.module.epsilon_schedule
    schedule.update(num_env_steps)
    return float(schedule.get_current_value())


@reaches("dqn", field="epsilon_initial")
def check_epsilon_initial(build, _):
    assert epsilon_at(build("dqn", epsilon_initial=0.7), 0) == pytest.approx(0.7)


@reaches("dqn", field="epsilon_final")
def check_epsilon_final(build, _):
    algo = build("dqn", epsilon_final=0.2)
    assert [epsilon_at(algo, steps) for steps in (10_000, 50_000)] == pytest.approx([0.2, 0.2])


@reaches("dqn", field="epsilon_decay_steps")
def check_epsilon_decay_steps(build, _):
    algo = build("dqn", epsilon_initial=0.9, epsilon_final=0.1, epsilon_decay_steps=80)
    assert epsilon_at(algo, 40) == pytest.approx(0.5)
    # And it moves on with the env steps of the trial, from one iteration to the next.
    seen = []
    for _ in range(3):
        algo.train()
        seen.append(float(algo.env_runner.module.epsilon_schedule.get_current_value()))
    assert seen == pytest.approx([0.9 - 0.01 * steps for steps in (19, 39, 59)], abs=0.011)
