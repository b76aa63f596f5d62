"""When a search method is asked for the first point that is not random.

What trainings have come to at the first rungs says little of what they come to in the end, and with a scheduler that
ends them there ten points have ended in no time. A model of ten such scores looks where they were lucky, and what it
finds there is all that it looks at later (decision 40). So a point counts for the share of its training that it has
had.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from tune_jobs.search.history import KnownPoint


def is_enough(known: Sequence[KnownPoint], num_startup_trials: int, num_points: int | None) -> bool:
    """Return whether so many points have ended that a model may be asked.

    Args:
        known: What was tried before, and what is being tried.
        num_startup_trials: `search.num_startup_trials`.
        num_points: How many points the search will give in all; None: not known.
    """
    ended = [point for point in known if not point.is_running]
    if len(ended) < num_startup_trials:
        return False
    if num_points is not None and len(ended) >= most_needed(num_startup_trials, num_points, len(known) - len(ended)):
        return True
    # Sums of shares are off by rounding.
    return sum(point.trained for point in ended) >= num_startup_trials - 1e-9


def most_needed(num_startup_trials: int, num_points: int, num_running: int) -> int:
    """Return how many points have to end at most before a model is asked, however little they were trained: a third.

    Otherwise it would never be asked where a scheduler ends nearly all of a small sweep's points. What runs was chosen
    without having ended: of many that run at once a third of all would leave the model none to propose.
    """
    return max(num_startup_trials, math.ceil((num_points - num_running) / 3))
