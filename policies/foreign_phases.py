"""DQN's training phases and target updates, in the numbers that Stable-Baselines3 and RLlib have for them.

We carry the fraction of an update that is due to the next phase, and update the target network between updates. Neither
library carries fractions, and each looks at its target network at moments of its own.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from policies.hyperparams import DQNHyperparams

_CLOSE = 0.01
"""The relative error that a rate may have, where the other library counts in whole numbers."""


@dataclass(frozen=True)
class Phase:
    """A training phase of another library's DQN."""

    num_vector_steps: int
    """Vector steps between two phases."""
    num_updates: int
    notes: tuple[str, ...]
    """What is done otherwise, each a sentence."""


def sb3_phase(values: DQNHyperparams) -> Phase:
    """Return the training phase for SB3's train_freq and gradient_steps."""
    return _phase(values)


def rllib_phase(values: DQNHyperparams) -> Phase:
    """Return the training phase that RLlib makes of a rollout_fragment_length and a training_intensity."""
    # RLlib refuses fragments that are shorter than n_step.
    return _phase(values, at_least=values.n_step)


def sb3_target(values: DQNHyperparams, phase: Phase) -> tuple[dict[str, float], list[str]]:
    """Return SB3's arguments for updates of the target network, and notes.

    SB3 makes them between training phases, never in one.
    """
    # How many of our updates there are for each of the target, and how many updates of the target in a phase.
    num_updates = _updates_per_target_update(values)
    per_phase = phase.num_updates / num_updates
    if per_phase > 1:
        # So many soft updates from the same weights are one with this share.
        tau = 1.0 - (1.0 - values.tau) ** per_phase
        share = "" if values.tau == 1.0 else f", with tau {tau:.4g}"
        note = f"The target network is updated once for each training phase{share}, not {per_phase:.4g} times in it."
        arguments = {"tau": tau, "target_update_interval": phase.num_vector_steps * values.num_envs}
        return arguments, _if_counted(values, note)
    # In whole vector steps, as SB3 counts.
    interval = round(phase.num_vector_steps / per_phase) * values.num_envs
    return {"tau": values.tau, "target_update_interval": interval}, _interval_notes(values, interval)


def rllib_target(values: DQNHyperparams, phase: Phase) -> tuple[int, list[str]]:
    """Return RLlib's target_network_update_freq, and notes.

    RLlib looks after each update at the env steps sampled, which stay the same through a training phase.
    """
    num_updates = _updates_per_target_update(values)
    interval = values.target_update_interval
    if interval is None or num_updates == 1:
        return 0, []  # with 0, the target is updated after each update
    per_phase = phase.num_updates / num_updates
    if per_phase > 1:
        note = f"The target network is updated once in each training phase, not {per_phase:.4g} times."
        return interval, _if_counted(values, note)
    env_steps = phase.num_vector_steps * values.num_envs
    return interval, _interval_notes(values, math.ceil(interval / env_steps) * env_steps)


def _phase(values: DQNHyperparams, at_least: int = 1) -> Phase:
    """Return training phases that make a whole number of updates each, at our rate or close to it.

    Args:
        values: The setting.
        at_least: The fewest vector steps that a phase may have.
    """
    ours = math.ceil(values.train_freq / values.num_envs)
    rate = values.updates_per_env_step * values.num_envs
    # Shorter ones would make less than one update each. The search ends: 1 / _CLOSE updates are close to any rate.
    for num_steps in itertools.count(max(ours, at_least, round(1 / rate))):
        num_updates = max(1, round(rate * num_steps))
        if abs(num_updates / (rate * num_steps) - 1) <= _CLOSE:
            break
    if num_steps == ours and math.isclose(num_updates, rate * ours):
        return Phase(num_steps, num_updates, ())
    note = (
        f"Updates in a training phase: {num_updates} every {num_steps * values.num_envs} env steps, "
        f"ours {rate * ours:.4g} on average every {ours * values.num_envs}."
    )
    return Phase(num_steps, num_updates, (note,))


def _updates_per_target_update(values: DQNHyperparams) -> int:
    """Return after how many of our updates the target network is updated."""
    interval = values.target_update_interval
    # It allows for rounding, as 10 x 0.1 may be more than 1 in binary.
    return 1 if interval is None else max(1, math.ceil(interval * values.updates_per_env_step - 1e-9))


def _interval_notes(values: DQNHyperparams, env_steps: int) -> list[str]:
    """Return a note if the target network is updated after other numbers of env steps than ours."""
    ours = _updates_per_target_update(values) / values.updates_per_env_step
    if abs(env_steps / ours - 1) <= _CLOSE:
        return []
    return _if_counted(values, f"The target network is updated every {env_steps} env steps, ours every {ours:.6g}.")


def _if_counted(values: DQNHyperparams, note: str) -> list[str]:
    """Return the note, if our target network is updated by env steps or updates: else they have nothing like it."""
    return [note] if values.target_network and values.target_update_unit == "env_step" else []
