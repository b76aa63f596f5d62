"""Sweeps with a known truth: the scores of settings over training seeds, as reinforcement learning gives them.

`python tests/unit/simulated_sweeps.py` prints the tables of decision 28, in some minutes.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2]))

from analysis.statistics import (
    Estimate,
    bootstrap_t_interval,
    mean_with_ci,
    probability_of_being_best,
    seed_intervals,
    t_interval,
    tie_groups,
)

Floats = NDArray[np.float64]
SOLVED, COLLAPSED = 500.0, (20.0, 200.0)


@dataclass(frozen=True)
class Simulated:
    """One sweep: scores, shape (settings, seeds), and the true mean of each setting."""

    scores: Floats
    truth: Floats


World = Callable[[np.random.Generator, int, int], Simulated]


def normal(
    rng: np.random.Generator, settings: int, seeds: int, *, spread: float = 1.0, unequal: float = 0.0
) -> Simulated:
    """Settings differ by `spread` seeds' standard deviations, and in log standard deviation by `unequal`."""
    truth = spread * rng.standard_normal(settings)
    scales = np.exp(unequal * rng.standard_normal((settings, 1)))
    return Simulated(truth[:, np.newaxis] + scales * rng.standard_normal((settings, seeds)), truth)


def skewed(rng: np.random.Generator, settings: int, seeds: int, *, lognormal: bool = False) -> Simulated:
    """A long tail of bad runs below a ceiling, exponential or, heavier, lognormal."""
    truth = rng.standard_normal(settings)
    draw = rng.lognormal if lognormal else rng.exponential
    tails = draw(size=(settings, seeds)) - (np.exp(0.5) if lognormal else 1.0)
    return Simulated(truth[:, np.newaxis] - tails, truth)


def solving(rng: np.random.Generator, shares: Floats, seeds: int) -> Simulated:
    """Runs solve, with exactly 500, with each setting's probability, or else end anywhere from 20 to 200."""
    solve = rng.random((shares.size, seeds)) < shares[:, np.newaxis]
    scores = np.where(solve, SOLVED, rng.uniform(*COLLAPSED, size=solve.shape))
    return Simulated(scores, shares * SOLVED + (1.0 - shares) * sum(COLLAPSED) / 2.0)


def solved_or_collapsed(rng: np.random.Generator, settings: int, seeds: int, *, share: float) -> Simulated:
    """Every setting solves with the same probability."""
    return solving(rng, np.full(settings, share), seeds)


def any_share(rng: np.random.Generator, settings: int, seeds: int) -> Simulated:
    """Settings solve with any probability from 0 to 1."""
    return solving(rng, rng.random(settings), seeds)


def typical_sweep(rng: np.random.Generator, settings: int, seeds: int) -> Simulated:
    """Three of ten settings always solve, two never, the others sometimes."""
    kind, shares = rng.random(settings), rng.random(settings)
    return solving(rng, np.where(kind < 0.3, 1.0, np.where(kind < 0.5, 0.0, shares)), seeds)


def below_a_ceiling(rng: np.random.Generator, settings: int, seeds: int) -> Simulated:
    """The best settings crowd together: true means are exponentially far below a ceiling."""
    truth = -rng.exponential(size=settings)
    return Simulated(truth[:, np.newaxis] + rng.standard_normal((settings, seeds)), truth)


WORLDS: dict[str, World] = {
    "normal": normal,
    "normal, unequal variances": partial(normal, unequal=0.8),
    "exponential tail of bad runs": skewed,
    "lognormal tail of bad runs": partial(skewed, lognormal=True),
    "solves in 50 % of runs": partial(solved_or_collapsed, share=0.5),
    "solves in 70 %": partial(solved_or_collapsed, share=0.7),
    "solves in 90 %": partial(solved_or_collapsed, share=0.9),
    "solves in 0 to 100 %": any_share,
    "30 % always, 20 % never, others any": typical_sweep,
}
RANKED: dict[str, World] = {
    "settings differ as much as seeds": normal,
    "a third as much": partial(normal, spread=0.3),
    "as much, unequal variances": partial(normal, unequal=0.8),
    "solves in 0 to 100 %": any_share,
    "best settings crowd below a ceiling": below_a_ceiling,
}


