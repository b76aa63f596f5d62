"""Two of the things compared: whether one is better, by how much, and how sure that is."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from analysis.comparison.entries import Entry, Wanted
from analysis.exports.frames import ranked_settings
from analysis.first_seeds import first_seeds
from analysis.points import meaning_of
from analysis.records import TRAINING_LENGTH, SweepRecord
from analysis.statistics import Estimate, iqm, iqm_with_ci, probability_of_improvement, t_quantile
from analysis.wording import counted, setting_text
from policies import random_streams
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM

_MOST_NAMED = 3


@dataclass(frozen=True)
class Shared:
    """The settings that two sweeps have in common, each a stratum; points of a sweep with equal values are one.

    A setting is all that a training has of hyperparameters, fixed ones and defaults too. Of each those seeds count that
    all settings of its sweep have, see `first_seeds`: a sweep that gave its leading ones more is neither the better nor
    the worse for it.
    """

    num_settings: int
    probability: Estimate
    """P(a training of the left sweep scores more than one of the right, with the same setting), of all these seeds."""
    left_iqm: Estimate
    """Interquartile mean of trainings with these settings; its ends are NaN where each has one seed.

    Of each setting as many seeds count as both sweeps have, the first ones, so that both weigh settings alike."""
    right_iqm: Estimate


@dataclass(frozen=True)
class Pair:
    """Two entries, by their letters."""

    left: str
    right: str
    probability: Estimate | None
    """P(a training with the left one's setting scores more than one with the right one's); ties count half."""
    why_no_probability: str
    difference: Estimate | None
    """The left mean less the right one, over training seeds."""
    why_no_difference: str
    shared: Shared | None
    """None: they are not two sweeps, or have no setting in common."""
    why_none_shared: str

    @property
    def verdict(self) -> str:
        """Which of them is better, as far as the data say."""
        if self.difference is None:
            return f"Whether {self.left} or {self.right} is better can't be said: {self.why_no_difference}."
        if self.difference.lower > 0:
            return f"{self.left} is better than {self.right}."
        if self.difference.upper < 0:
            return f"{self.right} is better than {self.left}."
        return f"The data can't tell {self.left} from {self.right}."


def make_pair(left: Entry, right: Entry, wanted: Mapping[str, Wanted], *, level: float = 0.95) -> Pair:
    """Compare two entries, whose scores are on one scale.

    Args:
        left: One of them.
        right: The other.
        wanted: What they were made of, by letter.
        level: That of all intervals.
    """
    of_one_sweep = wanted[left.letter].origin == wanted[right.letter].origin
    if why := _why_the_same(left, right) if of_one_sweep else "":
        return Pair(left.letter, right.letter, None, why, None, why, None, "")
    probability, why_no_probability = _probability(left, right, level)
    difference, why_no_difference = mean_difference(left, right, level, of_one_sweep=of_one_sweep)
    shared, why_none_shared = None, ""
    if left.is_sweep and right.is_sweep:
        shared, why_none_shared = _shared(wanted[left.letter], wanted[right.letter], level)
    return Pair(
        left.letter, right.letter, probability, why_no_probability, difference, why_no_difference, shared,
        why_none_shared,
    )  # fmt: skip


def _why_the_same(left: Entry, right: Entry) -> str:
    """Return why two entries of a sweep are the same trainings; empty if they aren't."""
    if not left.trial_ids or left.trial_ids != right.trial_ids:
        return ""
    sweep, setting = (left, right) if left.is_sweep else (right, left)
    return f"{sweep.letter} is compared by its leading setting, and that is {setting.letter}"


def _without_scores(left: Entry, right: Entry) -> str:
    missing = [entry.letter for entry in (left, right) if not entry.scores]
    return f"{' and '.join(missing)} {'has' if len(missing) == 1 else 'have'} no scores" if missing else ""


def _probability(left: Entry, right: Entry, level: float) -> tuple[Estimate | None, str]:
    if why := _without_scores(left, right):
        return None, why
    single = [entry.letter for entry in (left, right) if len(entry.scores) < 2]
    if single:
        return None, f"{' and '.join(single)} {'has' if len(single) == 1 else 'have'} one seed"
    return probability_of_improvement([left.scores], [right.scores], level=level), ""


def _without_errors(left: Entry, right: Entry) -> str:
    """Return why nothing is known of how much seeds differ where several do not; empty if it is."""
    alike = [entry.letter for entry in (left, right) if entry.standard_error == 0.0]
    if not alike:
        return ""
    who = "of either" if len(alike) > 1 else f"of a setting in {alike[0]}'s sweep"
    # A mean is not exact because no seed was seen to differ, as it isn't of one seed.
    return f"no two seeds {who} differ, so nothing is known of how much they may"


