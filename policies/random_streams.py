"""Derive every stream of random numbers, all in this module, so that no two are the same by mistake.

Streams derived from the seed of a sweep, by `spawn_key` of `numpy.random.SeedSequence`:

| spawn key | stream |
|---|---|
| (0, point) | a point's values, where they are drawn at random |
| (1, trial) | where the block of a trial's training seeds begins |
| (2,) | where the evaluation seeds begin |
| (3,) | where the confirmation seeds begin |
| (4, trial, change) | population based training: how a trial's change number `change` changes its values |
| (5, point) | search method tpe: its sampler |
| (6, point) | other search methods that have a model: what they draw for it, and where they look |
| (7, point) | searches of two objectives: what one weighs beside the other |

Points are counted there without those that somebody chose, so that these change no other.

Streams derived from the seed of a trial, which is the entropy together with further numbers. A trial that is continued
from iteration i > 0 uses new numbers, because only packs save the state of their generators:

| entropy | stream |
|---|---|
| the seed itself | weights, environments; engine rllib: exploration, batches and permutations |
| [seed, 0] | packs: what a member draws: actions, permutations, batches |
| [seed, i] | engine rllib and random policies, and a pack's checkpoint restored as an Algorithm: all of the above |
| [seed, i, 1] | packs: environments |
| [seed, i, 2] | packs: what a member draws that went on from a copy of another's checkpoint |

Zeros at the end of an entropy change nothing, so [seed, 0] is the seed itself: until its first restart, a member of a
pack draws from the numbers that Gymnasium seeds its first sub-environment with, which are used for other things there.
Other numbers would be better, and would change the result of every pack.

Random policies in evaluations draw from [the episode's seed]. Resampling in reports, and trial steps of environments
that are measured, use a fixed seed. An environment's use of its seed is up to Gymnasium.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_POINT, _TRAINING, _EVALUATION, _CONFIRMATION, _MUTATION, _TPE, _MODEL, _WEIGHT = range(8)
"""The first elements of spawn keys: for a new stream, take the next number and add a row to the table above."""


def _spawned(sweep_seed: int, *spawn_key: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(sweep_seed, spawn_key=spawn_key)


def _words(entropy: int | Sequence[int], num_words: int) -> list[int]:
    return [int(word) for word in np.random.SeedSequence(entropy).generate_state(num_words)]


def seeded(seed: int) -> np.random.Generator:
    """Return the generator of a seed itself."""
    return np.random.default_rng(seed)


def fixed() -> np.random.Generator:
    """Return a generator with a fixed seed, for numbers that must be the same each time or belong to no sweep."""
    return seeded(0)


# From a sweep's seed.


def point_values(sweep_seed: int, point_index: int) -> np.random.Generator:
    """Return the generator that draws the values of a point."""
    return np.random.default_rng(_spawned(sweep_seed, _POINT, point_index))


def training_block(sweep_seed: int, trial_index: int) -> np.random.Generator:
    """Return the generator that draws a trial's block of training seeds."""
    return np.random.default_rng(_spawned(sweep_seed, _TRAINING, trial_index))


def evaluation_start(sweep_seed: int) -> np.random.Generator:
    """Return the generator that draws the first evaluation seed."""
    return np.random.default_rng(_spawned(sweep_seed, _EVALUATION))


def confirmation_start(sweep_seed: int) -> np.random.Generator:
    """Return the generator that draws the first confirmation seed."""
    return np.random.default_rng(_spawned(sweep_seed, _CONFIRMATION))


def mutation(sweep_seed: int, trial_index: int, num_changes: int) -> np.random.Generator:
    """Return the generator by which population based training changes a trial's values; the same in every run."""
    return np.random.default_rng(_spawned(sweep_seed, _MUTATION, trial_index, num_changes))


def tpe_seed(sweep_seed: int, point_index: int) -> int:
    """Return the seed of the sampler that proposes a point."""
    return int(_spawned(sweep_seed, _TPE, point_index).generate_state(1)[0])


def model_draws(sweep_seed: int, point_index: int) -> np.random.Generator:
    """Return the generator of a search method that proposes a point by a model."""
    return np.random.default_rng(_spawned(sweep_seed, _MODEL, point_index))


def objective_weights(sweep_seed: int, point_index: int) -> np.random.Generator:
    """Return the generator of the weight that one of two objectives has when a point is proposed."""
    return np.random.default_rng(_spawned(sweep_seed, _WEIGHT, point_index))


# From a trial's seed.


def member_draws(trial_seed: int) -> np.random.Generator:
    """Return the generator of a new member of a pack."""
    return np.random.default_rng(np.random.SeedSequence([trial_seed, 0]))


def seeds_after(trial_seed: int, iteration: int) -> tuple[int, int]:
    """Return two seeds for a trial that continues after an iteration: its own and that of its environments.

    Where one seed is used for both, it is the first.
    """
    first, second = _words([trial_seed, iteration], 2)
    return first, second


def member_env_seed_after(trial_seed: int, iteration: int) -> int:
    """Return the seed of the environments of a pack's member that continues after an iteration, with new episodes."""
    return _words([trial_seed, iteration, 1], 1)[0]


def member_draws_after(trial_seed: int, iteration: int) -> np.random.Generator:
    """Return the generator of a pack's member that goes on from another trial's checkpoint after an iteration.

    The checkpoint holds the other's generator, by which the two would draw the same.
    """
    return np.random.default_rng(np.random.SeedSequence([trial_seed, iteration, 2]))


# From an episode's seed.


def random_actions_seed(episode_seed: int) -> int:
    """Return the seed of a random policy's actions in an episode.

    Gymnasium seeds an env's generator with the episode's seed itself. Actions drawn with the same seed would be drawn
    from the same numbers as the env's start states and noise.
    """
    return int(np.random.SeedSequence(episode_seed).generate_state(1, np.uint64)[0])
