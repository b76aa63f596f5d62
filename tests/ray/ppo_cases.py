"""The cases of PPO's hyperparameters; see `rllib_cases`."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rllib_cases import (
    MODULE,
    SMALL,
    Build,
    count_updates,
    env_steps,
    learner_of,
    linears,
    loss_config,
    module_of,
    reaches,
)
from torch import nn

from policies.hyperparams import PPOHyperparams


def ppo_loss(algo: Any, hyperparams: PPOHyperparams) -> tuple[float, float]:
    """(RLlib's loss, the loss by its definition) of one batch whose ratios and values are beyond every clip."""
    learner, module = learner_of(algo), module_of(algo)
    rng = torch.Generator().manual_seed(0)
    batch = {
        "obs": torch.randn(64, 4, generator=rng),
        "actions": torch.randint(2, (64,), generator=rng),
        "action_logp": -0.2 - torch.rand(64, generator=rng),
        "action_dist_inputs": torch.randn(64, 2, generator=rng),
        "advantages": torch.randn(64, generator=rng),
        "value_targets": 6 * torch.randn(64, generator=rng),
        "vf_preds": torch.randn(64, generator=rng),
    }
    with torch.no_grad():
        out = module.forward_train(batch)
        theirs = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=batch, fwd_out=out)
        now = torch.distributions.Categorical(logits=out["action_dist_inputs"])
        then = torch.distributions.Categorical(logits=batch["action_dist_inputs"])
        ratio = torch.exp(now.log_prob(batch["actions"]) - batch["action_logp"])  # type: ignore[no-untyped-call]
        clipped = torch.clamp(ratio, 1 - hyperparams.clip_param, 1 + hyperparams.clip_param)
        loss = -torch.min(batch["advantages"] * ratio, batch["advantages"] * clipped).mean()
        values, old = module.compute_values(batch), batch["vf_preds"]
        value_loss = (values - batch["value_targets"]) ** 2
        if hyperparams.vf_clip_range is not None:
            limited = torch.minimum(
                torch.maximum(values, old - hyperparams.vf_clip_range), old + hyperparams.vf_clip_range
            )
            value_loss = torch.maximum(value_loss, (limited - batch["value_targets"]) ** 2)
        if hyperparams.vf_clip_param is not None:
            value_loss = value_loss.clamp(0, hyperparams.vf_clip_param)
        entropy = now.entropy().mean()  # type: ignore[no-untyped-call]
        loss += hyperparams.vf_loss_coeff * value_loss.mean() - hyperparams.entropy_coeff * entropy
        if hyperparams.use_kl_loss:
            loss += hyperparams.kl_coeff * torch.distributions.kl_divergence(then, now).mean()
    return float(theirs), float(loss)


def check_loss(build: Build, **values: Any) -> None:
    """The loss is the one these values define, and not the one without them."""
    fixed = {key: value for key, value in values.items() if key == "use_kl_loss"} if len(values) > 1 else {}
    losses = []
    for changed in (fixed, values):
        hyperparams = PPOHyperparams(**{**SMALL["ppo"], **changed})
        theirs, ours = ppo_loss(build("ppo", **changed), hyperparams)
        assert theirs == pytest.approx(ours, rel=1e-4)
        losses.append(theirs)
    assert abs(losses[1] - losses[0]) > 1e-3


@reaches("ppo", field="clip_param")
def check_clip_param(build: Build, _: object) -> None:
    check_loss(build, clip_param=0.03)


def clip_of(algo: Any) -> float:
    """The clip of the loss: half the range of ratios in which it changes with them, by rows that gain by any ratio."""
    learner, module = learner_of(algo), module_of(algo)
    num = 400
    ratios = torch.linspace(1.0, 2.0, num)
    rows = {
        "obs": torch.zeros(num, 4),
        "actions": torch.zeros(num, dtype=torch.int64),
        "action_dist_inputs": torch.zeros(num, 2),
        "advantages": torch.ones(num),
    }
    limits = []
    with torch.no_grad():
        rows["value_targets"] = module.compute_values(rows)
        out = module.forward_train(rows)
        now = torch.distributions.Categorical(logits=out["action_dist_inputs"])
        rows["action_logp"] = now.log_prob(rows["actions"]) - torch.log(ratios)  # type: ignore[no-untyped-call]
        for place in range(num):
            row = {name: value[place : place + 1] for name, value in rows.items()}
            some = {name: value[place : place + 1] for name, value in out.items()}
            loss = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=row, fwd_out=some)
            limits.append(-float(loss) - 1.0)
    return max(limits)


