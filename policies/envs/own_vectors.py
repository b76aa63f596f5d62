"""Which environments have a vectorised version of their own that does what a loop over them would do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, load_env_creator
from gymnasium.vector import AutoresetMode

from policies.envs.atari import is_of_emulator
from policies.envs.faults import close_env
from policies.envs.flat import needs_flattening
from policies.envs.own_actions import is_taken
from policies.envs.signatures import signature


def own_vector_env(
    spec: EnvSpec, num_envs: int, env_args: dict[str, Any]
) -> gym.vector.VectorEnv[Any, Any, Any] | None:
    """Make the env's own vectorised version; None: it has none, or one whose spaces are not as policies need them."""
    if not takes_vector_entry_point(spec, env_args):
        return None
    env = gym.make_vec(spec, num_envs=num_envs, vectorization_mode="vector_entry_point", **env_args)
    # A function has no metadata, and a class may choose the mode as it makes itself: Gymnasium's vectors do.
    as_ours = _resets_in_next_step(env.metadata)
    if as_ours and not needs_flattening(env.single_observation_space) and is_taken(env.single_action_space):
        return env
    close_env(env)
    return None


def takes_vector_entry_point(spec: EnvSpec, env_args: dict[str, Any]) -> bool:
    """Whether the env has a vectorised version that takes these arguments and the time limit, and resets as ours.

    When it resets is asked of its class here; what is made may say something else (`own_vector_env`).
    """
    # A vector entry point would leave out wrappers of the registry entry, and a time limit it does not take. That of
    # Atari's emulator (ale-py 0.12) observes stacked frames and clips rewards, which the env itself does not.
    if spec.vector_entry_point is None or spec.additional_wrappers or is_of_emulator(spec.entry_point):
        return False
    kwargs = {**spec.kwargs, **env_args}
    if spec.max_episode_steps is not None:
        kwargs.setdefault("max_episode_steps", spec.max_episode_steps)
    try:
        entry_point = spec.vector_entry_point
        creator = entry_point if callable(entry_point) else load_env_creator(entry_point)
        signature(creator).bind(num_envs=1, **kwargs)
    except (ImportError, AttributeError, TypeError, ValueError):
        return False
    return _resets_in_next_step(getattr(creator, "metadata", None))


def _resets_in_next_step(metadata: Any) -> bool:
    """Whether an env of these metadata resets in the step after an episode's last, as a loop over envs does here."""
    mode = AutoresetMode.NEXT_STEP
    if isinstance(metadata, Mapping):
        mode = metadata.get("autoreset_mode", mode)
    try:
        return AutoresetMode(mode) is AutoresetMode.NEXT_STEP  # the mode may also be given as a string
    except ValueError:
        return False
