"""Compute PPO's loss and gradients for many members at once: RLlib's loss, with each member's own coefficients.

Source: Schulman et al. 2017, "Proximal Policy Optimization Algorithms", equations 7 and 9, and RLlib's
`PPOTorchLearner.compute_loss_for_module` (2.60), which clips the squared value error and adds an adaptive KL penalty;
the range of values is that of PPO2 in OpenAI's Baselines.

Shapes: M members, B rows of a minibatch per member, A actions (or components of an action, or the values of all choices
of an action, one choice after another).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from policies.packed.ppo.softmax import log_softmax, sum_of_values

LOG_STD_CLIP = 20.0  # RLlib's value, as in policies.networks.rl_modules
_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class Heads:
    """What the outputs of a policy mean."""

    sizes: tuple[int, ...]
    """How many values each choice of an action has; empty: actions are continuous."""

    @property
    def is_gaussian(self) -> bool:
        """Whether actions are continuous: means and log standard deviations, not logits."""
        return not self.sizes

    def log_softmax(self, outputs: Tensor) -> Tensor:
        """Return the log probability of each value of each choice, (..., A)."""
        if len(self.sizes) == 1:
            return log_softmax(outputs)
        return torch.cat([log_softmax(logits) for logits in self._each(outputs)], dim=-1)

    def entropies(self, probabilities: Tensor, logp: Tensor) -> Tensor:
        """Return the entropy of each value's choice, (..., A), or (..., 1) if there is one choice."""
        products = probabilities * logp
        if len(self.sizes) == 1:
            return -sum_of_values(products).unsqueeze(-1)
        return torch.cat([-part.sum(dim=-1, keepdim=True).expand_as(part) for part in self._each(products)], dim=-1)

    def _each(self, values: Tensor) -> tuple[Tensor, ...]:
        """Return the values of each choice."""
        found: tuple[Tensor, ...] = values.split(self.sizes, dim=-1)  # type: ignore[no-untyped-call]
        return found


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of the parts of the loss in one iteration, (M, 1) each."""

    clip_param: Tensor
    vf_clip_param: Tensor
    """The limit of the squared value error; infinity: no clipping."""
    vf_clip_range: Tensor
    """The limit of a value's distance to `Minibatch.old_values`; infinity: none."""
    vf_loss_coeff: Tensor
    entropy_coeff: Tensor
    kl_coeff: Tensor

    # Computed once an iteration: of an update of small networks each call is a part.

    @cached_property
    def least_and_most(self) -> tuple[Tensor, Tensor]:
        """The limits of the ratio of probabilities, (M, 1) each."""
        return 1 - self.clip_param, 1 + self.clip_param

    @cached_property
    def has_entropy(self) -> bool:
        """Whether any member is rewarded for entropy."""
        return bool(self.entropy_coeff.any())

    @cached_property
    def limits_errors(self) -> bool:
        """Whether any member's squared value error is clipped."""
        return not bool(self.vf_clip_param.isinf().all())


@dataclass(eq=False)
class Minibatch:
    """The rows of one update."""

    actions: Tensor
    """Choices one-hot, one after another, continuous actions as the policy drew them, (M, B, A)."""
    logp: Tensor
    """Log probability of the action when it was drawn, (M, B)."""
    advantages: Tensor
    """Advantages as the loss takes them, (M, B)."""
    value_targets: Tensor
    """Value targets, (M, B)."""
    old_outputs: Tensor | None = None
    """The policy's outputs when the action was drawn, (M, B, outputs); None: no KL penalty."""
    old_values: Tensor | None = None
    """The values when the batch was sampled, (M, B); None: no member has a `vf_clip_range`."""


@dataclass(eq=False)
class Parts:
    """The loss and its parts as means over the minibatch, (M,) each."""

    total_loss: Tensor
    policy_loss: Tensor
    vf_loss: Tensor
    entropy: Tensor
    kl: Tensor


