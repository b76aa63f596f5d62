"""The gradient of DQN's loss is written out: it is that of the loss as torch's graph computes it."""

from typing import Any, cast

import pytest
import torch
from torch import nn

from policies.hyperparams import DQNHyperparams
from policies.packed.dqn import loss as dqn
from tests.narrowing import present
from tests.rounding import close

M, B = 3, 50


def by_autograd(
    outputs: torch.Tensor,
    actions: torch.Tensor,
    targets: torch.Tensor,
    weights: torch.Tensor | None,
    hyperparams: DQNHyperparams,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """(gradient, loss of each member) of the loss as it is defined."""
    outputs = outputs.clone().requires_grad_()
    num_actions = outputs.shape[-1] - hyperparams.dueling
    q = outputs
    if hyperparams.dueling:
        advantages = outputs[..., :num_actions]
        q = outputs[..., -1:] + advantages - advantages.mean(dim=-1, keepdim=True)
    selected = torch.stack([q[m, torch.arange(B), actions[m]] for m in range(M)])
    function = nn.functional.huber_loss if hyperparams.td_loss == "huber" else nn.functional.mse_loss
    rows = function(selected, targets, reduction="none")
    losses = (rows if weights is None else rows * weights).mean(dim=1)
    losses.sum().backward()  # type: ignore[no-untyped-call]
    return present(outputs.grad), losses.detach(), selected.detach()


@pytest.mark.usefixtures("in_double")
@pytest.mark.parametrize("has_weights", [False, True])
@pytest.mark.parametrize("td_loss", ["huber", "mse"])
@pytest.mark.parametrize("dueling", [False, True])
@pytest.mark.parametrize("num_actions", [2, 4])
def test_the_gradient_by_hand_is_that_of_the_loss(
    num_actions: int, dueling: bool, td_loss: str, has_weights: bool
) -> None:
    hyperparams = DQNHyperparams(dueling=dueling, td_loss=td_loss)
    rng = torch.Generator().manual_seed(num_actions)
    outputs = 2 * torch.randn(M, B, num_actions + dueling, generator=rng)
    actions = torch.randint(num_actions, (M, B), generator=rng)
    targets = torch.randn(M, B, generator=rng)
    weights = torch.rand(M, B, generator=rng) if has_weights else None
    found = dqn.loss_gradient(outputs, actions, targets, weights, cast("Any", hyperparams))
    gradient, losses, selected = by_autograd(outputs, actions, targets, weights, hyperparams)
    # Of both branches of Huber's loss, on both sides.
    assert all((mask.float().mean() > 0.1) for mask in (found.td_errors > 1, found.td_errors < -1))
    assert (found.td_errors.abs() < 1).float().mean() > 0.1
    close(found.gradient, gradient)
    close(found.q_selected, selected)
    close(found.td_errors, selected - targets)
    close(dqn.mean_loss(found.td_errors, weights, cast("Any", hyperparams)), losses)


def test_the_best_next_action_is_the_target_networks_or_the_online_ones() -> None:
    rng = torch.Generator().manual_seed(0)
    target, online = torch.randn(M, B, 4, generator=rng), torch.randn(M, B, 4, generator=rng)
    alone, double = dqn.best_next_values(target, None), dqn.best_next_values(target, online)
    for m in range(M):
        for b in range(B):
            assert alone[m, b] == max(target[m, b].tolist())
            assert double[m, b] == target[m, b, int(online[m, b].argmax())]
    assert (alone > double).any()
