"""A population whose best values drift while it trains: no networks, a few milliseconds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from tune_jobs.search.bandit import Gain, Next
from tune_jobs.spec.domains import Domain

_DOMAIN: TypeAdapter[Any] = TypeAdapter(Domain)
SPACE = {
    "lr": _DOMAIN.validate_python({"loguniform": [1e-5, 1e-1]}),
    "clip": _DOMAIN.validate_python({"uniform": [0.0, 1.0]}),
}
Change = Callable[[Next, Sequence[Gain], np.random.Generator], dict[str, Any]]


def gain(point: Mapping[str, Any], share: float) -> float:
    """What an interval gains, at a share of the training: the best lr falls from 1e-2 to 1e-4, the best clip rises."""
    far = math.log10(float(point["lr"])) + 2 + 2 * share
    return 1.0 - min(1.5, far**2) - min(1.0, abs(float(point["clip"]) - 0.2 - 0.6 * share))


def final_score(change: Change, seed: int, size: int, num_intervals: int) -> float:
    """The best score in the end, if `change` gives the values with which the worst go on from copies of the best."""
    rng, noise = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    points = [{name: domain.sample(rng) for name, domain in SPACE.items()} for _ in range(size)]
    scores, gains = [0.0] * size, list[Gain]()
    for time in range(1, num_intervals + 1):
        for index, point in enumerate(points):
            rise = gain(point, time / num_intervals) + 0.1 * noise.standard_normal()
            gains.append(Gain(time, scores[index], rise, point))
            scores[index] += rise
        ranked = sorted(range(size), key=scores.__getitem__)
        for index in ranked[: size // 4]:
            source = ranked[-1 - int(rng.integers(size // 4))]
            others = [point for other, point in enumerate(points) if other != index]
            coming = Next(time + 1, scores[source], points[source], others)
            points[index] = change(coming, gains, np.random.default_rng([seed, 2, time, index]))
            scores[index] = scores[source]
    return max(scores)
