"""What compare, importance and reproduce answer, with numbers that JSON lacks and texts that look like markup."""

import math

from analysis.comparison.compare import Comparison
from analysis.comparison.entries import Entry
from analysis.comparison.pairs import Pair
from analysis.comparison.repetition import Changed, Repetition
from analysis.importance.answer import Effect, Importance, Level, WhatMattered
from analysis.statistics import Estimate


def entry(letter: str, name: str, mean: float) -> Entry:
    return Entry(
        letter=letter, name=name, sweep=name, is_sweep=True, algorithm="ppo", env_id="CartPole-v1", objective="final",
        point_index=0, point={"lr": 3e-5, "note": "[bold]x[/bold]"}, trial_ids=("t0000", "t0001"),
        scores=(mean, mean), num_failed=0, num_solved=2, mean=mean, lower=mean - 1.0, upper=mean + 1.0, iqm=mean,
        standard_error=0.5, df=math.inf, threshold=195.0, median_env_steps=None, median_lower=None, median_upper=None,
        num_settings=1, num_trials=2, num_env_steps=20_480, core_seconds=12.5, wall_s=None,
    )  # fmt: skip


COMPARISON = Comparison(
    entries=(entry("A", "mine", 190.0), entry("B", "other", 120.0)),
    pairs=(
        Pair(
            "A", "B", Estimate(0.9, 0.6, 1.0, 4), "", Estimate(70.0, 60.0, 80.0, 4), "", None,
            "they searched other hyperparameters",
        ),
    ),
    objective="final",
    not_comparable=(),
    notes=("Their spaces are others.",),
)  # fmt: skip

IMPORTANCE = WhatMattered(
    objective="final",
    num_points=12,
    num_trials=24,
    hyperparams=(Importance("lr", 0.4, 0.2, 0.6, is_clear=True), Importance("gamma", None, None, None, is_clear=False)),
    effects=(
        Effect(
            "lr",
            (Level("0.01", 0.01, 6, 190.0, 188.0, 180.0, 196.0), Level("0.1", 0.1, 6, math.nan, None, None, None)),
        ),
    ),
    notes=("Judged at [5,000] env steps.",),
)  # fmt: skip

EQUAL = Repetition(
    name="mine/t0001", num_iterations=6, num_compared=6, first_difference=None, differences=(), num_equal_weights=2,
    num_other_weights=0, causes=(), notes=("[dim]A note.[/dim]",),
)  # fmt: skip
DIFFERENT = Repetition(
    name="mine/t0001", num_iterations=6, num_compared=6, first_difference=4,
    differences=(Changed("training_return", "20.0", "nan"),), num_equal_weights=0, num_other_weights=1,
    causes=(Changed("cpu", "One", "Another"),), notes=(),
)  # fmt: skip