def mean_difference(
    left: Entry, right: Entry, level: float = 0.95, *, of_one_sweep: bool = False
) -> tuple[Estimate | None, str]:
    """Return the difference of two means over training seeds with its interval, or why there is none.

    The errors of the means are moderated over the settings of each sweep, as in `statistics.seed_intervals`, and the
    degrees of freedom are those of Welch and Satterthwaite. Of two sweeps with one setting each it is Welch's interval.

    The errors of two settings of one sweep are learnt from the same seeds, where Welch and Satterthwaite take them for
    independent: there are no more degrees of freedom than all its seeds have together. Of a sweep whose settings have
    one common variance it is Student's interval by that variance.

    Args:
        left: One of them.
        right: The other.
        level: The level of the interval.
        of_one_sweep: Whether both are settings of one sweep.

    Source:
        Welch 1947, "The Generalization of Student's Problem when Several Different Population Variances are Involved";
        Smyth 2004 for the variances, see `statistics.moderated_means`.
    """
    if why := _without_scores(left, right):
        return None, why
    errors, means = [], []
    for entry in (left, right):
        if entry.standard_error is None or entry.df is None or entry.mean is None:
            several = len(entry.scores) > 1
            return None, (
                f"the scores of {entry.letter} are too large to be squared"
                if several
                else f"{entry.letter} has one seed a setting, so that nothing is known of how its seeds differ "
                f"(`tune-jobs replicate {entry.sweep}` trains more)"
            )
        errors.append((entry.standard_error, entry.df))
        means.append(entry.mean)
    if why := _without_errors(left, right):
        return None, why
    gap = means[0] - means[1]
    # In units of a power of two, by which nothing is rounded, as the squares of small errors are lost.
    exponent = math.frexp(max(error for error, _ in errors))[1]
    squares = [(math.ldexp(error, -exponent) ** 2, df) for error, df in errors]
    total = sum(square for square, _ in squares)
    num_seeds = len(left.scores) + len(right.scores)
    df = total**2 / sum(square**2 / df for square, df in squares)
    if of_one_sweep and left.sweep_df is not None:
        df = min(df, left.sweep_df)
    half = t_quantile((1.0 + level) / 2.0, max(1.0, df)) * math.ldexp(math.sqrt(total), exponent)
    return Estimate(gap, gap - half, gap + half, num_seeds), ""


def _shared(left: Wanted, right: Wanted, level: float) -> tuple[Shared | None, str]:
    """Compare two sweeps within the settings that both have trained, or say why that can't be done."""
    with_length = any(TRAINING_LENGTH in each.sweep.section("space") for each in (left, right))
    ours, theirs = (_by_meaning(each, with_length=with_length) for each in (left, right))
    if not ours or not theirs:
        return None, ""
    why = _why_other_trainings(left, right)
    common = [] if why else [key for key in ours if key in theirs]
    if not common:
        why = why or (
            f"none of the {counted(len(ours), 'setting')} of {left.name} is among the "
            f"{counted(len(theirs), 'setting')} of {right.name}"
        )
        return None, f"{why}, so only the leading ones are compared"
    left_scores, right_scores = [ours[key] for key in common], [theirs[key] for key in common]
    both = [min(len(left), len(right)) for left, right in zip(left_scores, right_scores, strict=True)]
    return Shared(
        num_settings=len(common),
        probability=probability_of_improvement(left_scores, right_scores, level=level),
        left_iqm=_iqm([scores[:count] for scores, count in zip(left_scores, both, strict=True)], level),
        right_iqm=_iqm([scores[:count] for scores, count in zip(right_scores, both, strict=True)], level),
    ), ""


def _iqm(tasks: list[tuple[float, ...]], level: float) -> Estimate:
    if max(map(len, tasks)) > 1:
        return iqm_with_ci(tasks, rng=random_streams.fixed(), level=level)
    scores = [score for task in tasks for score in task]
    return Estimate(iqm(scores), math.nan, math.nan, len(scores), "one seed a setting: no interval")


def _why_other_trainings(left: Wanted, right: Wanted) -> str:
    """Return why no setting of one sweep can be one of the other's, whatever they search; empty if some may be."""
    ours, theirs = left.sweep, right.sweep
    for name, plain in (("algorithm", ""), ("rl_module", "the built-in network")):
        values = [str(sweep.spec.get(name) or plain) for sweep in (ours, theirs)]
        if values[0] != values[1]:
            return f"{left.name} trains with {values[0]} and {right.name} with {values[1]}"
    searched = {*ours.section("space"), *theirs.section("space")}
    one, other = _unsearched(ours), _unsearched(theirs)
    names = [
        name
        for name in sorted({*one, *other} - searched)
        if meaning_of({name: one.get(name)}) != meaning_of({name: other.get(name)})
    ]
    told = [
        f"{name} is {setting_text(one.get(name))} in {left.name} and {setting_text(other.get(name))} in {right.name}"
        for name in names[:_MOST_NAMED]
    ]
    if more := len(names) - len(told):
        told.append(f"and {more:,} more {'differs' if more == 1 else 'differ'}")
    return ", ".join(told)


def _unsearched(sweep: SweepRecord) -> dict[str, Any]:
    """Return the hyperparameters that a sweep gives all of its trainings: the defaults, and what its file has."""
    known = HYPERPARAMS_BY_ALGORITHM.get(str(sweep.spec.get("algorithm")))
    fields = {} if known is None else known.model_fields
    defaults = {name: field.get_default(call_default_factory=True) for name, field in fields.items()}
    return {**defaults, **sweep.section("hyperparams")}


def _by_meaning(wanted: Wanted, *, with_length: bool) -> dict[str, tuple[float, ...]]:
    """Return the scores of each setting's first seeds; several points may have equal values, or write them otherwise.

    A value that one sweep searches and another has fixed, or by default, is the same value. Seeds are in the order in
    which they came to the sweep.

    Args:
        wanted: The sweep.
        with_length: Whether settings have the length of training, as one of the sweeps compared searches it.
    """
    unsearched = _unsearched(wanted.sweep)
    if with_length:
        unsearched[TRAINING_LENGTH] = wanted.data.num_env_steps
    indices = {trial.trial_id: trial.index for trial in wanted.data.trials}
    seeds: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
    settings = ranked_settings(wanted.data)
    for item, scores in zip(settings, first_seeds(settings, wanted.sweep), strict=True):
        came = [indices[trial_id] for trial_id in item.trial_ids[: len(scores)]]
        seeds[meaning_of({**unsearched, **item.point})] += zip(came, scores, strict=True)
    return {meaning: tuple(score for _, score in sorted(found)) for meaning, found in seeds.items()}