def learnt_rewards(algo: Any) -> NDArray[np.float32]:
    """Train for an iteration and give the rewards of the episodes that the learner makes its batch of."""
    learner = learner_of(algo)
    found: list[NDArray[np.float32]] = []
    connector = learner._learner_connector

    def reading(*args: Any, episodes: Any, **kwargs: Any) -> Any:
        found.extend(np.array(episode.get_rewards()) for episode in episodes)
        return connector(*args, episodes=episodes, **kwargs)

    learner._learner_connector = reading
    algo.train()
    learner._learner_connector = connector
    return np.concatenate(found)


@reaches("ppo", field="normalize_rewards")
def check_normalize_rewards(build: Build, _: object) -> None:
    """CartPole's rewards are all 1; returns are reported as they are."""
    plain, algo = build("ppo", normalize_rewards=False), build("ppo", normalize_rewards=True)
    np.testing.assert_array_equal(learnt_rewards(plain), 1.0)
    for _iteration in range(2):
        rewards = learnt_rewards(algo)
        var = learner_of(algo).return_statistics.var
        np.testing.assert_array_equal(rewards, np.float32(1.0 / np.sqrt(var + 1e-8)))
        assert var > 4.0
    # RLlib's own metrics have raw rewards too.
    parts = [part for each in algo.env_runner._ongoing_episodes_for_metrics.values() for part in each]
    assert parts
    assert [part.get_return() for part in parts] == [float(len(part)) for part in parts]
    found = algo.train()["env_runners"]
    assert found["episode_return_mean"] == found["episode_len_mean"] > 1.0
    finished = algo.env_runner.pop_finished_episodes()
    assert finished
    assert [value for value, _ in finished] == [float(length) for _, length in finished]


@reaches("ppo", field="clip_param_final")
def check_clip_param_final(build: Build, _: object) -> None:
    check_schedule(build, clip_of, {"clip_param": 0.4, "clip_param_final": 0.1, "clip_decay_steps": 150})


@reaches("ppo", field="clip_decay_steps")
def check_clip_decay_steps(build: Build, _: object) -> None:
    check_schedule(build, clip_of, {"clip_param": 0.4, "clip_param_final": 0.0, "clip_decay_steps": 100})


@reaches("ppo", field="vf_clip_param")
def check_vf_clip_param(build: Build, _: object) -> None:
    check_loss(build, vf_clip_param=2.5)


