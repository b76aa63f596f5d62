"""By `steps_to_threshold` a seed that never reaches it counts as a number of env steps, which is told as such."""

from typing import Any

import pytest
from compared_sweeps import wanted
from test_what_seeds_say import about, source_of

from analysis.answers import setting_score
from analysis.comparison.compare import compare
from analysis.exports.latex import latex_table
from analysis.page.source import Source
from analysis.records import TRAINING_LENGTH, Objective
from analysis.settings import judge_settings
from tests.narrowing import present

STEPS: Objective = "steps_to_threshold"
TOLD = {
    (100.0, 20.0, 30.0): "2 of 3 seeds never reached it, which counts as 100,000",
    (20.0,): "its seed never reached it, which counts as 100,000",
}
FOOTNOTE = "A seed that never reaches the threshold counts as 100,000 env steps, twice the longest training."


def by_steps(*points: list[float], **given: Any) -> Source:
    return source_of(*points, objective=STEPS, threshold=50.0, **given)


@pytest.mark.parametrize("scores", TOLD)
def test_a_score_tells_how_many_of_its_seeds_are_counted_so(scores: tuple[float, ...]) -> None:
    assert TOLD[scores] in setting_score(present(by_steps(list(scores)).settings))


def test_the_page_tells_what_such_a_seed_counts_as_where_there_is_one() -> None:
    assert FOOTNOTE in about(by_steps([100.0, 90.0], [80.0, 20.0]))
    assert "counts as" not in about(by_steps([100.0, 90.0], [80.0, 70.0]))
    assert "counts as" not in about(source_of([100.0, 90.0], [80.0, 20.0]))


def test_a_table_for_a_paper_tells_it_too() -> None:
    source = by_steps([100.0, 90.0], [80.0, 20.0])
    assert "A seed that never reaches it counts as 100000, twice the longest training." in table(source)
    assert "counts as" not in table(by_steps([100.0, 90.0], [80.0, 70.0]))


def table(source: Source) -> str:
    from analysis.exports.frames import SweepData

    data = SweepData(source.trials, source.results, STEPS, num_env_steps=50_000, threshold=50.0)
    return latex_table(data, name="mine", env_id="CartPole-v1")


def test_a_comparison_tells_it_where_there_is_one() -> None:
    told = "One that never reaches the threshold counts as 100,000 env steps, twice the longest."

    def notes(*scores: float) -> str:
        both = [wanted(name, list(scores), objective=STEPS, threshold=50.0) for name in "ab"]
        return " ".join(compare(both).notes)

    assert told in notes(80.0, 20.0)
    assert "counts as" not in notes(80.0, 70.0)


def test_nothing_is_told_of_scores_that_are_returns_or_of_a_former_record() -> None:
    by_returns = present(source_of([100.0, 20.0]).settings)
    assert (by_returns.never_reached, "never" in setting_score(by_returns)) == (None, False)
    settings = present(by_steps([20.0]).settings)
    assert settings.never_reached == 100_000
    assert "never" not in setting_score(settings.model_copy(update={"never_reached": None}))


def test_the_longest_training_is_that_of_the_trials() -> None:
    """Of a sweep whose points have lengths of their own, too: whoever trains less counts as much."""
    source = by_steps([20.0], [100.0])
    trials = [
        trial.model_copy(update={"point": {TRAINING_LENGTH: steps}})
        for trial, steps in zip(source.trials, (1_000, 30_000), strict=True)
    ]
    settings = present(judge_settings(trials, source.results, STEPS, num_env_steps=50_000, threshold=50.0))
    assert settings.never_reached == 60_000
    assert list(map(settings.num_never, settings.ranking)) == [0, 1]
