"""What is said to be idle is: packs train the same whatever its value, and something else where no rule holds."""

import functools
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm, Hyperparams, TrainedHyperparams, make_hyperparams
from policies.idle.find import NO_UPDATE, RULES, Limits, idle_rule
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack

SMALL: dict[str, Any] = {
    "ppo": {
        "hidden_sizes": (4,), "num_envs": 4, "train_batch_size": 32, "minibatch_size": 16, "num_epochs": 2, "lr": 1e-2,
    },
    "dqn": {
        "hidden_sizes": (4,), "num_envs": 2, "env_steps_per_iteration": 40, "train_freq": 4, "learning_starts": 16,
        "train_batch_size": 8, "updates_per_env_step": 0.5, "replay_capacity": 60, "target_update_freq": 20,
        "epsilon_decay": 60, "lr": 1e-2,
    },
}  # fmt: skip
NUM_ITERATIONS = {"ppo": 3, "dqn": 3}
NUM_ENV_STEPS = {"ppo": 96, "dqn": 120}
MAX_EPISODE_STEPS = 8


@dataclass
class Case:
    """Of one rule."""

    values: tuple[Any, Any]
    """Two that train the same where the rule holds."""
    held: dict[str, Any] = field(default_factory=dict)
    """Other hyperparameters with which it holds."""
    free: dict[str, Any] = field(default_factory=dict)
    """Other hyperparameters with which it doesn't, and the two values train differently."""
    other: Any = None
    """For rules of the value: another one, for which it doesn't hold."""
    is_close: bool = False
    """The same but for rounding: the loss has a part whose gradient is 0 in theory."""
    num_iterations: int | None = None


def no_update(first: bool | float | str | None, second: bool | float | str, **free: Any) -> Case:
    return Case((first, second), {"learning_starts": 1000, **free}, {"learning_starts": 16, **free})


ONE_UPDATE = {"num_epochs": 1, "minibatch_size": 32}
SCHEDULE = {"lr_final": 1e-3}
ENTROPY = {"entropy_coeff": 0.0, "entropy_coeff_final": 1.0}
CLIP = {"clip_param": 0.001, "clip_param_final": 0.05}
KL = {"use_kl_loss": True}
MANY_UPDATES = {"num_epochs": 8, "lr": 5e-2}
RMSPROP, PRIORITIZED = {"optimizer": "rmsprop"}, {"replay": "prioritized"}
GEOMETRIC = {"epsilon_schedule": "geometric"}
FLAT = {"epsilon_initial": 0.5, "epsilon_final": 0.5}
NOT_FLAT = {"epsilon_initial": 0.9, "epsilon_final": 0.1}
LOW = {**GEOMETRIC, "epsilon_initial": 0.3, "epsilon_final": 0.5}
LATE = {"epsilon_start": 120, "epsilon_initial": 0.5}
NO_TARGET = {"target_network": False, "double_q": False}