def gradients(
    outputs: Tensor, values: Tensor, batch: Minibatch, coefficients: Coefficients, *, heads: Heads
) -> tuple[Tensor, Tensor]:
    """Return the gradients of each member's loss with respect to policy outputs and values.

    Args:
        outputs: The policy's outputs, (M, B, A) logits or (M, B, 2A) means and log standard deviations.
        values: The value function's outputs, (M, B).
        batch: The rows.
        coefficients: The members' coefficients.
        heads: What the outputs mean.

    Returns:
        Two tensors with the shapes of `outputs` and `values`.
    """
    # Written out, because torch's graph of these small tensors would cost more than the networks.
    policy = _gaussian_gradient if heads.is_gaussian else _choices_gradient
    return policy(outputs, batch, coefficients, heads), _value_gradient(values, batch, coefficients)


def _choices_gradient(outputs: Tensor, batch: Minibatch, coefficients: Coefficients, heads: Heads) -> Tensor:
    num_rows = outputs.shape[1]
    logp_all = heads.log_softmax(outputs)
    probabilities = logp_all.exp()
    weight = _weights((logp_all * batch.actions).sum(dim=-1), batch, coefficients)
    out = (probabilities - batch.actions).mul_(weight)
    if coefficients.has_entropy:
        entropy = heads.entropies(probabilities, logp_all)
        scale = (coefficients.entropy_coeff / num_rows).unsqueeze(-1)
        out += (logp_all + entropy).mul_(probabilities).mul_(scale)
    if batch.old_outputs is not None:
        old = heads.log_softmax(batch.old_outputs).exp()
        out += (probabilities - old).mul_((coefficients.kl_coeff / num_rows).unsqueeze(-1))
    return out


def _gaussian_gradient(outputs: Tensor, batch: Minibatch, coefficients: Coefficients, _: Heads) -> Tensor:
    """Return the gradient for means m and log standard deviations l, of standard deviations s, (M, B, 2A).

    With z = (a - m) / s, the log probability of an action a moves by z / s with m and by z^2 - 1 with l; the entropy by
    1 with l; the divergence from a policy of m' and s' by (m - m') / s^2 with m and by 1 - (s'^2 + (m - m')^2) / s^2
    with l.
    """
    num_rows, num_actions = outputs.shape[1], outputs.shape[2] // 2
    mean, log_std = _split(outputs)
    inverse = torch.exp(-log_std)
    z = (batch.actions - mean).mul_(inverse)
    squares = z * z
    rows = squares.mul(0.5).add_(log_std).sum(dim=-1).add_(num_actions * _HALF_LOG_TWO_PI).neg_()
    weight = _weights(rows, batch, coefficients)
    out = torch.empty_like(outputs)
    of_mean, of_log_std = out[..., :num_actions], out[..., num_actions:]
    torch.mul(z, inverse, out=of_mean).mul_(-weight)
    torch.sub(1.0, squares, out=of_log_std).mul_(weight)
    of_log_std -= (coefficients.entropy_coeff / num_rows).unsqueeze(-1)
    if batch.old_outputs is not None:
        old_mean, old_log_std = _split(batch.old_outputs)
        scale = (coefficients.kl_coeff / num_rows).unsqueeze(-1)
        moved, precision = mean - old_mean, inverse * inverse
        spread = torch.exp(2 * old_log_std).add_(moved * moved).mul_(precision)
        of_mean += moved.mul_(precision).mul_(scale)
        of_log_std += (1.0 - spread).mul_(scale)
    # Beyond its limits a standard deviation does not move.
    of_log_std.masked_fill_(outputs[..., num_actions:].abs() > LOG_STD_CLIP, 0.0)
    return out


def _weights(logp: Tensor, batch: Minibatch, coefficients: Coefficients) -> Tensor:
    """Return what the gradient of each row's log probability, (M, B), counts in the mean of what is won, (M, B, 1)."""
    ratio = (logp - batch.logp).exp_()
    surrogate = batch.advantages * ratio
    limited = torch.clamp(ratio, *coefficients.least_and_most).mul_(batch.advantages)
    # The minimum passes the gradient where the ratio itself is smaller, where both are equal, and where it is NaN.
    return torch.where(surrogate > limited, 0.0, surrogate).mul_(1 / logp.shape[1]).unsqueeze(-1)


