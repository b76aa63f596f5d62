"""Values that move linearly: learning rates, PPO's entropy weight, DQN's linear epsilon.

After t env steps (or episodes) of n, a value that moves from a to b is

    a + (b - a) * min(1, t / n)

in double precision; it may be rounded where it is used. The engine rllib passes PPO's schedules to RLlib as points.
RLlib uses the same formula before the end and b itself afterwards, which differs in the last bit of a double at most.
"""

from __future__ import annotations


def linear(start: float, final: float | None, num_steps: float | None, now: float) -> float:
    """Return the value after `now` env steps or episodes.

    Args:
        start: The value at the beginning.
        final: The value after `num_steps`; None: the value does not change.
        num_steps: The env steps or episodes it takes; None: the value does not change.
        now: The env steps or episodes so far.
    """
    if final is None or num_steps is None:
        return start
    return start + (final - start) * min(1.0, now / num_steps)
