"""Values of the search space as numbers that a model computes with, and back.

`tune_jobs.search.study` has other numbers for the same values: there people read them, so that they are the values
themselves; here lists and multiples of a step are counted, which is what a model can go by.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tune_jobs.spec.domains import Listed, Range

if TYPE_CHECKING:
    import optuna


def distribution_of(domain: Any) -> optuna.distributions.BaseDistribution:
    """Return a domain in Optuna's form: lists and multiples of q by index, as Optuna has no log scale with steps."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(domain, Listed):
        return CategoricalDistribution(tuple(range(len(domain.values))))
    assert isinstance(domain, Range)
    low, high = domain.codes
    if domain.is_stepped:
        return IntDistribution(int(low), int(high), log=domain.has_log_codes)
    return FloatDistribution(low, high, log=domain.has_log_codes)


def from_optuna(domain: Any, value: Any) -> Any:
    """Return the value of a domain that a parameter of Optuna's stands for."""
    if isinstance(domain, Listed):
        return domain.values[value]
    assert isinstance(domain, Range)
    return domain.of_code(value)


def to_optuna(domain: Any, value: Any) -> Any:
    """Return the parameter of Optuna's that stands for a value of a domain."""
    if isinstance(domain, Listed):
        return domain.index_of(value)
    assert isinstance(domain, Range)
    return domain.code_of(value)