def _value_gradient(values: Tensor, batch: Minibatch, coefficients: Coefficients) -> Tensor:
    errors = values - batch.value_targets
    factor = coefficients.vf_loss_coeff * (2 / values.shape[1])
    if batch.old_values is None and not coefficients.limits_errors:
        return errors.mul_(factor)
    squares = _squared_errors(values, batch, coefficients)
    is_flat = squares > coefficients.vf_clip_param
    if batch.old_values is not None:
        # Where the value at the end of its range is farther from the target, it counts, and does not move.
        is_flat |= squares > errors**2
    return torch.where(is_flat, 0.0, errors).mul_(factor)


def _squared_errors(values: Tensor, batch: Minibatch, coefficients: Coefficients) -> Tensor:
    """Return the squared value errors that count, (M, B), before `vf_clip_param` limits them."""
    squares = (values - batch.value_targets) ** 2
    if batch.old_values is None:
        return squares
    moves, limit = values - batch.old_values, coefficients.vf_clip_range
    at_end = (batch.old_values + torch.clamp(moves, -limit, limit) - batch.value_targets) ** 2
    # Rows inside their range are left as they are, rather than rounded once more: so members without one are computed
    # as if nobody beside them had one.
    return torch.where(moves.abs() > limit, torch.maximum(squares, at_end), squares)


def loss(outputs: Tensor, values: Tensor, batch: Minibatch, coefficients: Coefficients, *, heads: Heads) -> Parts:
    """Return each member's loss and its parts, as RLlib computes them; the arguments are those of `gradients`."""
    logp, entropy = _logp_and_entropy(outputs, batch.actions, heads=heads)
    ratio = torch.exp(logp - batch.logp)
    limited = torch.clamp(ratio, *coefficients.least_and_most)
    surrogate = torch.min(batch.advantages * ratio, batch.advantages * limited)
    vf_loss = torch.minimum(_squared_errors(values, batch, coefficients), coefficients.vf_clip_param)
    kl = torch.zeros_like(entropy)
    if batch.old_outputs is not None:
        kl = _kl(batch.old_outputs, outputs, heads=heads)
    rows = -surrogate + coefficients.vf_loss_coeff * vf_loss - coefficients.entropy_coeff * entropy
    rows = rows + coefficients.kl_coeff * kl
    return Parts(rows.mean(dim=1), -surrogate.mean(dim=1), vf_loss.mean(dim=1), entropy.mean(dim=1), kl.mean(dim=1))


def _logp_and_entropy(outputs: Tensor, actions: Tensor, *, heads: Heads) -> tuple[Tensor, Tensor]:
    """Return the log probability of the actions and the entropy of the policy, (M, B) each."""
    if not heads.is_gaussian:
        logp_all = heads.log_softmax(outputs)
        return (logp_all * actions).sum(dim=-1), -sum_of_values(logp_all.exp() * logp_all)
    mean, log_std = _split(outputs)
    rows = -0.5 * ((actions - mean) / log_std.exp()) ** 2 - log_std - _HALF_LOG_TWO_PI
    return rows.sum(dim=-1), (log_std + 0.5 + _HALF_LOG_TWO_PI).sum(dim=-1)


def log_probabilities(outputs: Tensor, actions: Tensor, *, heads: Heads) -> Tensor:
    """Return the log probability of the actions, (M, B); the arguments are those of `gradients`."""
    return _logp_and_entropy(outputs, actions, heads=heads)[0]


def _kl(old: Tensor, new: Tensor, *, heads: Heads) -> Tensor:
    """Return the KL divergence of the present policy from the one that drew the actions, (M, B)."""
    if not heads.is_gaussian:
        old_logp = heads.log_softmax(old)
        return sum_of_values(old_logp.exp() * (old_logp - heads.log_softmax(new)))
    old_mean, old_log_std = _split(old)
    mean, log_std = _split(new)
    squares = torch.exp(2 * old_log_std) + (old_mean - mean) ** 2
    return (log_std - old_log_std + squares / (2 * torch.exp(2 * log_std)) - 0.5).sum(dim=-1)


def _split(outputs: Tensor) -> tuple[Tensor, Tensor]:
    mean, log_std = outputs.chunk(2, dim=-1)
    return mean, log_std.clamp(-LOG_STD_CLIP, LOG_STD_CLIP)
