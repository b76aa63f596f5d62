"""Compare all that computes a network whose convolutions see a part of what is observed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from policy_factory import untrained_policy
from torch import Tensor
from torch.nn import functional

from policies.envs.images import SeenImage
from policies.envs.make import check_env
from policies.hyperparams import DQNHyperparams, PPOHyperparams
from policies.networks.parts import DQNNetworks, PPONetworks, model_config
from policies.packed.acting import ActingNetworks, ActingOnDevice
from policies.packed.initial import new_member
from policies.packed.inputs import Inputs
from policies.packed.networks import with_ones
from policies.packed.rows import StackedRows
from tune_jobs.plan.estimates import products_per_image

FILTERS = ((5, 4, 2), (3, 2, 1))
"""12 x 9 -> 5 x 3 -> 4 x 2, of three channels."""
SMALL: dict[str, Any] = {"conv_filters": FILTERS, "hidden_sizes": (7,), "activation": "tanh"}


def assert_all_compute_the_same(
    env_id: str,
    algorithm: str,
    rows: NDArray[np.float32],
    parts: Callable[[Tensor], tuple[Tensor, list[Tensor]]],
    *,
    image: SeenImage,
    folder: Path,
    normalizes: bool,
) -> None:
    """Compare torch's networks, a pack's in each of its ways and the portable policy with torch's own functions.

    Args:
        env_id: An env with images of 12 x 9.
        algorithm: `ppo` or `dqn`.
        rows: What is observed, (B, numbers).
        parts: Returns the image as convolutions see it, (B, 12, 9, channels), and what is beside it, of such rows.
        image: Where it is, as if nothing were normalised.
        folder: For the policy.
        normalizes: Whether observations are normalised, with statistics of nothing.
    """
    make: Any = PPOHyperparams if algorithm == "ppo" else DQNHyperparams
    hyperparams = make(**SMALL, normalize_observations=normalizes, **({} if algorithm == "ppo" else {"dueling": False}))
    info = check_env(env_id, {})
    assert info.image == image
    member = new_member("t0000", hyperparams, 3, info.observation_space, info.action_space)
    build: Any = PPONetworks if algorithm == "ppo" else DQNNetworks
    networks = build(info.observation_space, info.action_space, model_config(hyperparams))
    weights = {name: torch.from_numpy(value) for name, value in member.weights.items()}
    networks.load_state_dict({name: weights[name] for name in networks.state_dict()})
    encoder = networks.encoder if algorithm == "dqn" else networks.encoder["actor_encoder"]
    head = networks.af if algorithm == "dqn" else networks.pi
    with torch.no_grad():
        seen = torch.from_numpy(rows)
        x, beside = parts(seen)
        x = x.permute(0, 3, 1, 2)
        for layer, stride in zip((0, 2), (2, 1), strict=True):
            name = f"{'encoder.' if algorithm == 'ppo' else ''}{'actor_' if algorithm == 'ppo' else ''}encoder.conv"
            of_layer = weights[f"{name}.{layer}.weight"], weights[f"{name}.{layer}.bias"]
            x = torch.tanh(functional.conv2d(x, *of_layer, stride=stride))
        x = torch.cat([x.flatten(1), *beside], dim=1)
        expected = head(torch.tanh(functional.linear(x, encoder.mlp[0].weight, encoder.mlp[0].bias))).numpy()
        found = head(encoder(seen)).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(expected).max() > 1e-3
    inputs = Inputs.of(info.observation_space)
    stacked = StackedRows([member], inputs.shape, 2, "cpu", image=inputs.image)
    assert stacked.networks.sizes == (4 * 2 * 3 + image.num_beside, 7, 2)
    for acting in (ActingNetworks(stacked.networks, 1), ActingOnDevice(stacked.networks, 1)):
        np.testing.assert_allclose(acting(rows[None])[0], expected, atol=1e-5)
    batch = torch.from_numpy(with_ones(rows[None])).repeat(stacked.networks.num_networks, 1, 1)
    np.testing.assert_allclose(stacked.networks.forward(batch)[0], expected, atol=1e-5)
    np.testing.assert_allclose(stacked.networks.evaluate(batch[:1], 0, 1)[0], expected, atol=1e-5)
    assert stacked.networks.multiplications_per_row == products_per_image(image, hyperparams) + 7 * 2
    policy = untrained_policy(env_id, {}, hyperparams, folder)
    if not normalizes:  # which clips what it has normalised at 10, as no network here does
        np.testing.assert_allclose(policy.outputs(rows), expected, atol=1e-5)
    assert policy.portable.network.image == (image.unscaled if normalizes else image)
    # To the bit, it does not depend on what else is in a batch.
    assert np.array_equal(np.concatenate([policy.outputs(row[None]) for row in rows]), policy.outputs(rows))
