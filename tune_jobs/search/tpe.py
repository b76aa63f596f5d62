"""Propose points by TPE (Bergstra et al. 2011), as Optuna implements it.

The model is built anew from what is known for every point, so a sweep that is resumed or extended uses all its results,
and nothing is stored besides the records. What Optuna is told of a point:

- ended: the mean over its seeds;
- ended early by a scheduler: the same, and how far it got. Such points count as worse than those that ended by
  themselves, and as better the further they got (Optuna's pruned trials);
- with a seed that failed or was never scored: worse than all others;
- still running: a bad score, so that trials that run at the same time are spread out (the constant liar).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from policies import random_streams
from policies.errors import SpecError
from tune_jobs.search.asking import Check, Question
from tune_jobs.search.coordinates import distribution_of, from_optuna
from tune_jobs.spec.domains import Domain

if TYPE_CHECKING:
    import optuna

_ATTEMPTS = 100


def propose(question: Question, check: Check) -> dict[str, Any]:
    """Answer by TPE; see `tune_jobs.search.asking.Method`.

    Raises:
        SpecError: None of many proposals is valid.
    """
    import optuna

    from tune_jobs.search.told_trials import told

    with warnings.catch_warnings():
        # Optuna 4 warns of arguments that are new in it.
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler = optuna.samplers.TPESampler(
            seed=random_streams.tpe_seed(question.seed, question.index),
            n_startup_trials=0,
            multivariate=True,
            constant_liar=True,
        )
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        study = optuna.create_study(direction="maximize", sampler=sampler)
        distributions = {name: distribution_of(domain) for name, domain in question.space.items()}
        study.add_trials([told(question.space, distributions, known) for known in question.known])
        return _first_valid(study, question.space, distributions, check)
    finally:
        optuna.logging.set_verbosity(verbosity)


def _first_valid(
    study: optuna.Study,
    space: Mapping[str, Domain],
    distributions: dict[str, optuna.distributions.BaseDistribution],
    check: Check,
) -> dict[str, Any]:
    import optuna

    for _ in range(_ATTEMPTS):
        trial = study.ask(fixed_distributions=distributions)
        point = {name: from_optuna(domain, trial.params[name]) for name, domain in space.items()}
        try:
            check(point)
        except SpecError as error:
            last_error = error
            # A trial without a value counts as worse than all others.
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        else:
            return point
    raise last_error