@reaches("ppo", field="vf_clip_range")
def check_vf_clip_range(build: Build, _: object) -> None:
    check_loss(build, vf_clip_range=0.05)
    # Both: the limit of the error comes after.
    hyperparams = PPOHyperparams(**SMALL["ppo"], vf_clip_range=0.05, vf_clip_param=2.5)
    theirs, ours = ppo_loss(build("ppo", vf_clip_range=0.05, vf_clip_param=2.5), hyperparams)
    assert theirs == pytest.approx(ours, rel=1e-4)
    # The old values are those that the batch was made with, in all updates of the iteration.
    algo = build("ppo", vf_clip_range=0.05, num_epochs=3)
    learner, seen = learner_of(algo), []
    make, update = learner._make_batch_if_necessary, learner._update

    def making(*args: Any, **kwargs: Any) -> Any:
        made = make(*args, **kwargs)
        with torch.no_grad():
            made[MODULE]["expected"] = module_of(algo).compute_values(made[MODULE])
        return made

    def reading(batch: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append((batch[MODULE]["vf_preds"], batch[MODULE].pop("expected")))
        return update(batch, *args, **kwargs)

    learner._make_batch_if_necessary, learner._update = making, reading
    algo.train()
    assert len(seen) >= 6
    for old_values, expected in seen:
        torch.testing.assert_close(old_values, expected)


@reaches("ppo", field="vf_loss_coeff")
def check_vf_loss_coeff(build: Build, _: object) -> None:
    check_loss(build, vf_loss_coeff=0.2)


@reaches("ppo", field="entropy_coeff")
def check_entropy_coeff(build: Build, _: object) -> None:
    check_loss(build, entropy_coeff=0.3)


@reaches("ppo", field="use_kl_loss")
def check_use_kl_loss(build: Build, _: object) -> None:
    check_loss(build, use_kl_loss=True)


@reaches("ppo", field="kl_coeff")
def check_kl_coeff(build: Build, _: object) -> None:
    check_loss(build, use_kl_loss=True, kl_coeff=0.9)


@reaches("ppo", field="kl_target")
def check_kl_target(build: Build, _: object) -> None:
    for target, factor in ((0.01, 1.5), (0.03, 1.0), (0.2, 0.5)):
        algo = build("ppo", use_kl_loss=True, kl_coeff=0.4, kl_target=target)
        learner = learner_of(algo)
        learner._update_module_kl_coeff(module_id=MODULE, config=loss_config(algo), kl_loss=0.05)
        assert float(learner.curr_kl_coeffs_per_module[MODULE]) == pytest.approx(0.4 * factor)


@reaches("ppo", field="vf_share_layers")
def check_vf_share_layers(build: Build, _: object) -> None:
    names = {share: set(module_of(build("ppo", vf_share_layers=share)).state_dict()) for share in (False, True)}
    assert {name.split(".")[1] for name in names[False] if name.startswith("encoder")} == {
        "actor_encoder",
        "critic_encoder",
    }
    assert {name.split(".")[1] for name in names[True] if name.startswith("encoder")} == {"encoder"}


def learnt_batch(algo: Any, rewards: Sequence[float]) -> Any:
    """The batch of one terminated episode, from the learner's own pipeline, by a value function that says 1."""
    from ray.rllib.core.learner.training_data import TrainingData
    from ray.rllib.env.single_agent_episode import SingleAgentEpisode

    for layer in linears(module_of(algo).vf):
        nn.init.zeros_(layer.weight)
        nn.init.ones_(layer.bias)  # the value function says 1 everywhere
    length = len(rewards)
    episode = SingleAgentEpisode(
        observations=list(np.zeros((length + 1, 4), np.float32)),
        actions=[0] * length,
        rewards=list(rewards),
        terminated=True,
        extra_model_outputs={"action_logp": [0.0] * length, "action_dist_inputs": [np.zeros(2, np.float32)] * length},
        observation_space=algo.env_runner.env.single_observation_space,
        action_space=algo.env_runner.env.single_action_space,
        len_lookback_buffer=0,
    ).to_numpy()
    return learner_of(algo)._make_batch_if_necessary(TrainingData(episodes=[episode]))[MODULE]


def value_targets(algo: Any, rewards: Sequence[float]) -> NDArray[Any]:
    return np.asarray(learnt_batch(algo, rewards)["value_targets"])[: len(rewards)]


@reaches("ppo", field="normalize_advantages")
def check_normalize_advantages(build: Build, _: object) -> None:
    for normalizes in (True, False):
        batch = learnt_batch(build("ppo", normalize_advantages=normalizes), [1.0, 5.0, 2.0])
        expected = np.asarray(batch["value_targets"]) - 1.0
        if normalizes:
            # RLlib counts the row that it adds, for the value after the end, too.
            expected = (expected - expected.mean()) / expected.std()
        np.testing.assert_allclose(np.asarray(batch["advantages"]), expected, rtol=1e-5, atol=1e-6)


def expected_targets(rewards: Sequence[float], gamma: float, gae_lambda: float) -> list[float]:
    advantage = 0.0
    targets: list[float] = []
    for step in reversed(range(len(rewards))):
        following = 0.0 if step == len(rewards) - 1 else 1.0
        advantage = rewards[step] + gamma * following - 1.0 + gamma * gae_lambda * advantage
        targets.insert(0, advantage + 1.0)
    return targets


@reaches("ppo", field="gamma")
def check_ppo_gamma(build: Build, _: object) -> None:
    for gamma in (0.0, 0.6):
        found = value_targets(build("ppo", gamma=gamma), [1.0, 5.0, 2.0])
        np.testing.assert_allclose(found, expected_targets([1.0, 5.0, 2.0], gamma, 0.95), rtol=1e-5)


@reaches("ppo", field="gae_lambda")
def check_gae_lambda(build: Build, _: object) -> None:
    for gae_lambda in (0.0, 0.3):
        found = value_targets(build("ppo", gae_lambda=gae_lambda), [1.0, 5.0, 2.0])
        np.testing.assert_allclose(found, expected_targets([1.0, 5.0, 2.0], 0.99, gae_lambda), rtol=1e-5)


@reaches("ppo", field="train_batch_size")
def check_ppo_train_batch_size(build: Build, _: object) -> None:
    algo = build("ppo", train_batch_size=96)
    steps = [env_steps(algo.train()) for _ in range(3)]
    # All sub-environments step together, and one may only reset in the last step.
    assert [96 <= after - before < 98 for before, after in zip([0, *steps], steps, strict=False)] == [True] * 3


@reaches("ppo", field="minibatch_size")
def check_minibatch_size(build: Build, _: object) -> None:
    algo = build("ppo", minibatch_size=16)
    sizes = count_updates(algo)
    algo.train()
    assert set(sizes) == {16}


@reaches("ppo", field="num_epochs")
def check_num_epochs(build: Build, _: object) -> None:
    counts = {}
    for num_epochs in (1, 4):
        algo = build("ppo", num_epochs=num_epochs)
        sizes = count_updates(algo)
        algo.train()
        counts[num_epochs] = sum(sizes)
    # RLlib adds a row an episode chunk for the value after its end, and fills the last minibatch up.
    assert 64 <= counts[1] < 64 + 64
    assert 4 * 64 <= counts[4] < 4 * (64 + 32)
    assert counts[4] > 3 * counts[1] - 32


# -- schedules


def entropy_weight(algo: Any) -> float:
    """What the loss multiplies the entropy by: the loss of rows without anything else to gain."""
    learner, module = learner_of(algo), module_of(algo)
    rows = {
        "obs": torch.zeros(4, 4),
        "actions": torch.zeros(4, dtype=torch.int64),
        "action_logp": torch.zeros(4),
        "action_dist_inputs": torch.zeros(4, 2),
        # No advantage, and the value is the target: only the entropy is left.
        "advantages": torch.zeros(4),
    }
    with torch.no_grad():
        rows["value_targets"] = module.compute_values(rows)
        out = module.forward_train(rows)
        loss = learner.compute_loss_for_module(module_id=MODULE, config=loss_config(algo), batch=rows, fwd_out=out)
        found = torch.distributions.Categorical(logits=out["action_dist_inputs"])
        entropy = found.entropy().mean()  # type: ignore[no-untyped-call]
    return float(-loss / entropy)


def in_first_updates(algo: Any, read: Callable[[], float]) -> list[tuple[int, float]]:
    """(env steps, what `read` gives in the phase's first update), for three iterations."""
    learner = learner_of(algo)
    update, seen = learner._update, []

    def reading(batch: Any, *args: Any, **kwargs: Any) -> Any:
        seen.append(read())
        return update(batch, *args, **kwargs)

    learner._update = reading
    found = []
    for _ in range(3):
        seen.clear()
        found.append((env_steps(algo.train()), seen[0]))
        assert seen[-1] == pytest.approx(seen[0], rel=1e-4)
    return found


def check_schedule(build: Build, read: Callable[[Any], float], values: dict[str, float]) -> None:
    """A value moves from the first update on, along the line that the three hyperparameters draw, and then stays."""
    first, final, decay_steps = values.values()
    algo = build("ppo", **values)
    for num_env_steps, value in in_first_updates(algo, lambda: read(algo)):
        share = min(1.0, num_env_steps / decay_steps)
        assert value == pytest.approx(first + share * (final - first), rel=1e-4, abs=1e-9)
    assert share == 1.0


def current_lr(algo: Any) -> float:
    (group,) = learner_of(algo).get_optimizer(MODULE).param_groups
    return float(group["lr"])


@reaches("ppo", field="lr_final")
def check_lr_final(build: Build, _: object) -> None:
    check_schedule(build, current_lr, {"lr": 4e-3, "lr_final": 1e-3, "lr_decay_steps": 150})


@reaches("ppo", field="lr_decay_steps")
def check_lr_decay_steps(build: Build, _: object) -> None:
    check_schedule(build, current_lr, {"lr": 4e-3, "lr_final": 0.0, "lr_decay_steps": 100})


@reaches("ppo", field="entropy_coeff_final")
def check_entropy_coeff_final(build: Build, _: object) -> None:
    check_schedule(
        build, entropy_weight, {"entropy_coeff": 0.2, "entropy_coeff_final": 0.05, "entropy_decay_steps": 150}
    )


@reaches("ppo", field="entropy_decay_steps")
def check_entropy_decay_steps(build: Build, _: object) -> None:
    check_schedule(
        build, entropy_weight, {"entropy_coeff": 0.2, "entropy_coeff_final": 0.0, "entropy_decay_steps": 100}
    )
