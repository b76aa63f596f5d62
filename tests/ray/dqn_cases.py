"""The cases of DQN's hyperparameters; see `rllib_cases`."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rllib_cases import (
    Build,
    count_updates,
    env_steps,
    learner_of,
    module_of,
    optimizer_of,
    reaches,
    sampled_rows,
)

from policies.replay import ReplayBuffer, Transitions


def column(rows: Sequence[Transitions], name: str) -> NDArray[Any]:
    return np.concatenate([getattr(batch, name) for batch in rows])


@reaches("dqn", field="lr_final")
@reaches("dqn", field="lr_decay_steps")
def check_lr_schedule(build: Build, _: object) -> None:
    algo = build("dqn", lr=1e-2, lr_final=2e-3, lr_decay_steps=40)
    found = []
    for _ in range(3):
        algo.train()
        found += [group["lr"] for group in optimizer_of(algo).param_groups]
    assert found == pytest.approx([6e-3, 2e-3, 2e-3])


@reaches("dqn", field="grad_clip")
def check_grad_clip(build: Build, _: object) -> None:
    norms = {}
    for clip in (None, 1e-3):
        algo = build("dqn", grad_clip=clip)
        optimizer = optimizer_of(algo)
        step: Callable[..., Any] = optimizer.step
        seen: list[float] = []

        def spied(
            *args: Any, optimizer: Any = optimizer, seen: list[float] = seen, step: Callable[..., Any] = step
        ) -> Any:
            params = optimizer.param_groups[0]["params"]
            seen.append(float(torch.sqrt(sum((param.grad**2).sum() for param in params))))
            return step(*args)

        optimizer.step = spied  # type: ignore[method-assign, assignment]
        algo.train()
        norms[clip] = max(seen)
    assert norms[None] > 1e-2
    assert norms[1e-3] == pytest.approx(1e-3, rel=1e-2)


@reaches("dqn", field="gamma")
def check_dqn_gamma(build: Build, _: object) -> None:
    rows = sampled_rows(build("dqn", gamma=0.5, n_step=3), 3)
    rewards, discounts = column(rows, "rewards"), column(rows, "discounts")
    # CartPole gives 1 a step: three steps of it, discounted; fewer at the end of an episode.
    assert set(np.round(rewards, 6)) == {1.0, 1.5, 1.75}
    assert set(discounts) == {0.0, 0.125}
    assert np.all(discounts[rewards < 1.75] == 0)


@reaches("dqn", field="n_step")
def check_n_step(build: Build, _: object) -> None:
    rows = sampled_rows(build("dqn", gamma=1.0, n_step=4), 3)
    rewards = column(rows, "rewards")
    assert max(rewards) == np.median(rewards) == 4.0
    # Observations that count the steps of an episode, which is cut off after 7: the last are bootstrapped from there.
    rows = sampled_rows(build("dqn", "TestTicks-v0", gamma=1.0, n_step=4), 3)
    observations, following = column(rows, "obs"), column(rows, "next_obs")
    steps = observations[:, 0]
    assert set(steps) == set(range(7))
    np.testing.assert_array_equal(following[:, 0], np.minimum(steps + 4, 7))
    np.testing.assert_array_equal(following[:, 1:], observations[:, 1:])  # of the same episode
    assert np.all(column(rows, "discounts") == 1.0)


def target_of(
    algo: Any, *, next_online: list[float], next_target: list[float], q: float = 0.0, reward: float = 0.0
) -> tuple[float, float]:
    """(loss, |TD error|) for a reward, discount 1 and these Q-values of the next state."""
    batch = {
        "actions": torch.zeros(2, dtype=torch.long),
        "rewards": torch.full((2,), reward),
        "discounts": torch.ones(2),
    }
    out = {
        "qf_preds": torch.full((2, 2), q),
        "qf_next_preds": torch.tensor([next_online] * 2),
        "qf_target_next_preds": torch.tensor([next_target] * 2),
    }
    loss, errors, _ = learner_of(algo).loss(batch, out)
    return float(loss), float(errors[0])


@reaches("dqn", field="double_q")
def check_double_q(build: Build, _: object) -> None:
    for double_q, expected in ((True, 2.0), (False, 6.0)):
        algo = build("dqn", double_q=double_q)
        # The online network prefers action 0, the target network action 1.
        assert target_of(algo, next_online=[1.0, 0.0], next_target=[2.0, 6.0])[1] == pytest.approx(expected)


@reaches("dqn", field="reward_scale")
def check_reward_scale(build: Build, _: object) -> None:
    for scale, expected in ((1.0, 4.0 + 6.0), (0.1, 0.4 + 6.0)):
        algo = build("dqn", reward_scale=scale, double_q=False)
        assert target_of(algo, next_online=[1.0, 0.0], next_target=[2.0, 6.0], reward=4.0)[1] == pytest.approx(expected)


@reaches("dqn", field="td_loss")
def check_td_loss(build: Build, _: object) -> None:
    for loss, expected in (("huber", 2.5), ("mse", 9.0)):
        algo = build("dqn", td_loss=loss)
        assert target_of(algo, next_online=[1.0, 0.0], next_target=[3.0, 0.0])[0] == pytest.approx(expected)


@reaches("dqn", field="dueling")
def check_dueling(build: Build, _: object) -> None:
    obs = torch.randn(5, 4)
    for dueling in (True, False):
        module = module_of(build("dqn", dueling=dueling))
        assert any(name.startswith("vf.") for name in module.state_dict()) == dueling
        encoded = module.encoder(obs)
        raw = module.af(encoded)
        if dueling:
            raw = module.vf(encoded) + raw - raw.mean(dim=1, keepdim=True)
        torch.testing.assert_close(module.compute_q_values({"obs": obs})["qf_preds"], raw)


@reaches("dqn", field="train_batch_size")
def check_dqn_train_batch_size(build: Build, _: object) -> None:
    rows = sampled_rows(build("dqn", train_batch_size=13))
    assert {len(batch.obs) for batch in rows} == {13}


@reaches("dqn", field="env_steps_per_iteration")
def check_env_steps_per_iteration(build: Build, _: object) -> None:
    algo = build("dqn", env_steps_per_iteration=37)
    assert [env_steps(algo.train()) for _ in range(2)] == [37, 74]


@reaches("dqn", field="train_freq")
def check_train_freq(build: Build, _: object) -> None:
    algo = build("dqn", train_freq=5, train_batch_size=1)
    phases, update = [], learner_of(algo).update_from_replay

    def spied(replay: ReplayBuffer, num_updates: int, **counts: int) -> Any:
        phases.append((num_updates, counts["num_env_steps"]))
        return update(replay, num_updates, **counts)

    learner_of(algo).update_from_replay = spied
    algo.train()
    assert phases == [(5, 5), (5, 10), (5, 15), (5, 20)]


@reaches("dqn", field="updates_per_env_step")
def check_updates_per_env_step(build: Build, _: object) -> None:
    # (updates a step, sub-environments): updates for 48 env steps
    for rate, num_envs, expected in ((1.0, 1, 48), (1.0, 4, 48), (0.25, 1, 12), (0.3, 4, 14), (3.0, 2, 144)):
        algo = build(
            "dqn", updates_per_env_step=rate, env_steps_per_iteration=48, num_envs=num_envs, train_batch_size=1
        )
        sizes = count_updates(algo)
        steps = env_steps(algo.train())
        assert abs(len(sizes) - expected * steps / 48) < 1 + rate, (rate, num_envs, len(sizes), steps)


@reaches("dqn", field="optimizer")
def check_optimizer(build: Build, _: object) -> None:
    for name, kind in (("adam", torch.optim.Adam), ("rmsprop", torch.optim.RMSprop)):
        algo = build("dqn", optimizer=name)
        assert type(optimizer_of(algo)) is kind
        before = module_of(algo).af.weight.detach().clone()
        algo.train()
        assert not torch.equal(before, module_of(algo).af.weight)


def check_optimizer_argument(
    build: Build, field: str, value: float, *, key: str, optimizer: str, expected: tuple[float, float] | None = None
) -> None:
    algo = build("dqn", optimizer=optimizer, **{field: value})
    algo.train()
    assert [group[key] for group in optimizer_of(algo).param_groups] == [value if expected is None else expected]


@reaches("dqn", field="optimizer_epsilon")
def check_optimizer_epsilon(build: Build, _: object) -> None:
    for optimizer in ("adam", "rmsprop"):
        check_optimizer_argument(build, "optimizer_epsilon", 1e-4, key="eps", optimizer=optimizer)


@reaches("dqn", field="adam_beta1")
def check_adam_beta1(build: Build, _: object) -> None:
    check_optimizer_argument(build, "adam_beta1", 0.5, key="betas", optimizer="adam", expected=(0.5, 0.999))


@reaches("dqn", field="adam_beta2")
def check_adam_beta2(build: Build, _: object) -> None:
    check_optimizer_argument(build, "adam_beta2", 0.5, key="betas", optimizer="adam", expected=(0.9, 0.5))


@reaches("dqn", field="rmsprop_rho")
def check_rmsprop_rho(build: Build, _: object) -> None:
    check_optimizer_argument(build, "rmsprop_rho", 0.5, key="alpha", optimizer="rmsprop")


@reaches("dqn", field="rmsprop_momentum")
def check_rmsprop_momentum(build: Build, _: object) -> None:
    check_optimizer_argument(build, "rmsprop_momentum", 0.5, key="momentum", optimizer="rmsprop")


def next_values(algo: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """(online, target) Q-values of the same next observations, after the online weights moved."""
    module = module_of(algo)
    with torch.no_grad():
        module.af.weight[0] += 1.0  # of one action: dueling heads take out what all have in common
    obs = torch.ones(3, 4)
    out = module._forward_train({"obs": obs, "new_obs": obs})
    return out["qf_preds"].detach(), out["qf_target_next_preds"]


@reaches("dqn", field="target_network")
def check_target_network(build: Build, _: object) -> None:
    online, target = next_values(build("dqn", target_network=True, double_q=False))
    assert not torch.allclose(online, target)
    algo = build("dqn", target_network=False, double_q=False)
    online, target = next_values(algo)
    torch.testing.assert_close(online, target)
    assert not target.requires_grad
    assert not any("target" in name for name in module_of(algo).state_dict())
    algo.train()
    assert learner_of(algo).num_target_updates == 0


def target_updates(algo: Any, num_iterations: int) -> list[int]:
    """How often the target network really changed, iteration by iteration."""
    learner, counts = learner_of(algo), []
    update, target = learner.update_target, module_of(algo)._target_af.weight
    changes = []

    def spied() -> None:
        before = target.clone()
        update()
        changes.append(not torch.equal(before, target))

    learner.update_target = spied
    for _ in range(num_iterations):
        algo.train()
        counts.append(sum(changes))
    return counts


@reaches("dqn", field="target_update_freq")
def check_target_update_freq(build: Build, _: object) -> None:
    # At 7, 14, 21, 28, 35, ... env steps.
    assert target_updates(build("dqn", target_update_freq=7, train_batch_size=1), 3) == [2, 5, 8]
    # The updates of a training phase are spread over the env steps before it.
    assert target_updates(build("dqn", target_update_freq=5, train_freq=20, train_batch_size=1), 2) == [4, 8]
    # Null: every 500 env steps if hard, every update if soft.
    assert target_updates(build("dqn", env_steps_per_iteration=499, train_batch_size=1), 2) == [0, 1]
    assert target_updates(build("dqn", tau=0.1, train_batch_size=1), 2) == [20, 40]


@reaches("dqn", field="target_update_unit")
def check_target_update_unit(build: Build, _: object) -> None:
    algo = build("dqn", target_update_freq=2, target_update_unit="episode", env_steps_per_iteration=150)
    counts = target_updates(algo, 2)
    assert counts[-1] == algo.num_episodes // 2
    assert counts[-1] > 2


@reaches("dqn", field="tau")
def check_tau(build: Build, _: object) -> None:
    for tau in (0.25, 1.0):
        algo = build("dqn", tau=tau)
        module = module_of(algo)
        online, target = module.af.weight, module._target_af.weight
        with torch.no_grad():
            online += 1.0
        before = target.clone()
        learner_of(algo).update_target()
        torch.testing.assert_close(target, tau * online + (1 - tau) * before)
        assert not torch.equal(before, target)


@reaches("dqn", field="learning_starts")
def check_learning_starts(build: Build, _: object) -> None:
    algo = build("dqn", learning_starts=50)
    sizes = count_updates(algo)
    counts = []
    for _ in range(4):
        algo.train()
        counts.append(len(sizes))
    assert counts == [0, 0, 11, 31]


def epsilons(build: Build, num_iterations: int, **values: Any) -> tuple[Any, list[tuple[int, float]]]:
    """(t, epsilon) of each step that the env runner explored."""
    algo = build("dqn", **values)
    module = algo.env_runner.module
    explore, used = module._forward_exploration, []

    def spied(batch: dict[str, torch.Tensor], t: int) -> Any:
        used.append((t, module.exploration_schedule.at(t)))
        return explore(batch, t=t)

    module._forward_exploration = spied
    for _ in range(num_iterations):
        algo.train()
    return algo, used


@reaches("dqn", field="epsilon_initial")
@reaches("dqn", field="epsilon_final")
@reaches("dqn", field="epsilon_decay")
def check_epsilon(build: Build, _: object) -> None:
    _, used = epsilons(build, 3, epsilon_initial=0.8, epsilon_final=0.2, epsilon_decay=30)
    # As a mapping: a vector env's step that only resets is no env step, and acts with the epsilon of the next one.
    assert dict(used) == {t: pytest.approx(max(0.2, 0.8 - 0.02 * t)) for t in range(60)}


@reaches("dqn", field="epsilon_start")
def check_epsilon_start(build: Build, _: object) -> None:
    _, used = epsilons(build, 2, epsilon_initial=1.0, epsilon_final=0.0, epsilon_decay=10, epsilon_start=15)
    assert dict(used) == {t: pytest.approx(min(1.0, max(0.0, 2.5 - 0.1 * t))) for t in range(40)}


@reaches("dqn", field="epsilon_schedule")
def check_epsilon_schedule(build: Build, _: object) -> None:
    values = {"epsilon_initial": 0.9, "epsilon_final": 0.1, "epsilon_decay": 10}
    _, used = epsilons(build, 2, epsilon_schedule="exponential", **values)
    assert dict(used) == {t: pytest.approx(0.1 + 0.8 * math.exp(-t / 10)) for t in range(40)}
    _, used = epsilons(build, 2, epsilon_schedule="geometric", **values)
    assert dict(used) == {t: pytest.approx(max(0.1, 0.9 * math.exp(-t / 10))) for t in range(40)}


@reaches("dqn", field="epsilon_unit")
def check_epsilon_unit(build: Build, _: object) -> None:
    # Episodes that end within a training phase count at once.
    algo, used = epsilons(build, 2, epsilon_unit="episode", env_steps_per_iteration=150, train_freq=75)
    episodes = [t for t, _ in used]
    assert episodes == sorted(episodes)
    assert set(range(algo.num_episodes)) <= set(episodes) <= set(range(algo.num_episodes + 1))
    assert algo.num_episodes > 5
