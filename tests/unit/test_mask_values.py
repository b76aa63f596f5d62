"""What is a mask of actions, and what is none."""

from typing import Any

import numpy as np
import pytest

from policies.envs.mask_values import MaskProblemError, checked_mask


@pytest.mark.parametrize(
    ("mask", "sizes", "words"),
    [
        ([0, 0], (2,), "forbids every action"),
        ([1, 1, 0, 0, 1], (2, 2, 1), "forbids every value of choice 1, counted from 0"),
        ([1, 1, 1], (2,), "not 2 zeros and ones"),
        ([0.5, 1], (2,), "not zeros and ones"),
        ([np.nan, 1], (2,), "not zeros and ones"),
        (["1", "0"], (2,), "not 2 zeros and ones"),
        (None, (2,), "not 2 zeros and ones"),
        ({"a": 1}, (2,), "not 2 zeros and ones"),
        ([[1], [1, 0, 1]], (2,), "not 2 zeros and ones"),
    ],
    ids=str,
)
def test_what_is_no_mask(mask: Any, sizes: tuple[int, ...], words: str) -> None:
    with pytest.raises(MaskProblemError, match=words):
        checked_mask(mask, sizes)


@pytest.mark.parametrize(
    "mask", [np.array([1, 0, 1]), [True, False, True], [1.0, 0.0, 1.0], ([1, 0], np.array([1], np.int8))], ids=str
)
def test_what_is_a_mask(mask: Any) -> None:
    found = checked_mask(mask, (2, 1))
    assert found.dtype == np.float32
    assert found.tolist() == [1, 0, 1]


@pytest.mark.parametrize(
    ("mask", "sizes", "are_actions"),
    [
        ([5, 2, 7], (9,), True),
        (np.array([1, 0]), (9,), True),
        ([2, 0, 1], (3,), True),
        ([3, 0, 1], (3,), False),
        ([2, 2, 1], (9,), False),
        ([-1, 2], (9,), False),
        ([0.0, 2.0], (9,), False),
        ([2, 0, 1], (9, 2, 1), False),
    ],
    ids=str,
)
def test_the_actions_that_are_allowed_are_no_mask_but_may_be_made_one(
    mask: Any, sizes: tuple[int, ...], *, are_actions: bool
) -> None:
    with pytest.raises(MaskProblemError) as problem:
        checked_mask(mask, sizes)
    assert ("make zeros and ones of them" in str(problem.value)) is are_actions
