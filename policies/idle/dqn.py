"""Rules for when hyperparameters of DQN are idle; see `policies.idle.find`."""

from __future__ import annotations

import math

from policies.hyperparams import DQNHyperparams
from policies.idle.rule import ALWAYS, Limits, Rule, Rules, equal_ends

_LIMITS = ("env_steps_per_iteration", "train_freq", "num_envs")
"""The hyperparameters that the env steps of a trial depend on, since a trial ends with a whole iteration."""


def _first_update(h: DQNHyperparams) -> int:
    """Return a number of env steps before which no update is made; the first update may come later."""
    return max(h.learning_starts, h.train_batch_size)


def _makes_no_update(h: DQNHyperparams, limits: Limits) -> bool:
    due = math.floor(h.updates_per_env_step * limits.num_env_steps + 1e-9)
    return _first_update(h) > limits.num_env_steps or due < 1


def _why_no_update(h: DQNHyperparams, limits: Limits) -> str:
    steps = f"the env steps of a trial (at most {limits.num_env_steps:,})"
    if h.learning_starts > limits.num_env_steps:
        return f"no update is made, as learning_starts {h.learning_starts:,} is more than {steps}"
    if h.train_batch_size > limits.num_env_steps:
        return f"no update is made, as train_batch_size {h.train_batch_size:,} is more than {steps}"
    return f"no update is made, as updates_per_env_step {h.updates_per_env_step:g} gives less than one in {steps}"


NO_UPDATE = Rule(
    "no update is made",
    _makes_no_update,
    ("learning_starts", "train_batch_size", "updates_per_env_step", *_LIMITS),
    words=_why_no_update,
)
"""The rule that a trial makes no update, so that hyperparameters of learning do nothing."""
_NO_GAMMA = Rule("gamma is 0, and no value is bootstrapped from", lambda h, _: h.gamma == 0.0, ("gamma",))
_NO_ADAM = Rule("optimizer is rmsprop", lambda h, _: h.optimizer != "adam", ("optimizer",))
_NO_RMSPROP = Rule("optimizer is adam", lambda h, _: h.optimizer != "rmsprop", ("optimizer",))
_NO_TARGET = Rule("target_network is false", lambda h, _: not h.target_network, ("target_network",))
_NO_PRIORITIES = Rule("replay is not prioritized", lambda h, _: h.replay != "prioritized", ("replay",))
_EQUAL_PRIORITIES = Rule(
    "prioritized_alpha is 0, and all priorities are equal",
    lambda h, _: h.prioritized_alpha == 0.0,
    ("prioritized_alpha",),
)


def _updates_no_target(h: DQNHyperparams, limits: Limits) -> bool:
    return h.target_update_freq is not None and h.target_update_freq > limits.num_env_steps


_NO_TARGET_UPDATE = Rule(
    "target_update_freq is more than the env steps of a trial (at most {steps}), so the target network stays as it was",
    _updates_no_target,
    ("target_update_freq", *_LIMITS),
)


def _target_follows_updates(h: DQNHyperparams, limits: Limits) -> bool:
    """Whether a target update follows each update, so that the exact interval does not matter."""
    if h.target_update_interval is None:
        return True
    if h.target_update_unit == "episode" or not limits.is_packed:  # RLlib's env runners may share a phase
        return False
    phase = math.ceil(h.train_freq / h.num_envs) * h.num_envs
    most = math.ceil(phase * h.updates_per_env_step)
    # Several updates are spread evenly over their phase, at fractional env steps, which are rounded.
    return h.target_update_interval <= (phase if most == 1 else phase / most - 1e-6)


def _schedule_is_over(h: DQNHyperparams, _: Limits) -> bool:
    return h.lr_final is not None and h.lr_decay_steps is not None and h.lr_decay_steps <= _first_update(h)


_LR_IS_OVER = "lr_final is reached before the first update, which follows learning_starts"
_LR_READS = ("lr_final", "lr_decay_steps", "learning_starts", "train_batch_size")


