"""Compare the steps of sub-environments."""

import numpy as np

from policies.packed.envs.sub_envs import SubStep


def assert_equal_steps(ours: SubStep, theirs: SubStep) -> None:
    """Assert that two steps gave the same, to the last bit and the type."""
    for name in ("final_observations", "rewards", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name, strict=True)
    assert list(ours.first_observations) == list(theirs.first_observations)
    for place, first in theirs.first_observations.items():
        np.testing.assert_array_equal(ours.first_observations[place], first, strict=True)
    assert ours.errors.keys() == theirs.errors.keys()
