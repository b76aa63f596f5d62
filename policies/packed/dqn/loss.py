"""Compute DQN's loss and its gradient for many members at once.

Sources: Mnih et al. 2015; van Hasselt et al. 2016 (double Q-learning); Wang et al. 2016, equation 9 (dueling).

Shapes: M members, B rows, A actions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from policies.packed.shared import SharedByDQN


@dataclass(frozen=True, eq=False)
class Loss:
    """The results of one update's forward passes."""

    gradient: Tensor
    """The gradient of each member's loss with respect to the network's outputs, (M, B, outputs)."""
    td_errors: Tensor
    """Q(s, a) minus its target, (M, B)."""
    q_selected: Tensor
    """Q(s, a), (M, B)."""


def q_values(outputs: Tensor, num_actions: int) -> Tensor:
    """Return Q, (M, B, A), from a network's outputs: Q-values, or advantages and a value if dueling."""
    if outputs.shape[-1] == num_actions:
        return outputs
    advantages = outputs[..., :num_actions]
    return outputs[..., num_actions:] + advantages - advantages.mean(dim=-1, keepdim=True)


def best_next_values(target_q: Tensor, online_q: Tensor | None) -> Tensor:
    """Return Q' of the best next action, (M, B), chosen by Q' or, in double Q-learning, by the online network."""
    if online_q is None:
        return target_q.amax(dim=-1)
    return target_q.gather(-1, online_q.argmax(dim=-1, keepdim=True)).squeeze(-1)


def loss_gradient(
    outputs: Tensor, actions: Tensor, targets: Tensor, weights: Tensor | None, shared: SharedByDQN
) -> Loss:
    """Return the gradient of each member's mean loss.

    Args:
        outputs: The online network's outputs for the observations, (M, B, outputs).
        actions: The actions as whole numbers, (M, B).
        targets: The targets of Q, (M, B).
        weights: Importance weights, (M, B); None: all 1.
        shared: The hyperparameters that the members share.
    """
    num_actions = outputs.shape[-1] - shared.dueling
    index = actions.unsqueeze(-1)
    q_selected = q_values(outputs, num_actions).gather(-1, index).squeeze(-1)
    td_errors = q_selected - targets
    slope = td_errors.clamp(-1.0, 1.0) if shared.td_loss == "huber" else 2.0 * td_errors
    if weights is not None:
        slope = slope * weights
    slope = (slope / td_errors.shape[1]).unsqueeze(-1)
    gradient = torch.zeros_like(outputs)
    if shared.dueling:
        # Q = V + A - mean A: the mean depends on every advantage.
        gradient[..., :num_actions] = slope / -num_actions
        gradient[..., num_actions:] = slope
        gradient[..., :num_actions].scatter_add_(-1, index, slope)
    else:
        gradient.scatter_(-1, index, slope)
    return Loss(gradient, td_errors, q_selected)


def mean_loss(td_errors: Tensor, weights: Tensor | None, shared: SharedByDQN) -> Tensor:
    """Return each member's mean loss, (M,)."""
    if shared.td_loss == "huber":
        small = td_errors.abs()
        rows = torch.where(small <= 1.0, 0.5 * td_errors**2, small - 0.5)
    else:
        rows = td_errors**2
    return (rows if weights is None else rows * weights).mean(dim=1)