def coverage(sweeps: Sequence[Simulated], interval: Callable[[Floats], Sequence[Estimate]]) -> float:
    """Return the share of intervals, of all settings of all sweeps, that hold the truth."""
    inside = [
        # A mean of 500.0 in other words: rounding is no miss.
        estimate.lower - 1e-9 <= truth <= estimate.upper + 1e-9
        for sweep in sweeps
        for estimate, truth in zip(interval(sweep.scores), sweep.truth, strict=True)
    ]
    return float(np.mean(inside))


def best_probabilities(sweeps: Sequence[Simulated], rng: np.random.Generator, num_draws: int) -> tuple[Floats, Floats]:
    """Return for all settings of all sweeps the probability of being best, and whether it is (shared among equals)."""
    given = [probability_of_being_best(list(sweep.scores), rng=rng, num_draws=num_draws) for sweep in sweeps]
    best = [sweep.truth >= sweep.truth.max() - 1e-9 for sweep in sweeps]
    return np.concatenate(given), np.concatenate([is_best / is_best.sum() for is_best in best])


def _coverages() -> None:
    rng = np.random.default_rng(0)
    methods: dict[str, tuple[int, Callable[[Floats], Sequence[Estimate]]]] = {
        "percentile": (200, lambda scores: [mean_with_ci(row, rng=rng, num_resamples=1_000) for row in scores]),
        "t": (1_000, lambda scores: [t_interval(row) for row in scores]),
        "bootstrap-t": (
            200,
            lambda scores: [bootstrap_t_interval(row, rng=rng, num_resamples=1_000) for row in scores],
        ),
        "moderated": (1_000, lambda scores: seed_intervals(list(scores))),
    }
    print("| runs of a setting |", " | ".join(f"{name} {n}" for name in methods for n in (3, 5, 10)), "|")
    for name, world in WORLDS.items():
        cells = []
        for count, method in methods.values():
            for seeds in (3, 5, 10):
                sweeps = [world(rng, 20, seeds) for _ in range(count)]
                cells.append(f"{100 * coverage(sweeps, method):.1f}")
        print("|", name, "|", " | ".join(cells), "|", flush=True)
    print("| moderated, settings |", " | ".join(f"{count} x {n}" for count in (2, 5, 10, 100) for n in (5, 10)), "|")
    for name, world in WORLDS.items():
        cells = []
        for settings in (2, 5, 10, 100):
            for seeds in (5, 10):
                sweeps = [world(rng, settings, seeds) for _ in range(20_000 // settings)]
                cells.append(f"{100 * coverage(sweeps, methods['moderated'][1]):.1f}")
        print("|", name, "|", " | ".join(cells), "|", flush=True)


def _calibrations() -> None:
    rng = np.random.default_rng(0)
    edges = (0.0, 0.1, 0.3, 0.5, 0.7, 1.01)
    for name, world in RANKED.items():
        for seeds in (3, 5, 10):
            given, best = best_probabilities([world(rng, 10, seeds) for _ in range(2_000)], rng, 1_000)
            cells = []
            for low, high in itertools.pairwise(edges):
                chosen = (given >= low) & (given < high)
                cells.append(f"{100 * (best[chosen].mean() - given[chosen].mean()):+.1f} ({chosen.sum()})")
            print("|", name, "|", seeds, "|", " | ".join(cells), "|", flush=True)


def _tie_errors() -> None:
    rng = np.random.default_rng(0)
    for name, world in ({"all equal": partial(normal, spread=0.0)} | RANKED | WORLDS).items():
        for settings, seeds in ((5, 3), (5, 5), (5, 10), (20, 3), (20, 5), (20, 10)):
            wrong = lost = 0
            for _ in range(500):
                sweep = world(rng, settings, seeds)
                ties = tie_groups(list(sweep.scores), rng=rng, num_draws=1_000)
                low, high = ties.means - ties.half_widths, ties.means + ties.half_widths
                said = low[:, np.newaxis] > high
                wrong += bool((said & (sweep.truth[:, np.newaxis] <= sweep.truth + 1e-9)).any())
                lost += int(sweep.truth.argmax()) not in ties.with_leader
            print("|", name, "|", settings, "|", seeds, "|", wrong / 5, "|", lost / 5, "|", flush=True)


if __name__ == "__main__":
    _coverages()
    _calibrations()
    _tie_errors()
