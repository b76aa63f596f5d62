"""What the report says of what mattered."""

import numpy as np
import pytest
from synthetic_sweep import make_points, make_sweep

from analysis.importance import what_mattered
from analysis.importance.words import listed, score_interval, score_text, sentences
from analysis.page.mattered import Mattered, section
from analysis.page.source import Source
from analysis.wording import NONE


def mattered(num_samples: int, objective: str = "final") -> Mattered:
    made = make_sweep(points=make_points(num_samples, np.random.default_rng(1)), failed=[2])
    made.sweep.spec["objective"] = {"type": objective}
    return section(Source("s", made.sweep, made.trials, made.results, made.best, goal=195.0))


@pytest.fixture(scope="module")
def large() -> Mattered:
    return mattered(20)


def test_it_begins_with_what_mattered_most(large: Mattered) -> None:
    assert large.sentences[0].startswith("How points rank depends most on activation, which accounts for ")
    assert any(sentence.startswith("1 trial counted as the worst, having failed") for sentence in large.sentences)


def test_every_hyperparameter_has_a_bar_and_its_interval(large: Mattered) -> None:
    assert [bar.name for bar in large.bars] == ["activation", "lr", "hidden_sizes"]
    for bar in large.bars:
        assert bar.low <= bar.place <= bar.low + bar.width <= 100.0
        assert bar.share == f"{bar.place:.0f} %"
        assert bar.verdict == ("mattered" if bar.is_clear else "may be chance")


def test_every_value_of_what_mattered_has_a_row(large: Mattered) -> None:
    rows = [[cell.text for cell in row] for row in large.clear.table.rows]
    assert {tuple(row[:3]) for row in rows} >= {("activation", "linear", "40"), ("activation", "relu", "40")}
    assert large.clear.what == "return in the later half of training"
    known = {row[0] for row in rows} | {row[0].text for row in large.others.table.rows}
    assert known == {"activation", "lr", "hidden_sizes"}


def test_few_points_are_said_to_be_few() -> None:
    few = mattered(1)
    assert few.sentences[0] == "4 points are too few to say what mattered; 8 may be enough."
    assert few.bars == []
    assert {row[0].text for row in few.clear.table.rows} == {"activation", "lr", "hidden_sizes"}
    assert all(row[4].text == NONE for row in few.clear.table.rows)


def test_env_steps_are_shown_as_such() -> None:
    told = mattered(20, "steps_to_threshold")
    assert told.clear.what == "env steps to the threshold"
    means = [row[3] for row in told.clear.table.rows]
    assert all(cell.value < 0 and not cell.text.startswith("-") for cell in means)
    assert score_text(-1234.4, "steps_to_threshold") == "1,234"
    assert score_interval(-2000.0, -1000.0, "steps_to_threshold") == "1,000 to 2,000"
    assert score_interval(1.0, 2.0, "final") == "1.0 to 2.0"


def test_names_in_a_sentence() -> None:
    assert [listed(["a"], "or"), listed(["a", "b", "c"], "and")] == ["a", "a, b and c"]


def test_a_sweep_without_a_space_says_nothing() -> None:
    made = make_sweep(points=[{}, {}])
    made.sweep.spec["space"] = {}
    assert section(Source("s", made.sweep, made.trials, made.results, made.best, goal=None)).sentences == []
    assert sentences(what_mattered(made.sweep, made.trials, made.results)) != []
