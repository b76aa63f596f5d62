"""Race settings: which of a sweep's leading settings are trained with more seeds, and which no longer.

A sweep with one seed a setting cannot tell which setting is best: its leaders led with their luck too. So the leading
ones are trained with fresh seeds, in rounds. After each round the worse half is out, and the others get twice as many
seeds in the next: sequential halving (Karnin, Koren & Somekh 2013, "Almost Optimal Exploration in Multi-Armed
Bandits"), which spends most on the settings that are hard to tell apart. A setting is out earlier if it is hardly
possible that it is the best. Decision 29 compares this with other ways to spend the same env steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.objectives import expected_means
from analysis.statistics import probability_of_being_best, seeds_differ
from policies import random_streams

HARDLY_POSSIBLE = 0.02
"""A setting that is the best of all with less than this probability is out."""


@dataclass(frozen=True)
class Race:
    """A race of some settings.

    Args:
        contenders: The indices of the points that race, best first.
        num_seeds: How many more seeds a setting gets at most.
    """

    contenders: tuple[int, ...]
    num_seeds: int

    @property
    def rounds(self) -> tuple[tuple[int, int], ...]:
        """For each round, how many settings race in it at most, and how many more seeds each of them gets."""
        num_rounds = max(1, math.ceil(math.log2(len(self.contenders)))) if self.contenders else 0
        num_rounds = min(num_rounds, self.num_seeds)
        weights = [2**index for index in range(num_rounds)]
        # The seeds up to the end of each round, rounded; each round gives one at least.
        ends = [0]
        for index in range(num_rounds):
            share = self.num_seeds * sum(weights[: index + 1]) / sum(weights)
            ends.append(max(ends[-1] + 1, min(round(share), self.num_seeds - (num_rounds - 1 - index))))
        sizes = [max(2, math.ceil(len(self.contenders) / 2**index)) for index in range(num_rounds)]
        return tuple((size, ends[index + 1] - ends[index]) for index, size in enumerate(sizes))

    @property
    def max_trainings(self) -> int:
        """How many trainings the race takes at most."""
        return sum(min(size, len(self.contenders)) * seeds for size, seeds in self.rounds)

    def next_points(self, scores: Mapping[int, Sequence[float]], num_done: int) -> tuple[int, ...]:
        """Return the points that get one more seed each in the next round, the better first.

        Args:
            scores: For each contender one score a training seed, of all its trainings so far; higher is better.
            num_done: How many rounds are over.

        Returns:
            The points, each as often as it gets a seed; none: the race is over.
        """
        if num_done >= len(self.rounds) or len(self.contenders) < 2:
            return ()
        size, seeds = self.rounds[num_done]
        # With one seed each nothing says yet who cannot win.
        several = max(len(scores[index]) for index in self.contenders) > 1
        running = self._still_in(scores, size) if several else list(self.contenders)
        if len(running) < 2:
            return ()
        # Seed after seed, so that a round that is interrupted has given about as many to each.
        return tuple(index for _ in range(seeds) for index in running)

    def _still_in(self, scores: Mapping[int, Sequence[float]], size: int) -> list[int]:
        known = [scores[index] for index in self.contenders]
        means = dict(zip(self.contenders, expected_means(known), strict=True))
        all_possible = [1.0] * len(known)
        try:
            # The same scores decide the same, whenever it is asked. Of seeds that do not differ nothing says who cannot
            # win.
            rng = random_streams.fixed()
            chances = list(probability_of_being_best(known, rng=rng)) if seeds_differ(known) else all_possible
        except ValueError:
            # Nor does it of scores so large that their squares are no numbers.
            chances = all_possible
        possible = [index for index, chance in zip(self.contenders, chances, strict=True) if chance >= HARDLY_POSSIBLE]
        return sorted(possible, key=lambda index: -means[index])[:size]


def race_within(contenders: Sequence[int], *, top: int, num_seeds: int, max_trainings: int) -> Race | None:
    """Return the largest race that takes no more trainings than allowed; None: not even two settings can race.

    It has as many of the leading settings as possible, up to `top`, before it has more seeds of each.

    Args:
        contenders: The indices of all points that could race, best first.
        top: How many race at most.
        num_seeds: How many more seeds a setting gets at most.
        max_trainings: How many trainings it may take.
    """
    # With one seed each, a race takes as many trainings as settings.
    size = min(top, len(contenders), max_trainings)
    if size < 2:
        return None
    races = (Race(tuple(contenders[:size]), seeds) for seeds in range(min(num_seeds, max_trainings), 0, -1))
    return next(race for race in races if race.max_trainings <= max_trainings)
