"""Domains mean what the functions of the same names in ray.tune mean."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from tune_jobs.spec.domains import Domain

pytestmark = pytest.mark.ray


@pytest.mark.parametrize(
    ("kind", "numbers"),
    [
        ("randint", [1, 50]),
        ("lograndint", [2, 60]),
        ("qrandint", [5, 47, 5]),
        ("qlograndint", [3, 60, 3]),
        ("quniform", [0.25, 1.25, 0.25]),
        ("qloguniform", [0.25, 2.0, 0.25]),
        ("uniform", [1.0, 2.0]),
        ("loguniform", [1e-4, 1.0]),
    ],
)
def test_values_have_the_bounds_and_quantiles_of_ray_tunes(kind: str, numbers: list[float]) -> None:
    from ray import tune

    theirs = getattr(tune, kind)(*numbers)
    theirs = theirs.sample(size=5_000, random_state=np.random.default_rng(1))
    domain = TypeAdapter(Domain).validate_python({kind: numbers})
    rng = np.random.default_rng(2)
    ours = [domain.sample(rng) for _ in range(5_000)]
    if kind.startswith("q") or kind.endswith("int"):
        # Not more than dust apart: ray.tune gives 0.30000000000000004 for three tenths.
        assert np.unique(ours) == pytest.approx(np.unique(theirs))
    spread = np.quantile(ours, [0.1, 0.5, 0.9]) / np.quantile(theirs, [0.1, 0.5, 0.9])
    assert spread == pytest.approx(1, rel=0.2)
