"""What a policy is given to act on: what is no finite number, no byte or no mask is refused; and policies travel."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from policy_factory import make_image_policy, make_policy, register_test_envs

from policies.acting.baselines import ConstantPolicy
from policies.acting.policy import NetworkPolicy, Policy, RandomPolicy, action_transform
from policies.envs.flat import FlatBox
from policies.envs.masks import MaskedBox
from policies.envs.own_actions import Choices
from policies.errors import ObservationError
from policies.portable.file import ActionTransform, Layer, PolicyNetwork, PortablePolicy, describe_space

register_test_envs()
BYTES = spaces.Box(0, 255, (4, 5, 3), np.uint8)
GREY = spaces.Box(0, 255, (4, 5), np.uint8)
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
DICT = spaces.Dict({"x": spaces.Box(-np.inf, np.inf, (2,), np.float32), "z": spaces.Discrete(3)})
TWO: spaces.Discrete[Any] = spaces.Discrete(2)
OPEN = spaces.Box(np.array([-2.0, -np.inf, 0.0], np.float32), np.array([2.0, np.inf, np.inf], np.float32))


def policy_of(space: Any, actions: Any = TWO, transform: ActionTransform | None = None) -> NetworkPolicy:
    """A linear policy of random weights, of which no output is favoured by a large image."""
    seen = space.seen if isinstance(space, MaskedBox) else space
    if isinstance(actions, spaces.Box):
        num = 2 * actions.shape[0]
    else:
        num = sum(actions.sizes) if isinstance(actions, Choices) else int(actions.n)
    weight = np.random.default_rng(0).normal(size=(num, int(np.prod(seen.shape)))).astype(np.float32)
    weight -= weight.mean(axis=1, keepdims=True)
    network = PolicyNetwork(
        "gaussian" if isinstance(actions, spaces.Box) else "categorical",
        (Layer(weight, np.zeros(num, np.float32)),),
        scale=1 / 255 if seen.dtype == np.uint8 else 1.0,
    )
    return NetworkPolicy(
        PortablePolicy(
            network=network, algorithm="ppo", env_id="Game-v0", env_args={}, observation_space=describe_space(space),
            action_space=describe_space(actions), action_transform=transform or action_transform(actions),
        )
    )  # fmt: skip


# -- bytes

FORMS: dict[str, tuple[Any, Any, bool]] = {
    "channels": (BYTES, None, False),
    "own": (FlatBox(GREY), None, False),
    "made": (FlatBox(GREY), None, True),
    "masked": (MaskedBox.of(BYTES, (2,), None), [1, 1], False),
    "masked, own": (MaskedBox.of(GREY, (2,), None), [1, 1], False),
    "masked, made": (MaskedBox.of(GREY, (2,), None), [1, 1], True),
    "behind a mask": (MaskedBox.of(BYTES, (2,), None), None, True),
}


@pytest.mark.parametrize("form", FORMS)
def test_images_of_bytes_take_bytes_of_any_type_and_nothing_else(form: str) -> None:
    space, mask, is_made = FORMS[form]
    policy = policy_of(space)
    shape = BYTES.shape if BYTES in (space, getattr(space, "original", None)) else GREY.shape
    images: NDArray[Any] = np.random.default_rng(1).integers(0, 256, (20, *shape)).astype(np.uint8)

    def acted(images: Any, mask: Any) -> Any:
        given = np.asarray(images)
        if is_made and shape == GREY.shape:
            given = given[..., None]
        elif is_made:
            given = np.concatenate([np.ones((len(given), 2)), given.reshape(len(given), -1)], axis=1)
        one = policy.act(given[0], mask)
        many = policy.act(given, None if mask is None else [mask] * len(given))
        assert one == many[0]
        return many.tolist()

    wanted = acted(images, mask)
    assert set(wanted) == {0, 1}
    for dtype in (np.float64, np.int64):
        assert acted(images.astype(dtype), mask) == wanted
    for wrong, shown in ((images / 255.0, r"0\.\d+"), (images * 0 - 1.0, r"-1\.0"), (images * 0 + 256.0, r"256\.0")):
        with pytest.raises(ObservationError, match=rf"in which {shown} is no byte"):
            acted(wrong, mask)
        # In a batch that begins with what is right.
        batch = np.concatenate([images[:1], wrong])
        with pytest.raises(ObservationError, match=rf"in which {shown} is no byte"):
            acted(batch, mask)


# -- numbers


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([np.nan, 0, 0, 0], r"must be finite: one was NaN \(number 0 of its 4, counted from 0\)\."),
        ([0, 0, np.inf, 0], r"must be finite: one was infinite \(number 2 of its 4"),
        ([0, 0, 0, -np.inf], r"must be finite: one was minus infinity \(number 3 of its 4"),
        ([0, 1e300, 0, 0], r"must be finite: one was 1e\+300, which is infinite in 32 bits \(number 1"),
        (np.array([0, 1e300, 0, 0]), r"must be finite: one was 1e\+300"),
        (np.array([0, np.nan, 0, 0], object), r"must be finite: one was NaN \(number 1"),
        ([[0, 0, 0, 0], [0, 0, np.nan, 0]], r"NaN \(number 2 of its 4, .*\) in observation 1 of the batch"),
        ([None, 0, 0, 0], r"must be numbers of shape \(4,\): there is None\."),
        (None, r"must be numbers of shape \(4,\): there is None\."),
        (["0.1", "0", "0", "0"], r"must be numbers of shape \(4,\): there are values of dtype <U3\."),
        (np.array(["0.1", 0, 0, 0], object), r"must be numbers of shape \(4,\): there is '0\.1'\."),
        (np.array([b"1", 0, 0, 0], object), r"must be numbers of shape \(4,\): there is b'1'\."),
        (np.zeros(4, complex), r"must be numbers of shape \(4,\): there are values of dtype complex128\."),
        ([10**400, 0, 0, 0], r"must be numbers of shape \(4,\): "),
    ],
    ids=str,
)
def test_what_is_no_finite_number_is_refused(given: Any, words: str) -> None:
    policies: list[Policy] = [make_policy("CartPole-v1"), RandomPolicy.for_env("CartPole-v1")]
    for policy in policies:
        with pytest.raises(ObservationError, match=words) as caught:
            policy.act(given)
        assert caught.value.hint == "Pass what env.reset or env.step returned."


def test_so_it_is_among_members_and_behind_a_mask() -> None:
    with pytest.raises(ObservationError, match=r"finite: one was NaN \(observation\['x'\]\[1\]\)\."):
        policy_of(FlatBox(DICT)).act({"x": [0.0, np.nan], "z": 1})
    for space in (MaskedBox.of(VECTOR, (2,), None), MaskedBox.of(DICT, (2,), None)):
        policy = policy_of(space)
        vector = np.zeros(space.shape)
        vector[:2], vector[3] = 1, np.inf
        place = r"observation\['x'\]\[1\]" if space.original is DICT else r"number 1 of its 3, counted from 0"
        for given, mask in ((vector, None), (vector, [0, 1]), (vector[2:], [0, 1])):
            with pytest.raises(ObservationError, match=rf"finite: one was infinite \({place}\)\."):
                policy.act(given, mask)
    policy = policy_of(MaskedBox.of(VECTOR, (2,), None))
    with pytest.raises(ObservationError, match=r": there is None\."):
        policy.act([0.0, None, 0.0], [1, 1])
    with pytest.raises(ObservationError, match=r": there are values of dtype"):
        policy.act(["0", "0", "0"], [1, 1])


def test_what_are_finite_numbers_is_taken_whatever_their_type() -> None:
    policy = make_policy("CartPole-v1")
    numbers = [0.25, -0.5, 2.0, 0.125]
    wanted = policy.act(numbers)
    for given in ([Fraction(number) for number in numbers], [Decimal(number) for number in numbers],
                  np.array(numbers, object), np.array(numbers, np.float16), np.array(numbers, np.longdouble),
                  [np.float32(number) for number in numbers], tuple(numbers)):  # fmt: skip
        assert policy.act(given) == wanted
    assert policy.act([True, False, False, True]) == policy.act([1, 0, 0, 1])
    largest = float(np.finfo(np.float32).max)
    assert RandomPolicy.for_env("CartPole-v1").act([largest, -largest, 0, 0]) in (0, 1)
    assert policy.act(np.zeros((0, 4))).shape == (0,)


# -- masks


@pytest.mark.parametrize(
    ("front", "words"),
    [
        ([0, 0, 1, 1], r"\[0(\.0)?, 0(\.0)?, 1(\.0)?, 1(\.0)?\] is the mask, which forbids every value of choice 0"),
        ([1, 1, 0, 0], "which forbids every value of choice 1"),
        ([5, -7, 1, 1], r"\[5(\.0)?, -7(\.0)?, 1(\.0)?, 1(\.0)?\] is the mask, not zeros and ones"),
        ([0.5, 1, 1, 1], "not zeros and ones"),
        ([np.nan, 1, 1, 1], "not zeros and ones"),
    ],
)
def test_the_mask_that_a_vector_begins_with_is_checked(front: list[float], words: str) -> None:
    policy = policy_of(MaskedBox.of(VECTOR, (2, 2), None), Choices(spaces.MultiDiscrete([2, 2])))
    good = np.array([1, 0, 0, 1, 0.1, 0.2, 0.3])
    wrong = np.array([*front, 0.1, 0.2, 0.3])
    assert policy.act(good).tolist() == [0, 1]
    assert policy.act([good] * 3).tolist() == [[0, 1]] * 3
    assert policy.act(good[None][:0]).shape == (0, 2)
    for given in (wrong, wrong.tolist(), [good, wrong], [[good, good], [good, wrong]]):
        with pytest.raises(ObservationError, match=words):
            policy.act(given)
    # One that is given goes before it.
    assert policy.act(wrong, [0, 1, 1, 0]).tolist() == [1, 0]


# -- travel

PICKLED: dict[str, Callable[[], Policy]] = {
    "discrete": lambda: policy_of(VECTOR, spaces.Discrete(4, start=7)),
    "bounded": lambda: policy_of(VECTOR, spaces.Box(-2, 3, (2,), np.float32)),
    "by component": lambda: policy_of(VECTOR, OPEN),
    "clipped": lambda: policy_of(VECTOR, OPEN, "clip"),
    "older": lambda: policy_of(VECTOR, OPEN, "unsquash"),
    "as they are": lambda: policy_of(VECTOR, OPEN, "none"),
    "choices": lambda: policy_of(VECTOR, Choices(spaces.MultiDiscrete([2, 3], start=[1, 1]))),
    "flattened": lambda: policy_of(FlatBox(DICT)),
    "masked": lambda: policy_of(MaskedBox.of(DICT, (2,), None)),
    "images": lambda: NetworkPolicy(make_image_policy()),
    "random": lambda: RandomPolicy.for_env("Pendulum-v1"),
    "constant": lambda: ConstantPolicy.for_env("CartPole-v1", {}, 1),
}


@pytest.mark.parametrize("kind", PICKLED)
def test_a_policy_is_the_same_once_it_was_pickled(kind: str) -> None:
    policy = PICKLED[kind]()
    again = pickle.loads(pickle.dumps(policy))
    assert type(again) is type(policy)
    assert again.description == policy.description
    space: Any = policy.observation_space
    rows = np.random.default_rng(1).integers(0, 2, (50, *space.shape))
    if isinstance(space, MaskedBox):
        rows[:, 0] = 1  # something is allowed
    wanted, acted = policy.act(rows), again.act(rows)
    assert np.array_equal(acted, wanted)
    assert acted.dtype == wanted.dtype
    one, same = again.act(rows[0]), policy.act(rows[0])
    assert type(one) is type(same)
    assert np.array_equal(one, same)
