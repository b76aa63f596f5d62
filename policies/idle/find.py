"""Find out which hyperparameters are idle: given the others and the length of a trial, they change nothing.

Words: a hyperparameter *is idle* in a trial if another value of it would train the same policy. A `Rule` says when, and
why. Most rules do not look at the value itself: without a KL penalty no `kl_target` acts. Others do (`of_value`): a
replay memory that is never full trains as any larger one does, but not as a small one. `RULES` holds every
hyperparameter; those without a rule always act.

A rule applies only where it is certain: anything that depends on when episodes end, or on chance, counts as acting.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from policies.idle.dqn import DQN_RULES, NO_UPDATE
from policies.idle.ppo import PPO_RULES
from policies.idle.rule import ALWAYS, Limits, Rule, Rules

__all__ = ["NO_UPDATE", "RULES", "Limits", "Rule", "idle_rule"]

RULES: Mapping[str, Mapping[str, Rules]] = {
    "ppo": PPO_RULES,
    "dqn": DQN_RULES,
    "random": {"num_envs": ALWAYS, "env_steps_per_iteration": ALWAYS},
    "constant": {"num_envs": ALWAYS, "env_steps_per_iteration": ALWAYS, "action": ALWAYS},
}
"""For each algorithm and hyperparameter, the rules for when it is idle."""


def idle_rule(algorithm: str, name: str, hyperparams: Any, limits: Limits) -> Rule | None:
    """Return the rule by which a hyperparameter is idle in a trial, or None if it acts.

    Rules that do not look at its value come first.

    Args:
        algorithm: A key of `RULES`.
        name: The hyperparameter's name.
        hyperparams: All hyperparameters of the trial.
        limits: The limits of the trial.
    """
    rules = sorted(RULES[algorithm][name], key=lambda rule: rule.of_value)
    return next((rule for rule in rules if rule.holds(hyperparams, limits)), None)