# Epsilon, from `policies.networks.epsilon.EpsilonSchedule`.


def _begins_late(h: DQNHyperparams, limits: Limits) -> bool:
    # There are at most as many episodes as env steps.
    return h.epsilon_start >= limits.num_env_steps


def _is_geometric_from_below(h: DQNHyperparams, _: Limits) -> bool:
    return h.epsilon_schedule == "geometric" and h.epsilon_initial <= h.epsilon_final


def _ends_above(h: DQNHyperparams, limits: Limits) -> bool:
    """Whether a geometric schedule does not reach its final value in a trial."""
    if h.epsilon_schedule != "geometric":
        return False
    share = max(0, limits.num_env_steps - h.epsilon_start) / h.epsilon_decay
    return h.epsilon_initial * math.exp(-share) > h.epsilon_final


_EPSILON_READS = ("epsilon_start", *_LIMITS)
_STARTS_LATE = "epsilon_start is not less than the env steps of a trial (at most {steps}), so epsilon stays as it is"
_CONSTANT = Rule(
    "epsilon_initial is epsilon_final",
    lambda h, _: h.epsilon_initial == h.epsilon_final,
    ("epsilon_initial", "epsilon_final"),
)
_LATE = Rule(_STARTS_LATE, _begins_late, _EPSILON_READS)
_FROM_BELOW = Rule(
    "epsilon_schedule is geometric, epsilon is never less than epsilon_final, and epsilon_initial is not more",
    _is_geometric_from_below,
    ("epsilon_schedule", "epsilon_initial", "epsilon_final"),
)