# In the order of the rules.
CASES = {
    ("ppo", "lr"): [Case((1e-2, 5e-2), {**SCHEDULE, "lr_decay_steps": 32}, {**SCHEDULE, "lr_decay_steps": 200})],
    ("ppo", "lr_decay_steps"): [Case((50, 100), {"lr_final": 1e-2}, SCHEDULE), Case((10, 32), SCHEDULE, other=64)],
    ("ppo", "gae_lambda"): [Case((0.2, 0.9), {"gamma": 0.0}, {"gamma": 0.9})],
    ("ppo", "clip_param"): [
        Case((0.001, 0.5), ONE_UPDATE),
        Case((0.001, 0.5), {"clip_param_final": 0.2, "clip_decay_steps": 32},
             {"clip_param_final": 0.2, "clip_decay_steps": 200}),
    ],
    ("ppo", "clip_param_final"): [Case((0.001, 0.5), {**ONE_UPDATE, "clip_decay_steps": 50}, {"clip_decay_steps": 50})],
    ("ppo", "clip_decay_steps"): [
        Case((50, 100), {**ONE_UPDATE, **CLIP}, CLIP),
        Case((50, 100), {**CLIP, "clip_param_final": 0.001}, CLIP), Case((10, 32), CLIP, other=64),
    ],
    ("ppo", "vf_clip_param"): [Case((0.01, 5.0), {"vf_loss_coeff": 0.0}, {"vf_loss_coeff": 0.5})],
    ("ppo", "vf_clip_range"): [Case((0.001, 5.0), {"vf_loss_coeff": 0.0}, {"vf_loss_coeff": 0.5})],
    ("ppo", "entropy_coeff"): [
        Case((0.0, 0.7), {"entropy_coeff_final": 1.0, "entropy_decay_steps": 32},
             {"entropy_coeff_final": 1.0, "entropy_decay_steps": 200}),
    ],
    ("ppo", "entropy_decay_steps"): [
        Case((50, 100), {**ENTROPY, "entropy_coeff_final": 0.0}, ENTROPY), Case((10, 32), ENTROPY, other=64),
    ],
    ("ppo", "use_kl_loss"): [
        Case((False, True), {"kl_coeff": 0.0}, {"kl_coeff": 1.0}),
        Case((False, True), {**ONE_UPDATE, "kl_coeff": 1.0}, {**MANY_UPDATES, "kl_coeff": 1.0}, is_close=True),
    ],
    ("ppo", "kl_coeff"): [
        Case((0.2, 3.0), {}, KL),
        Case((0.2, 3.0), {**KL, **ONE_UPDATE}, {**KL, **MANY_UPDATES}, is_close=True),
    ],
    ("ppo", "kl_target"): [
        Case((1e-6, 9.0), {}, KL),
        Case((1e-6, 9.0), {**KL, "kl_coeff": 0.0}, KL),
        Case((1e-6, 9.0), {**KL, **ONE_UPDATE}, {**KL, **MANY_UPDATES}, is_close=True),
        Case((1e-6, 9.0), KL, KL, num_iterations=1),
    ],
    ("dqn", "lr"): [
        no_update(1e-3, 1e-2),
        Case((1e-3, 1e-2), {"lr_final": 5e-3, "lr_decay_steps": 16}, {"lr_final": 5e-3, "lr_decay_steps": 99}),
    ],
    ("dqn", "lr_final"): [no_update(1e-3, 5e-3, lr_decay_steps=50)],
    ("dqn", "lr_decay_steps"): [
        no_update(50, 100, **SCHEDULE),
        Case((50, 100), {"lr_final": 1e-2}, SCHEDULE),
        Case((3, 16), SCHEDULE, other=90),
    ],
    ("dqn", "gamma"): [no_update(0.5, 0.9)],
    ("dqn", "grad_clip"): [no_update(None, 1e-3)],
    ("dqn", "train_freq"): [Case((1, 2), other=4)],
    ("dqn", "double_q"): [no_update(False, True, lr=0.1), Case((False, True), {"gamma": 0.0}, {"lr": 0.1})],
    ("dqn", "n_step"): [no_update(1, 3), Case((8, 20), other=7)],
    ("dqn", "reward_scale"): [no_update(1.0, 0.1)],
    ("dqn", "td_loss"): [no_update("huber", "mse")],
    ("dqn", "optimizer"): [no_update("adam", "rmsprop")],
    ("dqn", "optimizer_epsilon"): [no_update(1e-8, 1e-2)],
    ("dqn", "adam_beta1"): [Case((0.1, 0.9), RMSPROP, {}), no_update(0.1, 0.9)],
    ("dqn", "adam_beta2"): [Case((0.5, 0.9), RMSPROP, {}), no_update(0.5, 0.9)],
    ("dqn", "rmsprop_rho"): [Case((0.5, 0.9), {}, RMSPROP), no_update(0.5, 0.9, **RMSPROP)],
    ("dqn", "rmsprop_momentum"): [Case((0.0, 0.9), {}, RMSPROP), no_update(0.0, 0.9, **RMSPROP)],
    ("dqn", "target_network"): [
        no_update(False, True, double_q=False),
        Case((False, True), {"gamma": 0.0, "double_q": False}, {"double_q": False}),
    ],
    ("dqn", "target_update_freq"): [
        Case((5, 40), NO_TARGET, {}),
        no_update(5, 40),
        Case((5, 40), {"gamma": 0.0}, {}),
        Case((121, 999), other=40),
        Case((1, 4), {"updates_per_env_step": 0.25}, other=9),
    ],
    ("dqn", "target_update_unit"): [
        Case(("env_step", "episode"), NO_TARGET, {"double_q": False}),
        no_update("env_step", "episode"),
        Case(("env_step", "episode"), {"gamma": 0.0}, {}),
        Case(("env_step", "episode"), {"target_update_freq": 121}, {"target_update_freq": 9}),
        Case(("env_step", "episode"), {"target_update_freq": None, "tau": 0.1}, {"target_update_freq": 9, "tau": 0.1}),
    ],
    ("dqn", "tau"): [
        no_update(0.1, 0.9),
        Case((0.1, 0.9), {"gamma": 0.0}, {}),
        Case((0.1, 0.9), {"target_update_freq": 121}, {"target_update_freq": 9}),
    ],
    ("dqn", "replay_capacity"): [
        no_update(30, 60),
        Case((30, 60), {"replay": "none"}, {"replay": "uniform"}),
        Case((120, 999), other=60),
    ],
    ("dqn", "prioritized_alpha"): [Case((0.1, 0.9), {}, PRIORITIZED), no_update(0.1, 0.9, **PRIORITIZED)],
    ("dqn", "prioritized_beta"): [
        Case((0.1, 0.9), {}, PRIORITIZED),
        no_update(0.1, 0.9, **PRIORITIZED),
        Case((0.1, 0.9), {**PRIORITIZED, "prioritized_alpha": 0.0}, PRIORITIZED),
    ],
    ("dqn", "prioritized_epsilon"): [
        Case((1e-6, 1.0), {}, PRIORITIZED),
        no_update(1e-6, 1.0, **PRIORITIZED),
        Case((1e-6, 1.0), {**PRIORITIZED, "prioritized_alpha": 0.0}, PRIORITIZED),
    ],
    ("dqn", "learning_starts"): [Case((121, 999), other=16), Case((0, 8), other=20)],
    ("dqn", "epsilon_schedule"): [
        Case(("linear", "exponential"), FLAT, NOT_FLAT),
        Case(("linear", "geometric"), LATE, NOT_FLAT),
    ],
    ("dqn", "epsilon_unit"): [
        Case(("env_step", "episode"), FLAT, NOT_FLAT),
        Case(("env_step", "episode"), LATE, {**LATE, "epsilon_start": 4}),
        Case(("env_step", "episode"), LOW, {**LOW, **NOT_FLAT}),
    ],
    ("dqn", "epsilon_initial"): [Case((0.1, 0.3), {**GEOMETRIC, "epsilon_final": 0.5}, other=1.0)],
    ("dqn", "epsilon_final"): [
        Case((0.0, 0.9), LATE, {**LATE, "epsilon_start": 4}),
        Case((0.0, 0.01), {**GEOMETRIC, "epsilon_decay": 90}, other=0.6),
    ],
    ("dqn", "epsilon_decay"): [
        Case((20, 90), FLAT, NOT_FLAT), Case((20, 90), LATE, {**LATE, "epsilon_start": 4}),
        Case((20, 90), LOW, {**LOW, **NOT_FLAT}),
    ],
    ("dqn", "epsilon_start"): [
        Case((0, 60), FLAT, NOT_FLAT), Case((0, 60), LOW, {**LOW, **NOT_FLAT}),
        Case((120, 999), other=10),
    ],
}  # fmt: skip
ALL = [
    pytest.param(algorithm, name, number, id=f"{algorithm}-{name}-{number}")
    for algorithm, table in RULES.items()
    for name, rules in table.items()
    for number in range(len(rules))
]


