"""The benchmark of the choice itself: on made tasks it says what is known of them, and its data and page are whole."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.choice.calibration import by_bin, calibrate
from tests.benchmarks.choice.collecting import DATA, task_names
from tests.benchmarks.choice.named import named_settings
from tests.benchmarks.choice.regret import RULES, Rule, regrets
from tests.benchmarks.choice.rules import SCORES, MeanOfSeeds, Seeds
from tests.benchmarks.choice.trained import Floats, Task, read_task

PAGE = Path(__file__).parents[2] / "docs" / "choice.md"


def made(means: Floats, noise: float, *, num_seeds: int = 20) -> Task:
    """A task in which a training shows its setting's mean plus its own noise, from start to end."""
    rng = np.random.default_rng(0)
    shown = means[:, None] + noise * rng.standard_normal((len(means), num_seeds))
    flat = np.repeat(shown[:, :, None], 6, axis=2)
    steps = np.broadcast_to(np.arange(1_000.0, 6_001.0, 1_000.0), flat.shape)
    return Task(
        name="made",
        points=tuple({"lr": value} for value in means.tolist()),
        num_env_steps=steps,
        training_returns=flat,
        iteration_returns=flat,
        num_episodes=np.full(flat.shape, 5.0),
        evaluated_at=steps[0, 0],
        evaluations=flat,
    )


def test_where_seeds_do_not_differ_no_rule_loses_anything() -> None:
    found = regrets(made(np.arange(10.0), 0.0), 3)
    assert [item.mean for item in found] == pytest.approx([0.0] * len(RULES))


def test_more_seeds_help_where_seeds_differ() -> None:
    means = np.concatenate([np.zeros(19), [2.5]])
    one, three = (regrets(made(means, 1.0), 200, rules=(rule,))[0] for rule in _final((1, 3)))
    assert three.mean < one.mean - 3 * max(one.standard_error, three.standard_error)
    assert (one.num_trainings, three.num_trainings) == (20, 60)


def _final(seeds: tuple[float, ...]) -> tuple[Rule, ...]:
    return tuple(rule for count in seeds for rule in RULES if rule.score == "final" and rule.way == MeanOfSeeds(count))


def test_seeds_that_were_trained_are_not_those_that_a_choice_is_judged_by() -> None:
    scores = SCORES["final"](made(np.arange(4.0), 1.0))
    seeds = Seeds(scores, np.random.default_rng(0))
    seeds.train([2, 2, 0])
    assert [len(item) for item in seeds.shown()] == [1, 0, 2, 0]
    unseen = scores[2, seeds.unseen(2)]
    assert len(unseen) == 18
    assert not set(seeds.shown()[2]) & set(unseen.tolist())


def test_normal_scores_are_covered_as_stated() -> None:
    found = calibrate(made(np.linspace(0, 3, 20), 1.0), 5, 60)
    # 1,200 intervals, of 20 settings: more than four standard errors, were they independent.
    assert 0.92 < found.coverage < 0.98
    assert sum(count for _, count, _, _ in by_bin([found])) == 600


def test_the_score_of_a_setting_that_is_named_is_flattered_and_the_expected_one_less() -> None:
    alike = named_settings(made(np.linspace(0, 0.5, 20), 1.0), 100)
    assert alike.score_gaps.mean() > 1.0
    assert abs(alike.expected_gaps.mean()) < alike.score_gaps.mean() / 2
    # Where settings differ far more than seeds, the choice flatters nobody.
    apart = named_settings(made(np.arange(20.0) * 20, 1.0), 100)
    assert abs(apart.score_gaps.mean()) < 0.01
    assert apart.coverage > alike.coverage


def test_every_task_was_trained_with_twenty_seeds_of_twenty_settings() -> None:
    names = sorted(path.stem for path in DATA.glob("*.parquet"))
    assert names == task_names()
    assert len(names) >= 8
    for name in names:
        task = read_task(name)
        assert task.shape == (20, 20)
        about = json.loads((DATA / f"{name}.json").read_text())
        assert about["machine"]
        assert about["date"]
        assert len(about["points"]) == 20


def test_the_page_has_the_tables_of_all_tasks() -> None:
    text = PAGE.read_text()
    for name in task_names():
        assert len(re.findall(rf"\| {name} \|", text)) >= 3, name
