"""Act greedily by a user's own RLModule, loaded from its portable file; needs torch and RLlib, but no running Ray."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.dqn.dqn_catalog import DQNCatalog
from ray.rllib.algorithms.ppo.ppo_catalog import PPOCatalog
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule, RLModuleSpec

from policies.acting.policy import WeightsPolicy
from policies.envs.own_actions import Choices
from policies.errors import CheckpointError
from policies.networks.own_modules import check_stateless
from policies.networks.rl_modules import import_module_class
from policies.portable.file import ModuleWeights, PortablePolicy


class ModulePolicy(WeightsPolicy):
    """A policy that acts greedily by an RLModule class of the user's own.

    Each observation gets a forward pass of its own, so that its action does not depend on what else is in a batch.

    Args:
        portable: A policy whose network is of kind `module`.
        description: Shown in captions; by default the algorithm and the env.

    Raises:
        SpecError: The class's module is not allowed, the class cannot be imported, or it is recurrent.
        CheckpointError: The saved weights are not those of the class.
    """

    def __init__(self, portable: PortablePolicy, description: str | None = None) -> None:
        super().__init__(portable, description)
        assert portable.network.module is not None  # read_policy and save_policy have checked it
        self.module = self._build(portable.network.module)

    def __reduce__(self) -> tuple[type[ModulePolicy], tuple[PortablePolicy, str]]:
        # Modules hold what can't be pickled, such as RLlib's distributions of several choices: it is built anew.
        return type(self), (self.portable, self.description)

    def _build(self, saved: ModuleWeights) -> RLModule:
        module = RLModuleSpec(
            module_class=import_module_class(saved.class_path),
            observation_space=self.observation_space,
            action_space=self.action_space,
            inference_only=True,
            model_config=saved.model_config,
            # As in training, where RLlib gives a module its algorithm's catalog.
            catalog_class=PPOCatalog if self.portable.algorithm == "ppo" else DQNCatalog,
        ).build()
        check_stateless(module)
        # torch takes writable arrays only, and those of safetensors are not.
        state = {name: torch.from_numpy(np.array(tensor)) for name, tensor in saved.tensors.items()}
        try:
            module.load_state_dict(state)
        except RuntimeError as error:  # torch's for missing, unknown and misshapen weights
            raise CheckpointError(
                f"The weights of the policy for {self.env_id} are not those of {saved.class_path}: {error}.",
                "Use the version of the class that it was trained with.",
            ) from error
        module.eval()
        return module

    def _act_batch(self, observations: NDArray[np.float32]) -> NDArray[Any]:
        if len(observations) == 0:
            return np.zeros((0, *(self.action_space.shape or ())), dtype=self.action_space.dtype)
        # Observations reach the module as the env runner gives them: bytes stay bytes.
        dtype = np.uint8 if self.observation_space.dtype == np.uint8 else np.float32
        batch = torch.from_numpy(np.ascontiguousarray(observations, dtype=dtype))
        with torch.no_grad():
            actions = np.concatenate([self._greedy(batch[index : index + 1]) for index in range(len(batch))])
        if isinstance(self.action_space, gym.spaces.Discrete):
            return actions + int(self.action_space.start)
        if isinstance(self.action_space, Choices):
            return actions.astype(np.int64)
        return self._to_actions(actions)

    def _greedy(self, observation: torch.Tensor) -> NDArray[Any]:
        """Return the actions for a batch of one observation, as the module numbers or scales them."""
        out = self.module.forward_inference({Columns.OBS: observation})
        if Columns.ACTIONS not in out:
            distribution = self.module.get_inference_action_dist_cls().from_logits(out[Columns.ACTION_DIST_INPUTS])
            return np.asarray(distribution.to_deterministic().sample())
        return np.asarray(out[Columns.ACTIONS])
