"""Notes of a plan on what a sweep's environment gives, and on what is made of it."""

from __future__ import annotations

from analysis.wording import counted
from policies.envs.flat import FlatBox
from policies.envs.make import EnvInfo
from policies.envs.masks import seen_by_networks
from policies.envs.own_actions import Choices, is_made
from policies.errors import shortened
from tune_jobs.plan.env_checks import channels_hint
from tune_jobs.spec.sweep_spec import SweepSpec


def env_notes(spec: SweepSpec, env: EnvInfo) -> list[str]:
    """Return notes on a sweep's environment, with its wrappers."""
    notes = []
    seen = seen_by_networks(env.observation_space)
    if isinstance(seen, FlatBox):
        kind = "images of shape" if env.observes_images else "vectors of shape"
        notes.append(f"Observations of {env.env_id} are made {kind} {seen.shape}: {shortened(seen.original)}.")
    if env.observes_images and spec.rl_module is None and (hint := channels_hint(spec, env)):
        # With filters that do not fit it is an error, which says the same.
        notes.append(f"Convolutions go over the first two dimensions of images. {hint}")
    if is_made(actions := env.action_space):
        kind = f"{counted(len(actions.sizes), 'choice')}" if isinstance(actions, Choices) else "vectors"
        notes.append(f"Actions of {env.env_id} are made of {kind}: {shortened(actions.original)}.")
    if env.mask is not None:
        notes.append(
            f"Only actions that {env.env_id} allows, by {env.mask}, are drawn, learned and taken; networks do not see "
            "the mask."
        )
    elif env.unused_mask is not None:
        notes.append(
            f"{env.env_id} gives info[{env.unused_mask!r}], which seems to say which actions are allowed, and which is "
            "not used: env.action_mask: true uses it."
        )
    target = spec.stop.training_return
    if env.threshold is not None and target is not None and target < env.threshold:
        notes.append(
            f"stop.training_return {target:g} is below {env.env_id}'s threshold {env.threshold:g}: "
            "trials may end before they solve it."
        )
    return notes
