"""Adam and RMSprop over stacked weights, each row with settings of its own.

The formulas are torch.optim's, so that an optimizer's state can be moved to RLlib's optimizer and back.

Shapes: K rows (networks), P weights per row.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

_NUMBERS_AT_ONCE = 98_304
"""How many weights are moved at once: with their gradients, moments and quotients, they are two megabytes."""
_STEPS_AHEAD = 128
FUSED_FROM = 16_384
"""The weights of a network from which on Adam is torch's own fused step, which goes over them once and not ten times.
It is called for each member; networks with fewer are as fast all together."""


class StackedOptimizer(Protocol):
    """Updates weights of shape (K, P)."""

    lr: Tensor
    """The learning rates, (K, 1); they may be set at any time."""
    state: dict[str, Tensor]
    """The moments by name, each of shape (K, P)."""
    num_steps: Tensor
    """The number of steps that each row has made, (K, 1), float64."""

    def begin(self, num_updates: int) -> None:
        """Prepare for `num_updates` steps: everything that does not depend on gradients is computed for all of them."""
        ...

    def step(self, gradients: Tensor) -> None:
        """Update the weights by one step."""
        ...


class StackedAdam:
    """Adam (Kingma & Ba 2015, algorithm 1) as `torch.optim.Adam` computes it.

    Args:
        weights: The weights, (K, P); they are updated in place.
        lr: The learning rates, (K, 1).
        beta1: Decay of the mean gradient, (K, 1), float64, because 1 - beta is inexact in float32 if beta is near 1.
        beta2: Decay of the squared gradient, (K, 1), float64.
        epsilon: Added to the denominator, (K, 1).
    """

    def __init__(self, weights: Tensor, lr: Tensor, beta1: Tensor, beta2: Tensor, epsilon: Tensor) -> None:
        self.weights, self.lr = weights, lr
        self.beta1, self.beta2, self.epsilon = beta1.double(), beta2.double(), epsilon
        self._weight1, self._beta2_32, self._weight2 = (1 - beta1).float(), beta2.float(), (1 - beta2).float()
        self.state = {"exp_avg": torch.zeros_like(weights), "exp_avg_sq": torch.zeros_like(weights)}
        self.num_steps = torch.zeros_like(lr, dtype=torch.float64)
        self._rates: list[tuple[Tensor, Tensor]] = []
        self._known: tuple[list[float], Tensor, Tensor] | None = None
        """The numbers of steps before them, and the corrections of the steps that follow, (steps, K, 1) each."""
        # By the weights of one network alone: how many are in a stack has no part in how they are rounded.
        self._fused = _FusedSteps(self) if weights.shape[1] >= FUSED_FROM and can_fuse(weights.device.type) else None

    def begin(self, num_updates: int) -> None:
        """Compute the rates of the next `num_updates` steps, with the present learning rates."""
        if self._fused is not None:
            self._fused.begin(num_updates)
            return
        correction1, scales = self._corrections_of(num_updates)
        rates = (self.lr.double() / correction1).float()
        # They are popped from the end of the list, so the first step comes last.
        self._rates = list(zip(rates.flip(0).unbind(0), scales.flip(0).unbind(0), strict=True))

    def _corrections_of(self, num_updates: int) -> tuple[Tensor, Tensor]:
        """Return what rates are divided by and denominators multiplied by in the next steps, (num_updates, K, 1).

        On a CPU they are computed ahead, as phases of DQN have few updates.
        """
        if self.lr.is_cuda:
            return self._corrections_from_now(num_updates)
        now = self.num_steps[:, 0].tolist()
        if self._known is not None:
            before, correction1, scales = self._known
            done = int(now[0] - before[0])
            is_known = 0 <= done <= len(scales) - num_updates and now == [count + done for count in before]
            if is_known:
                return correction1[done : done + num_updates], scales[done : done + num_updates]
        correction1, scales = self._corrections_from_now(num_updates + _STEPS_AHEAD)
        self._known = now, correction1, scales
        return correction1[:num_updates], scales[:num_updates]

    def _corrections_from_now(self, num_updates: int) -> tuple[Tensor, Tensor]:
        steps = torch.arange(1, num_updates + 1, dtype=torch.float64, device=self.lr.device).view(-1, 1, 1)
        counts = self.num_steps + steps
        return 1 - self.beta1**counts, (1 - self.beta2**counts).rsqrt().float()

    def step(self, gradients: Tensor) -> None:
        """Update the weights by one step of Adam."""
        if self._fused is not None:
            self._fused.step(gradients)
            self.num_steps += 1
            return
        if not self._rates:
            self.begin(1)
        rate, scale = self._rates.pop()
        mean, square = self.state["exp_avg"], self.state["exp_avg_sq"]
        for weights, gradient, m, v in _in_pieces(self.weights, gradients, mean, square):
            m.lerp_(gradient, self._weight1)
            v.mul_(self._beta2_32)
            v.add_(gradient * gradient * self._weight2)
            denominator = v.sqrt()
            denominator.mul_(scale).add_(self.epsilon)
            torch.div(m, denominator, out=denominator)
            denominator.mul_(rate)
            weights.sub_(denominator)
        self.num_steps += 1


@dataclass(frozen=True)
class _AlikeRows:
    """Rows that one call moves, as they have the same settings."""

    rows: list[int]
    state: list[list[Tensor]]
    """The weights, the mean and the squared gradients, and the number of the step, of each row."""
    settings: tuple[float, float, float, float]


class _FusedSteps:
    """The steps of `torch.optim.Adam(fused=True)` on a CPU, each row with settings of its own."""

    def __init__(self, adam: StackedAdam) -> None:
        self._adam = adam
        self._alike: list[_AlikeRows] = []
        self._num_left = 0
        self._numbers = torch.zeros(len(adam.weights))  # of the step that is made, as the kernel takes them

    def begin(self, num_updates: int) -> None:
        """Take the present learning rates and numbers of steps, for the next `num_updates` steps."""
        adam = self._adam
        columns = (adam.lr, adam.beta1, adam.beta2, adam.epsilon)
        by_settings: dict[tuple[float, float, float, float], list[int]] = {}
        for row, settings in enumerate(zip(*(column[:, 0].tolist() for column in columns), strict=True)):
            by_settings.setdefault(settings, []).append(row)
        tensors = (adam.weights, adam.state["exp_avg"], adam.state["exp_avg_sq"], self._numbers)
        self._alike = [
            _AlikeRows(rows, [[tensor[row] for row in rows] for tensor in tensors], settings)
            for settings, rows in by_settings.items()
        ]
        self._numbers.copy_(adam.num_steps[:, 0])
        self._num_left = num_updates

    def step(self, gradients: Tensor) -> None:
        """Update the weights by one step."""
        if not self._num_left:
            self.begin(1)
        self._num_left -= 1
        self._numbers += 1
        for alike in self._alike:
            weights, means, squares, numbers = alike.state
            lr, beta1, beta2, epsilon = alike.settings
            torch._fused_adam_(
                weights, [gradients[row] for row in alike.rows], means, squares, [], numbers,
                lr=lr, beta1=beta1, beta2=beta2, eps=epsilon, weight_decay=0.0, amsgrad=False, maximize=False,
            )  # fmt: skip


@cache
def can_fuse(device: str) -> bool:
    """Return whether torch has the fused step on a device; on CPUs since its version 2.4, on others it is not used."""
    if device != "cpu":
        return False
    one = [torch.zeros(1)]
    try:
        torch._fused_adam_(
            one, one, one, one, [], [torch.ones(1)], lr=0.0, beta1=0.0, beta2=0.0, eps=1.0,
            weight_decay=0.0, amsgrad=False, maximize=False,
        )  # fmt: skip
    except (AttributeError, TypeError, RuntimeError):
        return False
    return True


class StackedRMSprop:
    """RMSprop (Hinton 2012) as `torch.optim.RMSprop` computes it.

    Args:
        weights: The weights, (K, P); they are updated in place.
        lr: The learning rates, (K, 1).
        rho: Decay of the squared gradient, (K, 1), float64.
        momentum: The momentum, (K, 1).
        epsilon: Added to the denominator, (K, 1).
    """

    def __init__(self, weights: Tensor, lr: Tensor, rho: Tensor, momentum: Tensor, epsilon: Tensor) -> None:
        self.weights, self.lr = weights, lr
        self._momentum, self._epsilon = momentum, epsilon
        self._rho, self._weight = rho.float(), (1 - rho).float()
        self.state = {"square_avg": torch.zeros_like(weights), "momentum_buffer": torch.zeros_like(weights)}
        self.num_steps = torch.zeros_like(lr, dtype=torch.float64)

    def begin(self, num_updates: int) -> None:
        """Do nothing, because nothing is computed ahead."""

    def step(self, gradients: Tensor) -> None:
        """Update the weights by one step of RMSprop."""
        states = self.state["square_avg"], self.state["momentum_buffer"]
        for weights, gradient, square, buffer in _in_pieces(self.weights, gradients, *states):
            square.mul_(self._rho)
            square.add_(gradient * gradient * self._weight)
            update = gradient / (square.sqrt() + self._epsilon)
            # Without momentum the buffer is the update itself, as in torch.
            buffer.mul_(self._momentum).add_(update)
            weights.sub_(buffer * self.lr)
        self.num_steps += 1


def _in_pieces(*tensors: Tensor) -> Iterable[Sequence[Tensor]]:
    """Return tensors of the weights' shape in pieces that stay in a core's cache while a step goes over them again.

    Each number is computed by itself, so the pieces have no part in what it becomes. A few of them cost more in calls
    than they save.
    """
    first = tensors[0]
    if first.numel() <= 4 * _NUMBERS_AT_ONCE or first.is_cuda:
        return (tensors,)
    size = max(1, _NUMBERS_AT_ONCE // len(first))
    return zip(*(torch.split(tensor, size, dim=1) for tensor in tensors), strict=True)


def clip_by_global_norm(gradients: Tensor, limit: Tensor, networks_per_member: int) -> Tensor:
    """Scale each member's gradient to a global L2 norm of at most its limit, in place, as RLlib does.

    Args:
        gradients: (networks_per_member * M, P): the first networks of all members, then the second.
        limit: The largest norms, (M, 1); infinity: no clipping.
        networks_per_member: How many networks have one norm together.

    Returns:
        The norms before clipping, (M, 1).
    """
    norms: Tensor = torch.linalg.vector_norm(gradients.view(networks_per_member, -1, gradients.shape[1]), dim=2)
    num_members = norms.shape[1]
    # A single column is computed by other code, whose last bit may differ: a member would learn another thing alone.
    norms = torch.linalg.vector_norm(norms.repeat(1, 2) if num_members == 1 else norms, dim=0)
    norms = norms[:num_members].unsqueeze(1)
    # Without a limit the quotient is inf / inf.
    factors = torch.where(limit.isinf(), 1.0, (limit / torch.clamp(norms + 1e-6, min=limit)).clamp(max=1.0))
    gradients.mul_(factors.repeat(networks_per_member, 1))
    return norms
