"""Where a pack acts: with small networks on the CPU, with large ones where their weights are."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch

from policies.hyperparams import PPOHyperparams
from policies.packed import acting
from policies.packed.acting import ActingNetworks, ActingOnDevice, make_acting
from policies.packed.convolutions import convolutions_for
from policies.packed.envs.make import make_packed_envs
from policies.packed.initial import new_member
from policies.packed.make import make_stack
from policies.packed.member import MAX_GROUP
from policies.packed.networks import StackedNetworks
from policies.packed.ppo.stack import PPOStack

ATARI = ((32, 8, 4), (64, 4, 2), (64, 3, 1))


def networks(num: int, hidden: int, device: str = "cpu") -> StackedNetworks:
    return StackedNetworks(num, (4, hidden, hidden, 2), ["tanh"] * num, device)


def test_multiplications_are_those_of_each_layer() -> None:
    assert networks(3, 64).multiplications_per_row == 4 * 64 + 64 * 64 + 64 * 2
    images = convolutions_for((84, 84, 4), ATARI)
    stack = StackedNetworks(1, (3136, 512, 6), ["relu"], convolutions=images)
    # Of Atari's network: places, then the numbers of a kernel's window, then filters.
    convolved = 20 * 20 * (8 * 8 * 4) * 32 + 9 * 9 * (4 * 4 * 32) * 64 + 7 * 7 * (3 * 3 * 64) * 64
    assert stack.multiplications_per_row == convolved + 3136 * 512 + 512 * 6


@pytest.mark.parametrize(
    ("num", "hidden", "num_rows", "is_large"),
    [
        (8, 64, 8, False),
        (32, 64, 32, False),
        (1, 256, 32, False),
        (32, 256, 1, True),  # few rows, but weights that no cache holds
        (32, 256, 8, True),
        (1, 1024, 1, True),
        (4, 256, 32, True),  # many rows
    ],
)
def test_large_networks_act_where_their_weights_are(num: int, hidden: int, num_rows: int, is_large: bool) -> None:
    """As the times measured of either say; without a GPU no networks are too large."""
    assert acting._are_large(networks(num, hidden), num, num_rows) is is_large
    assert isinstance(make_acting(networks(num, hidden), num, num_rows), ActingNetworks)
    if is_large:
        assert isinstance(make_acting(networks(num, hidden, "meta"), num, num_rows), ActingOnDevice)


def test_weights_are_those_after_the_updates() -> None:
    rng = torch.Generator().manual_seed(0)
    stack = networks(2, 8)
    both: list[acting.Acting] = [ActingNetworks(stack, 2), ActingOnDevice(stack, 2)]
    x = np.random.default_rng(0).normal(size=(2, 3, 4)).astype(np.float32)
    for _ in range(2):
        stack.weights.copy_(torch.randn(stack.weights.shape, generator=rng))
        for each in both:
            each.refresh()
        ones = torch.cat((torch.from_numpy(x), torch.ones(2, 3, 1)), dim=2)
        expected = stack.forward(ones).numpy()
        for each in both:
            np.testing.assert_allclose(each(x), expected, atol=1e-4)


class Pictures(gym.Env[Any, Any]):
    """Images of bytes; the action decides the reward, and with it what is learned."""

    observation_space = gym.spaces.Box(0, 255, (6, 5, 2), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._num_steps = 0
        return self._draw(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._num_steps += 1
        return self._draw(), float(action), False, self._num_steps == 7, {}

    def _draw(self) -> Any:
        return self.np_random.integers(0, 256, (6, 5, 2), dtype=np.uint8)


@pytest.fixture(scope="module", autouse=True)
def pictures() -> Iterator[None]:
    gym.register("TestPictures-v0", entry_point=cast("Any", Pictures))
    yield
    del gym.registry["TestPictures-v0"]


def trained(hyperparams: list[PPOHyperparams], env_id: str, *, as_on_gpu: bool) -> PPOStack:
    """A stack after two iterations, whose device is the CPU and, if so, is taken for a GPU."""
    envs = make_packed_envs(env_id, {}, 2, kind="vectorised" if env_id == "CartPole-v1" else "scalar")
    stack = cast("PPOStack", make_stack(hyperparams[0], envs))
    stack._has_gpu = as_on_gpu
    for index, item in enumerate(hyperparams):
        stack.add(new_member(f"m{index}", item, index, envs.observation_space, envs.action_space), index)
    for _ in range(2):
        stack.train_iteration()
    envs.close()
    return stack


@pytest.mark.parametrize("where", [ActingNetworks, ActingOnDevice])
@pytest.mark.parametrize("normalize", [False, True])
def test_bytes_are_prepared_by_what_acts(monkeypatch: pytest.MonkeyPatch, normalize: bool, where: type) -> None:
    # Of two groups. Weights stay what they are, so that roundings don't grow; statistics of observations don't.
    settings = [
        PPOHyperparams(
            hidden_sizes=(6,), conv_filters=((4, kernel, 1),), activation="relu", normalize_observations=normalize,
            num_envs=2, train_batch_size=16, minibatch_size=8, lr=1e-30,
        )
        for kernel in (3, 2)
    ]  # fmt: skip

    def acts(make: type, *, as_on_gpu: bool) -> tuple[set[Any], list[Any]]:
        """The dtypes of what was acted on, and the outputs."""
        dtypes, outputs = set(), []

        def make_watched(stacked: StackedNetworks, num_acting: int, _: int) -> acting.Acting:
            class Watched(make):  # type: ignore[misc]
                def __call__(self, x: Any, prepare_bytes: Any = None) -> Any:
                    dtypes.add(x.dtype)
                    outputs.append(super().__call__(x, prepare_bytes))
                    return outputs[-1]

            return cast("acting.Acting", Watched(stacked, num_acting))

        monkeypatch.setattr("policies.packed.ppo.group.make_acting", make_watched)
        trained(settings, "TestPictures-v0", as_on_gpu=as_on_gpu)
        return dtypes, outputs

    plain, expected = acts(ActingNetworks, as_on_gpu=False)
    raw, found = acts(where, as_on_gpu=True)
    assert (plain, raw) == ({np.dtype(np.float32)}, {np.dtype(np.uint8)})
    assert len(found) == 2 * 2 * 8  # groups, iterations, vector steps
    assert min(np.abs(each).max() for each in expected) > 0.02
    for ours, theirs in zip(found, expected, strict=True):
        # Sums of 18 and 80 numbers, which are 4 at most where they are normalised.
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_a_gpu_computes_all_members_in_one_group() -> None:
    """But not those with images, of which a group keeps much."""
    settings = [PPOHyperparams(hidden_sizes=(6,), num_envs=2, train_batch_size=16, minibatch_size=8)] * (MAX_GROUP + 3)
    groups = [trained(settings, "CartPole-v1", as_on_gpu=gpu)._groups for gpu in (False, True)]
    assert [len(found) for found in groups] == [2, 1]
    settings = [item.model_copy(update={"conv_filters": ((4, 3, 1),)}) for item in settings]
    assert len(trained(settings, "TestPictures-v0", as_on_gpu=True)._groups) == 2
