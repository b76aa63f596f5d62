"""Values that move linearly: learning rates, PPO's entropy weight, DQN's linear epsilon.

After t env steps (or episodes) of n, a value that moves from a to b is

    a + (b - a) * min(1, t / n)

in double precision; what computes with it rounds it. Engine rllib gives PPO's schedules to RLlib as points, which has
the same formula before the end and b itself from there on: at most the last bit of a double apart.
"""

from __future__ import annotations


def linear(start: float, final: float | None, num_steps: float | None, now: float) -> float:
    """The value after so many env steps or episodes.

    Args:
        start: Before the first.
        final: After `num_steps`; None: the value stays.
        num_steps: How many it takes; None: the value stays.
        now: How many there were.
    """
    if final is None or num_steps is None:
        return start
    return start + (final - start) * min(1.0, now / num_steps)
