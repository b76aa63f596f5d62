"""Raise errors for NaN and infinity in outputs and gradients, by which training has ruined a network.

Rewards and observations were checked to be finite before (`policies.envs.checked`), so the training is the cause.
RLlib's learner sets such gradients to 0 and continues (2.60): the trial would silently learn nothing any more.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from policies.acting.policy import NON_FINITE_HINT
from policies.errors import NonFiniteWeightsError


def check_gradients(gradients: Iterable[Tensor | None], module: nn.Module) -> None:
    """Refuse gradients that are not finite.

    Args:
        gradients: The gradients of one update.
        module: The network that they belong to.

    Raises:
        NonFiniteWeightsError: One is NaN or infinite.
    """
    known = [gradient for gradient in gradients if gradient is not None]
    # The norm of a tensor is finite if all its numbers are, so only one number per tensor is checked.
    if known and not bool(torch.isfinite(torch.stack(torch._foreach_norm(known))).all()):  # noqa: SLF001 (as RLlib's own clipping)
        raise _error("The gradients of an update are NaN or infinite", module)


def check_outputs(outputs: Tensor, module: nn.Module) -> None:
    """Refuse outputs from which no action can be drawn.

    Args:
        outputs: The outputs of a policy.
        module: The network that they belong to.

    Raises:
        NonFiniteWeightsError: One is NaN or infinite.
    """
    if not bool(torch.isfinite(outputs).all()):
        raise _error("The policy's outputs are NaN or infinite", module)


def _error(what: str, module: nn.Module) -> NonFiniteWeightsError:
    tensors = {name: value for name, value in module.state_dict().items() if value.is_floating_point()}
    counts = {name: int((~torch.isfinite(value)).sum()) for name, value in tensors.items()}
    bad = [name for name, count in counts.items() if count]
    if bad:
        where = f"{sum(counts.values())} weights are too, first in {bad[0]}"
    else:
        largest = max((float(value.abs().max()) for value in tensors.values() if value.numel()), default=0.0)
        where = f"its weights are finite, the largest {largest:.4g}"
    return NonFiniteWeightsError(f"{what}: {where}.", NON_FINITE_HINT)