DQN_RULES: dict[str, Rules] = {
    "hidden_sizes": ALWAYS,
    "activation": ALWAYS,
    "initializer": ALWAYS,
    "conv_filters": ALWAYS,  # without images they are refused
    "normalize_observations": ALWAYS,
    "lr": (
        NO_UPDATE,
        Rule(_LR_IS_OVER, _schedule_is_over, _LR_READS),
    ),
    "lr_final": (NO_UPDATE,),
    "lr_decay_steps": (
        NO_UPDATE,
        equal_ends("lr", "lr_final"),
        Rule(
            _LR_IS_OVER,
            _schedule_is_over,
            _LR_READS,
            of_value=True,
        ),
    ),
    "gamma": (NO_UPDATE,),
    "grad_clip": (NO_UPDATE,),
    "num_envs": ALWAYS,
    # These two decide how many random numbers are drawn, so they act even where nothing is learnt.
    "train_batch_size": ALWAYS,
    "updates_per_env_step": ALWAYS,
    "env_steps_per_iteration": ALWAYS,
    "train_freq": (
        Rule(
            "it is not more than num_envs, whose steps are made together",
            lambda h, limits: limits.is_packed and h.train_freq <= h.num_envs,
            ("train_freq", "num_envs"),
            of_value=True,
        ),
    ),
    "reward_scale": (NO_UPDATE,),
    "double_q": (NO_UPDATE, _NO_GAMMA),
    "dueling": ALWAYS,
    "n_step": (
        NO_UPDATE,
        Rule(
            "no episode has more steps",
            lambda h, limits: limits.max_episode_steps is not None and h.n_step >= limits.max_episode_steps,
            ("n_step",),
            of_value=True,
        ),
    ),
    "td_loss": (NO_UPDATE,),
    "optimizer": (NO_UPDATE,),
    "optimizer_epsilon": (NO_UPDATE,),
    "adam_beta1": (_NO_ADAM, NO_UPDATE),
    "adam_beta2": (_NO_ADAM, NO_UPDATE),
    "rmsprop_rho": (_NO_RMSPROP, NO_UPDATE),
    "rmsprop_momentum": (_NO_RMSPROP, NO_UPDATE),
    "target_network": (NO_UPDATE, _NO_GAMMA),
    "target_update_freq": (
        _NO_TARGET,
        NO_UPDATE,
        _NO_GAMMA,
        Rule(
            "it is more than the env steps of a trial (at most {steps}), so the target network stays as it was",
            _updates_no_target,
            ("target_update_freq", *_LIMITS),
            of_value=True,
        ),
        Rule(
            "there are not fewer env steps between two updates, so the target network follows each",
            _target_follows_updates,
            ("target_update_freq", "tau", "target_update_unit", "train_freq", "num_envs", "updates_per_env_step"),
            of_value=True,
            divides=True,
        ),
    ),
    "target_update_unit": (
        _NO_TARGET,
        NO_UPDATE,
        _NO_GAMMA,
        _NO_TARGET_UPDATE,
        Rule(
            "target_update_freq is null and tau less than 1, so the target network follows each update",
            lambda h, _: h.target_update_interval is None,
            ("target_update_freq", "tau"),
        ),
    ),
    "tau": (NO_UPDATE, _NO_GAMMA, _NO_TARGET_UPDATE),
    "replay": ALWAYS,
    "replay_capacity": (
        NO_UPDATE,
        Rule("replay is none", lambda h, _: h.replay == "none", ("replay",)),
        Rule(
            "a trial makes no more env steps (at most {steps}), so the replay memory keeps them all",
            lambda h, limits: h.replay_capacity >= limits.num_env_steps,
            ("replay_capacity", *_LIMITS),
            of_value=True,
        ),
    ),
    "prioritized_alpha": (_NO_PRIORITIES, NO_UPDATE),
    "prioritized_beta": (_NO_PRIORITIES, NO_UPDATE, _EQUAL_PRIORITIES),
    "prioritized_epsilon": (_NO_PRIORITIES, NO_UPDATE, _EQUAL_PRIORITIES),
    "learning_starts": (
        Rule(
            "a trial ends before (after at most {steps} env steps), so no update is made",
            lambda h, limits: h.learning_starts > limits.num_env_steps,
            ("learning_starts", *_LIMITS),
            of_value=True,
        ),
        Rule(
            "it is not more than train_batch_size, and no update is made before there is a batch",
            lambda h, _: h.learning_starts <= h.train_batch_size,
            ("learning_starts", "train_batch_size"),
            of_value=True,
        ),
    ),
    "epsilon_schedule": (
        _CONSTANT,
        Rule(
            _STARTS_LATE,
            lambda h, limits: _begins_late(h, limits) and h.epsilon_initial >= h.epsilon_final,
            (*_EPSILON_READS, "epsilon_initial", "epsilon_final"),
        ),
    ),
    "epsilon_unit": (_CONSTANT, _LATE, _FROM_BELOW),
    "epsilon_initial": (
        Rule(
            "epsilon_schedule is geometric, and epsilon never less than epsilon_final",
            _is_geometric_from_below,
            ("epsilon_schedule", "epsilon_initial", "epsilon_final"),
            of_value=True,
        ),
    ),
    "epsilon_final": (
        Rule(
            _STARTS_LATE,
            lambda h, limits: _begins_late(h, limits) and h.epsilon_schedule != "geometric",
            (*_EPSILON_READS, "epsilon_schedule"),
        ),
        Rule(
            "epsilon_schedule is geometric, and does not come down to it in the env steps of a trial (at most {steps})",
            _ends_above,
            ("epsilon_schedule", "epsilon_decay", "epsilon_initial", "epsilon_final", *_EPSILON_READS),
            of_value=True,
        ),
    ),
    "epsilon_decay": (_CONSTANT, _LATE, _FROM_BELOW),
    "epsilon_start": (
        _CONSTANT,
        _FROM_BELOW,
        Rule(
            "it is not less than the env steps of a trial (at most {steps}), so epsilon stays as it is",
            _begins_late,
            _EPSILON_READS,
            of_value=True,
        ),
    ),
}  # fmt: skip
