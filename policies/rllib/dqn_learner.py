"""RLlib's DQN learner with the variants of `DQNHyperparams`, and a short path from replay memory to optimizer.

RLlib's own `Learner.update` turns every batch into episodes and back, cuts it into minibatches and logs a dozen
metrics, which takes ten times as long as the update of a small network. The results here are the same:
`tests/ray/test_dqn_learner.py` compares them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn.torch.dqn_torch_learner import DQNTorchLearner
from ray.rllib.core import DEFAULT_MODULE_ID
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis import TargetNetworkAPI
from torch import Tensor

from policies.hyperparams import DQNHyperparams
from policies.networks.denormals import denormals_as_zero
from policies.replay import ReplayBuffer, Transitions
from policies.schedules import linear

DISCOUNTS, WEIGHTS = "discounts", "weights"
QF_PREDS, QF_NEXT_PREDS, QF_TARGET_NEXT_PREDS = "qf_preds", "qf_next_preds", "qf_target_next_preds"


class DQNLearner(DQNTorchLearner):  # type: ignore[misc]
    """Learns from a replay memory; the config must hold `hyperparams`.

    `target_updates_at` is the number of env steps or episodes at the last target update.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.target_updates_at = 0.0
        self.num_target_updates = 0
        self._pairs: tuple[list[Tensor], list[Tensor]] | None = None

    @property
    def hyperparams(self) -> DQNHyperparams:
        """The trial's hyperparameters."""
        hyperparams: DQNHyperparams = self.config.hyperparams
        return hyperparams

    def configure_optimizers_for_module(self, module_id: str, config: Any = None) -> None:  # noqa: ARG002 - RLlib's signature
        """Register Adam or RMSprop with all their arguments; RLlib has only Adam, and drops its epsilon (2.60)."""
        params = self.get_parameters(self.module[module_id])
        hyperparams = self.hyperparams
        optimizer: torch.optim.Optimizer
        if hyperparams.optimizer == "adam":
            optimizer = torch.optim.Adam(
                params,
                lr=hyperparams.lr,
                betas=(hyperparams.adam_beta1, hyperparams.adam_beta2),
                eps=hyperparams.optimizer_epsilon,
                # One call for all tensors takes half the time of the default on small networks.
                fused=True,
            )
        else:
            optimizer = torch.optim.RMSprop(
                params,
                lr=hyperparams.lr,
                alpha=hyperparams.rmsprop_rho,
                eps=hyperparams.optimizer_epsilon,
                momentum=hyperparams.rmsprop_momentum,
                foreach=True,
            )
        self.register_optimizer(
            module_id=module_id, optimizer=optimizer, params=params, lr_or_lr_schedule=hyperparams.lr
        )

    def lr_at(self, num_env_steps: float) -> float:
        """Return the learning rate after a number of env steps."""
        hyperparams = self.hyperparams
        return linear(hyperparams.lr, hyperparams.lr_final, hyperparams.lr_decay_steps, num_env_steps)

    @denormals_as_zero()
    def update_from_replay(
        self, replay: ReplayBuffer, num_updates: int, *, num_env_steps: int, num_new_steps: int, num_episodes: int
    ) -> dict[str, float]:
        """Make one training phase.

        Args:
            replay: The memory that batches are drawn from and whose priorities are set.
            num_updates: Updates to make.
            num_env_steps: Env steps of the trial so far.
            num_new_steps: Env steps since the last phase: the updates are spread evenly over them, so that
                `target_update_freq` means the same whatever `train_freq` is.
            num_episodes: Whole episodes of the trial so far.

        Returns:
            The metrics of the last update.
        """
        hyperparams = self.hyperparams
        optimizer = self.get_optimizer(DEFAULT_MODULE_ID)
        if hyperparams.lr_final is not None:
            for group in optimizer.param_groups:
                group["lr"] = self.lr_at(num_env_steps)
        stats: dict[str, Tensor | float] = {}
        for number, rows in enumerate(replay.batches(num_updates, hyperparams.train_batch_size), start=1):
            stats = self.update_from_transitions(rows, optimizer)
            if rows.indices is not None:
                replay.set_priorities(rows.indices, _numpy(stats["td_errors"]))
            self._update_target(num_env_steps - num_new_steps * (1 - number / num_updates), num_episodes)
        stats.pop("td_errors", None)
        return {name: float(value) for name, value in stats.items()} | {"lr": optimizer.param_groups[0]["lr"]}

    def update_from_transitions(self, rows: Transitions, optimizer: torch.optim.Optimizer) -> dict[str, Tensor | float]:
        """Make one gradient step on one batch.

        Returns:
            `total_loss`, `qf_mean`, `gradient_norm` (if clipped) and `td_errors`, shape (B,).
        """
        module = self.module[DEFAULT_MODULE_ID]
        batch = self.to_batch(rows)
        out = module._forward_train(batch)  # noqa: SLF001 - forward_train only adds a check that takes as long
        loss, td_errors, q_selected = self.loss(batch, out)
        # The same as `zero_grad`, without its bookkeeping.
        params = [param for group in optimizer.param_groups for param in group["params"]]
        for param in params:
            param.grad = None
        loss.backward()  # type: ignore[no-untyped-call]
        stats: dict[str, Tensor | float] = {"total_loss": loss.detach(), "td_errors": td_errors}
        stats["qf_mean"] = q_selected.detach().mean()
        if self.hyperparams.grad_clip is not None:
            stats["gradient_norm"] = torch.nn.utils.clip_grad_norm_(params, self.hyperparams.grad_clip, foreach=True)
        optimizer.step()
        return stats

    def to_batch(self, rows: Transitions) -> dict[str, Tensor]:
        """Return rows as tensors on the learner's device, by RLlib's names."""
        batch = {
            Columns.OBS: rows.obs,
            Columns.ACTIONS: rows.actions,
            Columns.REWARDS: rows.rewards,
            Columns.NEXT_OBS: rows.next_obs,
            DISCOUNTS: rows.discounts,
        }
        if rows.weights is not None:
            batch[WEIGHTS] = rows.weights
        return {name: torch.from_numpy(values).to(self._device) for name, values in batch.items()}

    def loss(self, batch: dict[str, Tensor], out: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the loss, |TD errors| and Q(s, a), of shapes (), (B,) and (B,).

        The target is reward_scale * r + discount * Q'(s', a'), where Q' is the target network (or the online one, where
        there is none) and a' the best action by Q' or, for double Q-learning, by the online network.
        """
        hyperparams = self.hyperparams
        q_selected = out[QF_PREDS].gather(1, batch[Columns.ACTIONS][:, None].long()).squeeze(1)
        with torch.no_grad():
            q_next = out[QF_TARGET_NEXT_PREDS]
            if hyperparams.double_q:
                best = q_next.gather(1, out[QF_NEXT_PREDS].argmax(dim=1, keepdim=True)).squeeze(1)
            else:
                best = q_next.max(dim=1).values
            targets = hyperparams.reward_scale * batch[Columns.REWARDS] + batch[DISCOUNTS] * best
            td_errors = (q_selected - targets).abs()
        function = torch.nn.functional.huber_loss if hyperparams.td_loss == "huber" else torch.nn.functional.mse_loss
        if WEIGHTS not in batch:
            return function(q_selected, targets), td_errors, q_selected
        return (batch[WEIGHTS] * function(q_selected, targets, reduction="none")).mean(), td_errors, q_selected

    def _update_target(self, num_env_steps: float, num_episodes: int) -> None:
        """Update the target network, if it is due."""
        hyperparams = self.hyperparams
        if not hyperparams.target_network:
            return
        interval = hyperparams.target_update_interval
        if interval is not None:
            now = num_episodes if hyperparams.target_update_unit == "episode" else num_env_steps
            if now - self.target_updates_at < interval:
                return
            self.target_updates_at = now
        self.update_target()

    def update_target(self) -> None:
        """Set the target network to tau * online + (1 - tau) * target, now."""
        if self._pairs is None:
            module = self.module[DEFAULT_MODULE_ID].unwrapped()
            pairs = module.get_target_network_pairs() if isinstance(module, TargetNetworkAPI) else []
            self._pairs = (
                [param for main, _ in pairs for param in main.parameters()],
                [param for _, target in pairs for param in target.parameters()],
            )
        online, target = self._pairs
        with torch.no_grad():
            if self.hyperparams.tau == 1.0:
                torch._foreach_copy_(target, online)
            else:
                torch._foreach_lerp_(target, online, self.hyperparams.tau)
        self.num_target_updates += 1


def _numpy(value: Tensor | float) -> NDArray[np.float32]:
    assert isinstance(value, Tensor)
    return value.detach().cpu().numpy()