@functools.cache
def trained(
    algorithm: Algorithm, num_iterations: int, items: tuple[tuple[str, float | str | tuple[int]], ...]
) -> tuple[NDArray[np.float32], list[tuple[float, int]]]:
    """(online weights, episodes) of a trial in a pack."""
    torch.set_num_threads(1)
    hyperparams = cast("TrainedHyperparams", make_hyperparams(algorithm, dict(items)))
    env_args = {"max_episode_steps": MAX_EPISODE_STEPS}
    envs = make_packed_envs("CartPole-v1", env_args, hyperparams.num_envs, kind="vectorised")
    stack = make_stack(hyperparams, envs)
    stack.add(new_member("m", hyperparams, 3, envs.observation_space, envs.action_space), 3)
    episodes: list[Any] = []
    for _ in range(num_iterations):
        episodes += stack.train_iteration()["m"].episodes
    member = stack.member("m")
    assert member.num_env_steps == NUM_ENV_STEPS[algorithm] * num_iterations // NUM_ITERATIONS[algorithm]
    envs.close()
    weights = {name: value for name, value in member.weights.items() if not name.startswith("_target_")}
    return np.concatenate([weights[name].ravel() for name in sorted(weights)]), episodes


def largest_difference(algorithm: Algorithm, num_iterations: int, one: dict[str, Any], other: dict[str, Any]) -> float:
    """Of the weights, in learning rates; infinite where the episodes differ."""
    (weights, episodes), (weights2, episodes2) = (
        trained(algorithm, num_iterations, tuple(values.items())) for values in (one, other)
    )
    return float(np.abs(weights - weights2).max()) / SMALL[algorithm]["lr"] if episodes == episodes2 else np.inf


