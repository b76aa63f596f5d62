"""Choose among policies by more greedy episodes: successive rejects.

The leading checkpoints of a sweep were each evaluated over a few episodes, and often lead with the luck of these. So
they play more episodes, in rounds. After each round the worst is rejected, and the others play on: most episodes are
spent on the policies that are hard to tell apart. All play the same episodes (common random numbers), so that a lucky
start state favours none.

Nothing here depends on time: what the rounds may spend is counted in episodes and env steps.

Source:
    Audibert, Bubeck & Munos 2010, "Best Arm Identification in Multi-Armed Bandits" (COLT), figure 3: with K policies
    and n episodes in all, each policy that is left has played n_k = ceil((n - K) / (L (K + 1 - k))) episodes at the end
    of round k, L = 1/2 + 1/2 + 1/3 + ... + 1/K. Two things differ. An exact tie is not broken while episodes are left:
    the tied play on. And n is estimated anew before each round, because the env steps of an episode are known only
    when it was played; so a round is played in several parts, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from analysis.statistics.estimate import variance
from analysis.statistics.student_t import t_quantile
from policies.acting.evaluate import Episodes
from policies.errors import EnvError, TuneJobsError

Played = Episodes | TuneJobsError
Play = Callable[[Sequence[int], int, int], Sequence[Played]]
"""Plays `count` episodes from episode number `first` on with some candidates, named by their numbers."""

NOT_FINITE = "the mean of its returns is not a finite number"
TIED = "a tie, from more env steps"
_GROWTH = 4
"""How many times as many episodes as are known are played before it is asked again what one takes."""


@dataclass
class Standing:
    """What is known of one candidate."""

    number: int
    first_mean: float
    """The mean return of the evaluation that it was a candidate by."""
    num_first: int
    """The episodes of that evaluation."""
    returns: list[float] = field(default_factory=list)
    """The returns of the episodes that were played since."""
    num_env_steps: int = 0
    """Env steps of those episodes."""
    rejected_in: int | None = None
    """The round after which it was rejected; None: it won."""
    reason: str = ""
    """Why it was rejected; empty: for its score."""

    @property
    def failed(self) -> bool:
        """Whether it was rejected because its episodes could not be played."""
        return self.reason not in ("", TIED)

    @property
    def num_episodes(self) -> int:
        """All episodes that it was judged by."""
        return self.num_first + len(self.returns)

    @property
    def score(self) -> float:
        """The mean return over all of them."""
        return (self.num_first * self.first_mean + sum(self.returns)) / self.num_episodes

    def interval(self) -> tuple[float, float] | None:
        """Return Student's 95 % interval of the score, over episodes of this policy.

        Of the first evaluation only the mean is known: the spread is that of the episodes played since.

        Returns:
            Its ends; None if fewer than two episodes were played since, the spread is not a finite number, or these
            are all equal and those of the first evaluation were not: then nothing is known of how far they spread.
        """
        if len(self.returns) < 2:
            return None
        spread = variance(np.asarray(self.returns, dtype=np.float64))
        if spread == 0.0 and self.num_first and not math.isclose(self.returns[0], self.first_mean, rel_tol=1e-9):
            return None
        half = t_quantile(0.975, len(self.returns) - 1.0) * math.sqrt(spread / self.num_episodes)
        return (self.score - half, self.score + half) if math.isfinite(half) else None


@dataclass(frozen=True)
class Rejects:
    """How the choice went."""

    standings: tuple[Standing, ...]
    """All candidates, the winner first, then those that stayed longer."""
    num_rounds: int
    num_episodes: int
    """Episodes that were played, of all candidates together."""
    num_env_steps: int
    note: str = ""
    """Why the rounds ended before the last one; empty: they did not."""


def successive_rejects(
    first_means: Sequence[float],
    num_first: int,
    tie_keys: Sequence[tuple[int, ...]],
    play: Play,
    *,
    max_episodes: int,
    max_env_steps: int,
) -> Rejects:
    """Reject candidates round by round until one is left.

    Args:
        first_means: For each candidate the mean return of the evaluation that it is a candidate by; one at least.
        num_first: The episodes of that evaluation.
        tie_keys: For each candidate what decides between those whose scores are equal to the end; the lowest wins.
        play: Plays episodes. A candidate for which it returns an error is rejected.
        max_episodes: How many episodes all rounds may take.
        max_env_steps: How many env steps all rounds may take. An episode may be longer than those before it, so that a
            little more can be spent.
    """
    candidates = [Standing(number, mean, num_first) for number, mean in enumerate(first_means)]
    return _Rounds(candidates, tie_keys, play, (max_episodes, max_env_steps)).run()


class _Rounds:
    def __init__(
        self, candidates: list[Standing], tie_keys: Sequence[tuple[int, ...]], play: Play, budget: tuple[int, int]
    ) -> None:
        self.all = candidates
        self.running = list(self.all)
        self.tie_keys, self.play = tie_keys, play
        self.max_episodes, self.max_env_steps = budget
        self.num_rounds = 0
        self.note = ""

    def run(self) -> Rejects:
        num = len(self.all)
        for number in range(1, num):
            self.num_rounds = number
            self._play_round(number)
            # Where episodes have run out, or the env failed, there is nothing to wait for.
            over = bool(self.note) or not self._affordable()
            self._reject(1 if over else num - number)
            if over or len(self.running) == 1:
                break
        return self._result()

    def _play_round(self, number: int) -> None:
        if number == 1:
            # The first episode of each tells about how long episodes are.
            self._play(min(1, self._affordable()))
        known = len(self.running[0].returns)
        target = known + self._wanted(number)
        # Not all at once: a few short episodes say little about those to come, which may take many times as long.
        while self._play(min(target - known, self._affordable(), _GROWTH * max(1, known))):
            known = len(self.running[0].returns)

    def _wanted(self, number: int) -> int:
        """Return how many more episodes each candidate plays in a round, by the formula of the module."""
        if not self.running:
            return 0
        num, played = len(self.all), sum(len(standing.returns) for standing in self.all)
        left = min(self.max_episodes - played, len(self.running) * self._env_steps_left() / self._env_steps_of_one())
        weight = 0.5 + sum(1.0 / place for place in range(2, num + 1))
        target = math.ceil((played + left - num) / (weight * (num + 1 - number)))
        return max(0, target - len(self.running[0].returns))

    def _affordable(self) -> int:
        """Return how many more episodes each candidate that is left can play."""
        if not self.running:
            return 0
        left = self.max_episodes - sum(len(standing.returns) for standing in self.all)
        by_steps = self._env_steps_left() / self._env_steps_of_one()
        return max(0, min(left // len(self.running), math.floor(by_steps)))

    def _env_steps_left(self) -> int:
        return max(0, self.max_env_steps - sum(standing.num_env_steps for standing in self.all))

    def _env_steps_of_one(self) -> float:
        """Return about how many env steps one episode of each candidate takes, by those that they have played."""
        return sum(max(1.0, item.num_env_steps / max(1, len(item.returns))) for item in self.running)

    def _play(self, count: int) -> bool:
        """Let each candidate that is left play so many more episodes; return whether they did."""
        if count < 1 or self.note or len(self.running) < 2:
            return False
        try:
            played = self.play([item.number for item in self.running], len(self.running[0].returns), count)
        except EnvError as error:
            # It hung or ended its process, and nobody knows for whose sake: what was known before decides.
            self.note = f"Round {self.num_rounds} could not be played: {error.message}"
            return False
        failed = [result for result in played if isinstance(result, TuneJobsError)]
        if len(failed) == len(played):
            self.note = f"Round {self.num_rounds} could not be played: {failed[0].message}"
            return False
        for standing, result in zip(self.running, played, strict=True):
            if isinstance(result, TuneJobsError):
                self._out(standing, result.message)
                continue
            standing.returns.extend(result.returns)
            standing.num_env_steps += sum(result.lengths)
            if not math.isfinite(standing.score):
                self._out(standing, NOT_FINITE)
        self.running = [standing for standing in self.running if standing.rejected_in is None]
        if not self.running:
            self.running = [self.all[0]]
            self.note = f"Round {self.num_rounds}: {NOT_FINITE}, of every candidate."
        return True

    def _reject(self, num_kept: int) -> None:
        """Reject the worst; those with a score equal to that of the last one that is kept stay."""
        if len(self.running) <= num_kept:
            return
        bar = sorted((standing.score for standing in self.running), reverse=True)[num_kept - 1]
        for standing in self.running:
            if standing.score < bar:
                self._out(standing)
        self.running = [standing for standing in self.running if standing.rejected_in is None]

    def _out(self, standing: Standing, reason: str = "") -> None:
        standing.rejected_in, standing.reason = self.num_rounds, reason

    def _result(self) -> Rejects:
        winner, *tied = sorted(self.running, key=lambda standing: (-standing.score, self.tie_keys[standing.number]))
        for standing in tied:
            self._out(standing, TIED if standing.score == winner.score else "")
        winner.rejected_in, winner.reason = None, ""
        others = [standing for standing in self.all if standing is not winner]
        others.sort(key=self._place)
        return Rejects(
            (winner, *others),
            self.num_rounds,
            sum(len(standing.returns) for standing in self.all),
            sum(standing.num_env_steps for standing in self.all),
            self.note,
        )

    def _place(self, standing: Standing) -> tuple[int, bool, float, tuple[int, ...]]:
        score = standing.score if math.isfinite(standing.score) else -math.inf
        return (-(standing.rejected_in or 0), standing.failed, -score, self.tie_keys[standing.number])
