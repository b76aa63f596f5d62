"""Successive rejects: who plays how much, who is rejected when, and what it may cost."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from analysis.statistics import t_interval
from analysis.successive_rejects import NOT_FINITE, TIED, Played, Rejects, Standing, successive_rejects
from policies.acting.evaluate import Episodes
from policies.errors import EnvFailedError, NonFiniteWeightsError

Returns = Callable[[int, int], float]


class Player:
    """Plays episodes by a formula: the return of candidate i in episode j; keeps what it was asked for."""

    def __init__(self, returns: Returns, length: int = 10) -> None:
        self.returns, self.length = returns, length
        self.asked: list[tuple[list[int], int, int]] = []

    def __call__(self, numbers: Sequence[int], first: int, count: int) -> list[Played]:
        self.asked.append((list(numbers), first, count))
        played: list[Played] = []
        for number in numbers:
            values = tuple(self.returns(number, index) for index in range(first, first + count))
            played.append(Episodes(tuple(range(first, first + count)), values, (self.length,) * count))
        return played


def run(
    player: Callable[[Sequence[int], int, int], Sequence[Played]],
    first_means: Sequence[float],
    *,
    max_episodes: int = 10_000,
    max_env_steps: int = 10**9,
    steps: Sequence[int] | None = None,
    num_first: int = 10,
) -> Rejects:
    keys = [(number,) for number in (steps or range(len(first_means)))]
    return successive_rejects(
        first_means, num_first, keys, player, max_episodes=max_episodes, max_env_steps=max_env_steps
    )


def order(rejects: Rejects) -> list[int]:
    return [standing.number for standing in rejects.standings]


def test_the_rounds_are_those_of_the_paper() -> None:
    """n_k = ceil((n - K) / (L (K + 1 - k))) with L = 1/2 + 1/2 + 1/3 + 1/4, here of 400 episodes for 4 policies."""
    rejects = run(Player(lambda number, _: -float(number)), [0.0] * 4, max_episodes=400)
    weight = 0.5 + 1 / 2 + 1 / 3 + 1 / 4
    lengths = [math.ceil((400 - 4) / (weight * (4 + 1 - number))) for number in (1, 2, 3)]
    assert [len(standing.returns) for standing in rejects.standings] == [lengths[2], lengths[2], lengths[1], lengths[0]]
    assert [standing.rejected_in for standing in rejects.standings] == [None, 3, 2, 1]
    assert order(rejects) == [0, 1, 2, 3]
    assert rejects.num_rounds == 3
    assert rejects.num_episodes == sum(len(standing.returns) for standing in rejects.standings) <= 400


def test_all_play_the_same_episodes_and_none_twice() -> None:
    player = Player(lambda number, index: -float(number) + math.sin(index))
    run(player, [0.0] * 5)
    seen: dict[int, list[int]] = {}
    for numbers, first, count in player.asked:
        for number in numbers:
            seen.setdefault(number, []).extend(range(first, first + count))
    for episodes in seen.values():
        assert episodes == list(range(len(episodes)))


def test_more_episodes_find_the_better_one_though_the_other_led_by_luck() -> None:
    rejects = run(Player(lambda number, index: (0.9, 1.0)[number] + (index % 2)), [2.0, 1.0], num_first=1)
    assert order(rejects) == [1, 0]


def test_the_evaluation_counts_as_its_episodes() -> None:
    rejects = run(Player(lambda *_: 4.0), [1.0, 0.0], max_episodes=60)
    winner = rejects.standings[0]
    num = len(winner.returns)
    assert winner.num_episodes == 10 + num
    assert winner.score == pytest.approx((10 * 1.0 + num * 4.0) / (10 + num))


def test_env_steps_decide_an_exact_tie_only_when_no_episode_is_left() -> None:
    """The one with more env steps is better in one episode, the last: an early tie must not reject it."""

    def returns(number: int, index: int) -> float:
        return 200.0 - (number == 1 and index == 150)

    rejects = run(Player(returns), [200.0] * 3, max_episodes=600, steps=[30, 10, 20])
    assert [len(standing.returns) for standing in rejects.standings] == [200, 200, 200]
    assert order(rejects) == [2, 0, 1]
    assert [standing.reason for standing in rejects.standings] == ["", TIED, ""]


def test_env_steps_of_all_are_within_the_budget_though_good_episodes_are_long() -> None:
    class Longer(Player):
        def __call__(self, numbers: Sequence[int], first: int, count: int) -> list[Played]:
            return [
                Episodes(played.seeds, played.returns, (20 + 20 * number,) * count)
                for number, played in zip(numbers, super().__call__(numbers, first, count), strict=True)
                if isinstance(played, Episodes)
            ]

    rejects = run(Longer(lambda number, _: float(number)), [0.0] * 8, max_env_steps=20_000)
    assert 0.8 * 20_000 < rejects.num_env_steps <= 20_000
    assert order(rejects)[0] == 7
    assert len(rejects.standings[0].returns) > 2 * len(rejects.standings[-1].returns)


def test_a_first_episode_that_is_short_does_not_make_the_round_cost_many_times_the_budget() -> None:
    class Varied(Player):
        def __call__(self, numbers: Sequence[int], first: int, count: int) -> list[Played]:
            lengths = tuple(500 if index % 10 else 10 for index in range(first, first + count))
            return [
                Episodes(played.seeds, played.returns, lengths)
                for played in super().__call__(numbers, first, count)
                if isinstance(played, Episodes)
            ]

    player = Varied(lambda number, _: float(number))
    rejects = run(player, [0.0] * 2, max_episodes=200, max_env_steps=20_000)
    assert 0.8 * 20_000 < rejects.num_env_steps < 1.1 * 20_000
    assert len(player.asked) <= 6
    # Where episodes are equally long it is as many as the first makes expect: 20,000 env steps are 40 episodes.
    rejects = run(Player(lambda number, _: float(number), 500), [0.0] * 2, max_episodes=200, max_env_steps=20_000)
    assert rejects.num_episodes == 2 * (40 - 2) // 2


@pytest.mark.parametrize("budget", [{"max_episodes": 0}, {"max_env_steps": 0}])
def test_without_a_budget_the_evaluation_decides_and_nothing_is_played(budget: dict[str, int]) -> None:
    player = Player(lambda *_: 0.0)
    rejects = run(player, [1.0, 2.0, 2.0], steps=[0, 9, 8], **budget)
    assert player.asked == []
    assert order(rejects) == [2, 1, 0]
    assert rejects.num_env_steps == 0


def test_one_candidate_plays_nothing() -> None:
    player = Player(lambda *_: 0.0)
    rejects = run(player, [3.0])
    assert (player.asked, order(rejects), rejects.num_rounds) == ([], [0], 0)
    assert rejects.standings[0].interval() is None


def test_a_candidate_whose_episodes_fail_is_rejected_with_the_reason() -> None:
    class Failing(Player):
        def __call__(self, numbers: Sequence[int], first: int, count: int) -> list[Played]:
            played = super().__call__(numbers, first, count)
            return [
                NonFiniteWeightsError("NaN in layer 0") if n == 0 else p for n, p in zip(numbers, played, strict=True)
            ]

    rejects = run(Failing(lambda number, _: -float(number)), [9.0, 8.0, 7.0])
    assert order(rejects) == [1, 2, 0]
    assert (rejects.standings[-1].reason, rejects.standings[-1].failed) == ("NaN in layer 0", True)
    assert rejects.standings[-1].rejected_in == 1
    assert rejects.note == ""


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_mean_that_is_not_finite_never_wins(bad: float) -> None:
    rejects = run(Player(lambda number, _: bad if number == 0 else 1.0), [9.0, 8.0, 7.0])
    assert order(rejects)[-1] == 0
    assert rejects.standings[-1].reason == NOT_FINITE
    nothing = run(Player(lambda *_: bad), [7.0, 9.0])
    assert nothing.note.endswith("of every candidate.")


def test_where_every_candidate_fails_the_evaluations_decide_and_the_note_says_why() -> None:
    def failing(numbers: Sequence[int], *_: int) -> list[Played]:
        return [EnvFailedError("the motor broke") for _ in numbers]

    rejects = run(failing, [1.0, 2.0])
    assert order(rejects) == [1, 0]
    assert rejects.note == "Round 1 could not be played: the motor broke"


def test_an_env_that_ends_its_process_ends_the_rounds_with_what_is_known() -> None:
    class Dying(Player):
        def __call__(self, numbers: Sequence[int], first: int, count: int) -> list[Played]:
            if len(numbers) < 4:
                raise EnvFailedError("it was ended by SIGSEGV")
            return super().__call__(numbers, first, count)

    rejects = run(Dying(lambda number, _: float(number)), [0.0] * 4)
    assert order(rejects) == [3, 2, 1, 0]
    assert rejects.note == "Round 2 could not be played: it was ended by SIGSEGV"


def test_the_interval_is_students_where_the_first_evaluation_weighs_nothing() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, size=40).tolist()
    standing = Standing(0, 0.0, 0, values)
    expected = t_interval(values)
    assert standing.interval() == pytest.approx((expected.lower, expected.upper))
    # The first episodes make it narrower, though only their mean is known.
    wider = standing.interval()
    more = Standing(0, standing.score, 40, values).interval()
    assert wider is not None
    assert more is not None
    assert more[1] - more[0] == pytest.approx((wider[1] - wider[0]) / math.sqrt(2))


def test_later_episodes_that_are_all_equal_say_nothing_where_the_first_ones_were_not() -> None:
    """As on FrozenLake: two of ten reached the goal, then none of 35. "All equal" was said of their score, 0.044."""
    assert Standing(0, 0.2, 10, [0.0] * 35).interval() is None
    mean = sum([-0.1] * 7) / 7
    assert mean != -0.1
    assert Standing(0, mean, 7, [-0.1] * 5).interval() == pytest.approx((-0.1, -0.1))
    assert Standing(0, 0.2, 0, [0.0] * 35).interval() == (0.0, 0.0)


def found_best(seed: int) -> tuple[bool, bool]:
    """Whether ten evaluation episodes find the best of sixteen policies of means 0 to 1.5, and whether more do."""
    rng = np.random.default_rng(seed)
    means = rng.permutation(16) / 10
    noise = rng.normal(size=(16, 800))
    first = means + rng.normal(size=16) / math.sqrt(10)
    rejects = run(
        Player(lambda number, index: float(means[number] + noise[number, index])), first.tolist(), max_episodes=1600
    )
    return bool(means[first.argmax()] == 1.5), bool(means[order(rejects)[0]] == 1.5)


def test_the_best_of_many_noisy_candidates_is_found_more_often_than_by_the_evaluation() -> None:
    by_evaluation, by_more = zip(*map(found_best, range(60)), strict=True)
    assert sum(by_more) > sum(by_evaluation) + 15
