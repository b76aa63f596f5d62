"""Propose points by a model of the trials that ended: TPE (Bergstra et al. 2011), as Optuna implements it.

The model is built anew from the trial records for every point, so a sweep that is resumed or extended uses all its
results, and nothing is stored besides the records. What the model is given for a point:

- ended: the mean over its seeds of the best evaluation return, which the selection compares too;
- ended early by a scheduler: the same, and how far it got. Such points count as worse than those that ended by
  themselves, and as better the further they got (Optuna's pruned trials);
- failed, or without a finite evaluation: worse than all others;
- still running: a bad score, so that trials that run at the same time are spread out (the constant liar);
- chosen by somebody, with a value that the search could not give: nothing, as the model has no place for it.
"""

from __future__ import annotations

import importlib.util
import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from analysis.records import FINISHED, TrialRecord
from analysis.selection import score_trial
from policies import random_streams
from policies.errors import CannotRunError, SpecError
from tune_jobs.search.chosen_point import outside
from tune_jobs.spec.domains import Domain, Listed, Range, draw_point
from tune_jobs.spec.sweep_spec import SweepSpec

if TYPE_CHECKING:
    import optuna

_ATTEMPTS = 100

Check = Callable[[dict[str, Any]], object]


def check_installed() -> None:
    """Check that Optuna is installed.

    Raises:
        CannotRunError: It isn't installed; the hint says how to install it.
    """
    if importlib.util.find_spec("optuna") is None:
        raise CannotRunError(
            "search.type is tpe, which needs Optuna, and that is not installed.",
            "Install it with `pip install 'tune-jobs[tpe]'`, or set search.type to random.",
        )


def propose_point(spec: SweepSpec, records: Sequence[TrialRecord], drawn_index: int, check: Check) -> dict[str, Any]:
    """Choose the next point to try.

    The same records give the same point. As long as fewer than `search.num_startup_trials` points have ended, the point
    is the random one of its index.

    Args:
        spec: The sweep.
        records: The records of all its trials.
        drawn_index: The index of the point to choose, among those that nobody chose.
        check: Raises SpecError for a point whose values contradict each other; then another is proposed.

    Raises:
        SpecError: None of many proposals is valid.
        CannotRunError: Optuna is not installed.
    """
    check_installed()
    import optuna

    known = _known_trials(spec, records)
    if sum(trial.state.is_finished() for trial in known) < spec.search.num_startup_trials:
        return draw_point(spec.space, drawn_index, spec.seed)
    with warnings.catch_warnings():
        # Optuna 4 warns of arguments that are new in it.
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            seed=random_streams.tpe_seed(spec.seed, drawn_index),
            n_startup_trials=0,
            multivariate=True,
            constant_liar=True,
        )
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        study = optuna.create_study(direction="maximize", sampler=sampler)
        study.add_trials(known)
        return _first_valid(study, spec.space, check)
    finally:
        optuna.logging.set_verbosity(verbosity)


def _first_valid(study: optuna.Study, space: Mapping[str, Domain], check: Check) -> dict[str, Any]:
    import optuna

    distributions = {name: _distribution(domain) for name, domain in space.items()}
    for _ in range(_ATTEMPTS):
        trial = study.ask(fixed_distributions=distributions)
        point = {name: _from_optuna(domain, trial.params[name]) for name, domain in space.items()}
        try:
            check(point)
        except SpecError as error:
            last_error = error
            # A trial without a value counts as worse than all others.
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        else:
            return point
    raise last_error


def _known_trials(spec: SweepSpec, records: Sequence[TrialRecord]) -> list[optuna.trial.FrozenTrial]:
    """Return the points that are chosen, as Optuna's trials."""
    import optuna

    points: defaultdict[int, list[TrialRecord]] = defaultdict(list)
    for record in records:
        if record.has_point:
            points[record.point_index].append(record)
    distributions = {name: _distribution(domain) for name, domain in spec.space.items()}
    states = optuna.trial.TrialState
    known = []
    for index in sorted(points):
        members = points[index]
        if outside(spec.space, members[0].point):
            continue
        told: dict[str, Any] = {"state": states.RUNNING}
        if all(record.status in FINISHED for record in members):
            score, level = _score(members), _level(spec, members)
            if score is None:
                told = {"state": states.PRUNED}
            elif level is None:
                told = {"state": states.COMPLETE, "value": score}
            else:
                told = {"state": states.PRUNED, "intermediate_values": {level: score}}
        elif all(record.status == "pending" for record in members):
            continue  # planned, but not begun
        point = members[0].point
        params = {name: _to_optuna(domain, point[name]) for name, domain in spec.space.items()}
        known.append(optuna.trial.create_trial(params=params, distributions=distributions, **told))
    return known


def _score(members: Sequence[TrialRecord]) -> float | None:
    """Return the mean score over a point's seeds; None if one of them failed or was never evaluated."""
    scores = [scored.score for record in members if (scored := score_trial(record)) is not None]
    return sum(scores) / len(scores) if len(scores) == len(members) else None


def _level(spec: SweepSpec, members: Sequence[TrialRecord]) -> int | None:
    """Return the rung that the first trial ended by a scheduler reached; None if the scheduler ended none."""
    steps = [record.num_env_steps for record in members if record.status == "stopped"]
    if not steps:
        return None
    # Trials end at a rung with slightly different env steps, which must not make a difference.
    rungs = math.log(max(1.0, min(steps) / spec.grace_env_steps), spec.scheduler.reduction_factor)
    return int(rungs + 1e-9)


def _distribution(domain: Any) -> optuna.distributions.BaseDistribution:
    """Return a domain in Optuna's form: lists and multiples of q by index, as Optuna has no log scale with steps."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(domain, Listed):
        return CategoricalDistribution(tuple(range(len(domain.values))))
    assert isinstance(domain, Range)
    if domain.is_whole or domain.q is not None:
        return IntDistribution(*domain.factors, log=domain.is_log)
    return FloatDistribution(*domain.bounds, log=domain.is_log)


def _from_optuna(domain: Any, value: Any) -> Any:
    if isinstance(domain, Listed):
        return domain.values[value]
    assert isinstance(domain, Range)
    return domain.at_factor(value) if domain.is_whole or domain.q is not None else float(value)


def _to_optuna(domain: Any, value: Any) -> Any:
    if isinstance(domain, Listed):
        return domain.index_of(value)
    assert isinstance(domain, Range)
    return round(value / (domain.q or 1)) if domain.is_whole or domain.q is not None else float(value)
