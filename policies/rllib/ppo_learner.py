"""RLlib's PPO learner, with schedules that act from the first update on, and with observation statistics."""

from __future__ import annotations

from typing import Any

from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core.columns import Columns
from ray.rllib.utils.metrics import NUM_ENV_STEPS_SAMPLED_LIFETIME
from torch import Tensor

from policies.rllib.ruined import check_gradients, check_outputs

_KL_COEFFS = "kl_coeffs"


class PPOLearner(PPOTorchLearner):  # type: ignore[misc]
    """A PPO learner whose update phase at t env steps uses the learning rate and entropy weight of t.

    RLlib sets both after a phase, for the next one, and saves only the learning rate: after a restore, its entropy
    weight starts at the schedule's first value again, and its KL weight at the config's (2.60). Here both are set
    before each phase, and the KL weight is part of the learner's state.

    Gradients and outputs that are not finite are errors: see `policies.rllib.ruined`.

    Modules that normalise observations add a phase's observations to their statistics after its updates: a batch is
    trained with the statistics it was sampled with, so that PPO's ratio begins at 1.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._new_observations: dict[str, Tensor] = {}

    def compute_loss_for_module(self, *, module_id: str, config: Any, batch: Any, fwd_out: dict[str, Any]) -> Any:
        """Return RLlib's loss.

        Raises:
            NonFiniteWeightsError: The policy's outputs are not finite.
        """
        try:
            return super().compute_loss_for_module(module_id=module_id, config=config, batch=batch, fwd_out=fwd_out)
        except (ValueError, RuntimeError):
            # A distribution's: what it says of its parameters names no cause.
            check_outputs(fwd_out[Columns.ACTION_DIST_INPUTS], self.module[module_id].unwrapped())
            raise

    def compute_gradients(self, loss_per_module: dict[str, Any], **kwargs: Any) -> dict[Any, Tensor]:
        """Return RLlib's gradients.

        Raises:
            NonFiniteWeightsError: One is NaN or infinite.
        """
        gradients: dict[Any, Tensor] = super().compute_gradients(loss_per_module, **kwargs)
        check_gradients(gradients.values(), self.module[next(iter(loss_per_module))].unwrapped())
        return gradients

    def before_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Set the scheduled values for the env steps sampled so far, including this phase's batch."""
        super().before_gradient_based_update(timesteps=timesteps)
        num_env_steps = timesteps.get(NUM_ENV_STEPS_SAMPLED_LIFETIME, 0)
        for optimizer, schedule in self._optimizer_lr_schedules.items():
            self._set_optimizer_lr(optimizer, lr=schedule.update(timestep=num_env_steps))
        for module_id in self.module.keys():  # noqa: SIM118 (an RLlib container, which iterates otherwise)
            self.entropy_coeff_schedulers_per_module[module_id].update(timestep=num_env_steps)

    def after_gradient_based_update(self, *, timesteps: dict[str, Any]) -> None:
        """Let the modules add this phase's observations to their statistics."""
        super().after_gradient_based_update(timesteps=timesteps)
        for module_id, observations in self._new_observations.items():
            self.module[module_id].unwrapped().update_observation_statistics(observations)
        self._new_observations.clear()

    def get_state(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return the learner's state, with each module's KL weight and the one it began with."""
        state: dict[str, Any] = super().get_state(*args, **kwargs)
        state[_KL_COEFFS] = {
            module_id: (self._first_kl_coeff(module_id), float(value))
            for module_id, value in self.curr_kl_coeffs_per_module.items()
        }
        return state

    def set_state(self, state: dict[str, Any]) -> None:
        """Set a state of `get_state`, but not its KL weight if a search has changed kl_coeff since."""
        super().set_state(state)
        for module_id, (first, value) in state.get(_KL_COEFFS, {}).items():
            if first == self._first_kl_coeff(module_id):
                self.curr_kl_coeffs_per_module[module_id].data.fill_(value)

    def _first_kl_coeff(self, module_id: str) -> float:
        return float(self.config.get_config_for_module(module_id).kl_coeff)

    def _make_batch_if_necessary(self, training_data: Any) -> Any:
        batch = super()._make_batch_if_necessary(training_data)
        for module_id, columns in batch.policy_batches.items():
            if hasattr(self.module[module_id].unwrapped(), "update_observation_statistics"):
                # RLlib adds a row to each episode chunk, for the value after its end; that row is not a step.
                self._new_observations[module_id] = columns[Columns.OBS][columns[Columns.LOSS_MASK]]
        return batch