def limits_of(algorithm: Algorithm, num_iterations: int) -> Limits:
    num_env_steps = NUM_ENV_STEPS[algorithm] * num_iterations // NUM_ITERATIONS[algorithm]
    return Limits(num_env_steps, num_iterations, MAX_EPISODE_STEPS, is_packed=True)


@pytest.mark.parametrize(("algorithm", "name", "number"), ALL)
def test_what_is_said_to_be_idle_is(algorithm: Algorithm, name: str, number: int) -> None:
    rule, case = RULES[algorithm][name][number], CASES[algorithm, name][number]
    most = NUM_ITERATIONS[algorithm]
    num_iterations = case.num_iterations or most

    def holds(values: dict[str, Any], num_iterations: int) -> bool:
        return rule.holds(make_hyperparams(algorithm, values), limits_of(algorithm, num_iterations))

    base = SMALL[algorithm] | case.held
    first, second = ({**base, name: value} for value in case.values)
    assert holds(first, num_iterations)
    assert holds(second, num_iterations)
    same = largest_difference(algorithm, num_iterations, first, second)
    assert same < 0.01 if case.is_close else same == 0

    if rule.of_value:
        changed = {**base, name: case.other}
        assert not holds(changed, num_iterations)
        one, other = first, changed
    else:
        one, other = ({**SMALL[algorithm], **case.free, name: value} for value in case.values)
        assert not holds(one, most)
        assert not holds(other, most)
    differs = largest_difference(algorithm, most, one, other)
    assert differs > 0.1 if case.is_close else differs > 0


def test_every_hyperparameter_is_in_the_table() -> None:
    """Whoever adds one must say when it can't act, or that it always does."""
    assert {name: set(table) for name, table in RULES.items()} == {
        name: set(model.model_fields) for name, model in HYPERPARAMS_BY_ALGORITHM.items()
    }


def test_every_rule_has_a_case() -> None:
    assert {key: len(cases) for key, cases in CASES.items()} == {
        (algorithm, name): len(rules) for algorithm, table in RULES.items() for name, rules in table.items() if rules
    }


class Recorder:
    """Stands in for hyperparameters, and knows what was asked for."""

    def __init__(self, hyperparams: Hyperparams) -> None:
        self.hyperparams = hyperparams
        self.seen: set[str] = set()

    def __getattr__(self, name: str) -> float:
        self.seen |= {"target_update_freq", "tau"} if name == "target_update_interval" else {name}
        return cast("float", getattr(self.hyperparams, name))


@pytest.mark.parametrize(("algorithm", "name", "number"), ALL)
def test_rules_name_what_they_read(algorithm: Algorithm, name: str, number: int) -> None:
    rule, case = RULES[algorithm][name][number], CASES[algorithm, name][number]
    assert rule.of_value == (name in rule.reads)
    for values in (case.held, case.free or case.held):
        recorder = Recorder(make_hyperparams(algorithm, {**SMALL[algorithm], **values, name: case.values[0]}))
        rule.holds(recorder, limits_of(algorithm, NUM_ITERATIONS[algorithm]))
        assert recorder.seen <= set(rule.reads)


def test_rules_that_do_not_look_at_the_value_come_first() -> None:
    limits = limits_of("dqn", 3)
    values = {**SMALL["dqn"], "learning_starts": 1000, "replay_capacity": 5000}
    assert idle_rule("dqn", "replay_capacity", make_hyperparams("dqn", values), limits) is NO_UPDATE
    assert idle_rule("dqn", "hidden_sizes", make_hyperparams("dqn", values), limits) is None
