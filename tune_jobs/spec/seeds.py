"""The seeds of a sweep: training, evaluation and confirmation, all from the sweep seed and disjoint.

    [0, 2**19)       evaluation: the greedy episodes by which trials are compared
    [2**19, 2**20)   confirmation: the greedy episodes on which the winner is measured again
    [2**20, 2**31)   training: a block of 1,024 per trial

A trial gets a block because RLlib adds small numbers to its seed (env runner index, sub-environment index):
trials seeded 0, 1, 2 would share streams of environments.
"""

from __future__ import annotations

import numpy as np

from policies import random_streams

SEEDS_PER_TRIAL = 1024
MAX_EPISODES = 2**18

_EVALUATION_START = 0
_CONFIRMATION_START = 2**19
_TRAINING_START = 2**20
_SEED_END = 2**31


def trial_seeds(sweep_seed: int, num_trials: int) -> list[int]:
    """Training seeds of the first trials of a sweep; more trials append seeds and change none.

    Args:
        sweep_seed: Seed of the sweep, at least 0.
        num_trials: How many seeds are wanted.

    Returns:
        Distinct multiples of 1,024 in [2**20, 2**31): a trial may use its seed and the 1,023 after it.

    Raises:
        ValueError: There are more trials than blocks.
    """
    first, end = _TRAINING_START // SEEDS_PER_TRIAL, _SEED_END // SEEDS_PER_TRIAL
    if num_trials > (end - first) // 2:
        raise ValueError(f"{num_trials} trials are more than there are blocks of seeds for")
    taken: set[int] = set()
    seeds = []
    for index in range(num_trials):
        rng = random_streams.training_block(sweep_seed, index)
        block = int(rng.integers(first, end))
        while block in taken:
            block = int(rng.integers(first, end))
        taken.add(block)
        seeds.append(block * SEEDS_PER_TRIAL)
    return seeds


def evaluation_seeds(sweep_seed: int, num_episodes: int) -> tuple[int, ...]:
    """Seeds of the episodes by which all trials of a sweep are compared, consecutive, in [0, 2**19)."""
    return _consecutive(random_streams.evaluation_start(sweep_seed), num_episodes, _EVALUATION_START)


def confirmation_seeds(sweep_seed: int, num_episodes: int) -> tuple[int, ...]:
    """Seeds of the episodes on which the winner is measured again, consecutive, in [2**19, 2**20)."""
    return _consecutive(random_streams.confirmation_start(sweep_seed), num_episodes, _CONFIRMATION_START)


def _consecutive(rng: np.random.Generator, num_episodes: int, start: int) -> tuple[int, ...]:
    if num_episodes > MAX_EPISODES:
        raise ValueError(f"{num_episodes} episodes are more than the {MAX_EPISODES} there are seeds for")
    # The offset doesn't depend on the number of episodes: more episodes append seeds and change none.
    first = start + int(rng.integers(0, MAX_EPISODES))
    return tuple(range(first, first + num_episodes))
