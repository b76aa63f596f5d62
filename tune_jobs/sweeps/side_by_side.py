"""Whole sweeps side by side: how they compare, how each rose and learnt, and what their sweep files say differently."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from analysis.best_records import BestRecord
from analysis.best_so_far import BestSoFar, best_so_far, has_evaluations
from analysis.comparison.compare import Comparison, why_not_comparable
from analysis.comparison.compare import compare as compare_all
from analysis.comparison.entries import Entry, Wanted, judged_alike
from analysis.comparison.wording import fact_rows, pair_lines
from analysis.exports.frames import ranked_settings
from analysis.statistics import episodes_interval
from analysis.wording import PLAIN_NONE, counted, interval_text, return_text
from policies import random_streams
from policies.errors import NotFoundError, SpecError
from tune_jobs.spec.differences import Difference, differences
from tune_jobs.store.candidates import readable_trials
from tune_jobs.sweeps.compare import wanted_sweep
from tune_jobs.sweeps.current_best import has_best_to_show
from tune_jobs.sweeps.status import status_of

if TYPE_CHECKING:
    from tune_jobs.store.contract import Sweep

MAX_SWEEPS = 6


@dataclass(frozen=True)
class Fact:
    """A row of the table of sweeps."""

    title: str
    cells: tuple[str, ...]
    """One a sweep."""


@dataclass(frozen=True)
class Verdict:
    """Whether one of two sweeps is better."""

    verdict: str
    lines: tuple[str, ...]


@dataclass(frozen=True)
class Learning:
    """How the leading setting of a sweep learns: the mean over its training seeds, and its pointwise 95 % interval."""

    letter: str
    num_seeds: int
    """Those that it is of."""
    num_without: int
    """Seeds that showed no such return, as those that failed before their first evaluation; it is not of them."""
    num_env_steps: tuple[float, ...]
    """Env steps of a trial."""
    mean: tuple[float, ...]
    lower: tuple[float, ...] | None
    """Within what any seed had; None: one seed a setting."""
    upper: tuple[float, ...] | None


@dataclass(frozen=True)
class SideBySide:
    """Sweeps side by side. Lists have one item a sweep, in the order in which they were named."""

    comparison: Comparison
    facts: tuple[Fact, ...]
    verdicts: tuple[Verdict, ...]
    goal: float | None
    """The return that solves the environment, if they have the same one."""
    returns: Literal["evaluation", "training"]
    """Which returns the curves are of: greedy evaluations where all sweeps have some."""
    best_so_far: tuple[BestSoFar, ...]
    learning: tuple[Learning, ...]
    """Of those sweeps whose leading setting is known and has shown a return."""
    differences: tuple[Difference, ...]
    """What their sweep files say differently."""


def check_comparable(stores: Sequence[Sweep]) -> None:
    """Check what is known without reading the results of any trial.

    Raises:
        SpecError: These are not from two to six sweeps, one is named twice, or they are on different environments.
        NotFoundError: There is no such sweep.
    """
    names = [store.name for store in stores]
    if twice := sorted(name for name, times in Counter(names).items() if times > 1):
        raise SpecError(f"{twice[0]} was named twice: there is nothing to compare.", "Name different sweeps.")
    if not 2 <= len(stores) <= MAX_SWEEPS:
        raise SpecError(
            f"{counted(len(stores), 'sweep')} {'was' if len(stores) == 1 else 'were'} given to be compared.",
            f"Give from 2 to {MAX_SWEEPS}.",
        )
    if reasons := why_not_comparable([store.read_record() for store in stores], names):
        raise SpecError(
            " ".join(reasons), "Compare sweeps of one environment; `tune-jobs compare` shows each of others by itself."
        )


def side_by_side(stores: Sequence[Sweep]) -> SideBySide:
    """Compare whole sweeps, running ones by what they have so far.

    Raises:
        SpecError: See `check_comparable`.
        NotFoundError: There is no such sweep.
        CheckpointError: The record of a sweep or of a trial is damaged.
    """
    check_comparable(stores)
    wanted = [wanted_sweep(store) for store in stores]
    comparison = compare_all(wanted)
    evaluated = all(has_evaluations(item.data.results) for item in wanted)
    thresholds = {item.data.threshold for item in wanted}
    curves = (
        _learning(entry, item, evaluated=evaluated) for entry, item in zip(comparison.entries, wanted, strict=True)
    )
    return SideBySide(
        comparison=comparison,
        facts=(*_own_facts(stores), *(Fact(title, tuple(cells)) for title, cells in fact_rows(comparison))),
        verdicts=tuple(Verdict(verdict, tuple(lines)) for verdict, lines in pair_lines(comparison)),
        goal=thresholds.pop() if len(thresholds) == 1 else None,
        returns="evaluation" if evaluated else "training",
        best_so_far=tuple(
            best_so_far(
                [trial for trial in item.data.trials if trial.status != "pending"],
                item.data.results,
                evaluated=evaluated,
            )
            for item in wanted
        ),
        learning=tuple(curve for curve in curves if curve is not None),
        differences=tuple(differences([item.sweep.spec for item in wanted])),
    )


def _own_facts(stores: Sequence[Sweep]) -> list[Fact]:
    """Return what `compare` doesn't tell: how far each sweep is, and how its policy to deploy fares."""
    policies = tuple(_policy_text(store) for store in stores)
    return [
        Fact("state", tuple(status_of(store, store.read_record(), ()).state for store in stores)),
        *([Fact("policy to deploy", policies)] if any(text != PLAIN_NONE for text in policies) else []),
    ]


def _policy_text(store: Sweep) -> str:
    """Return the return of the policy to deploy on fresh episodes, with its interval over these."""
    if not has_best_to_show(store, store.read_record(), readable_trials(store)):
        return PLAIN_NONE
    try:
        best: BestRecord = store.read_best()
    except NotFoundError:
        return PLAIN_NONE
    confirmed = best.confirmation
    if not math.isfinite(confirmed.mean_return):
        return PLAIN_NONE
    text = return_text(confirmed.mean_return)
    # Episodes that are all alike say nothing of how others would differ.
    if len(set(confirmed.returns)) > 1:
        interval = episodes_interval(confirmed.returns, rng=random_streams.fixed())
        text += f" ({interval_text(interval)} with 95 %)"
    solved = "" if confirmed.solved is None else ", solved" if confirmed.solved else ", not solved"
    return f"{text} over {counted(confirmed.num_episodes, 'fresh episode')}{solved}"


def _learning(entry: Entry, wanted: Wanted, *, evaluated: bool) -> Learning | None:
    import numpy as np

    from analysis.exports.paper import curves_of

    data = judged_alike(wanted, entry.objective, entry.threshold).data
    item = next((one for one in ranked_settings(data) if one.point_index == entry.point_index), None)
    found = [] if item is None else curves_of(data, [item], returns="evaluation" if evaluated else "training")
    if not found:
        return None
    curve = found[0]
    lower = upper = None
    if curve.lower is not None and curve.upper is not None:
        # A band of few seeds goes beyond any return there can be.
        low, high = np.clip([curve.lower, curve.upper], curve.least, curve.most)
        lower, upper = tuple(low.tolist()), tuple(high.tolist())
    steps, mean = curve.num_env_steps.tolist(), curve.mean.tolist()
    return Learning(entry.letter, curve.num_seeds, curve.num_without, tuple(steps), tuple(mean), lower, upper)
