"""An RLModule of one's own for PPO: layer normalisation, which no hyperparameter asks for."""

from __future__ import annotations

from typing import Any

from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor, nn


class NormNet(TorchRLModule, ValueFunctionAPI):  # type: ignore[misc]
    """One trunk for policy and value function; the hyperparameter `hidden_sizes` gives its width."""

    def setup(self) -> None:
        """Build the layers: RLlib calls this once."""
        width = self.model_config["fcnet_hiddens"][0]
        self.trunk = nn.Sequential(nn.Linear(self.observation_space.shape[0], width), nn.LayerNorm(width), nn.Tanh())
        self.policy = nn.Linear(width, int(self.action_space.n))
        self.value = nn.Linear(width, 1)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        return {"action_dist_inputs": self.policy(self.trunk(batch["obs"]))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Tensor:  # noqa: ARG002 - RLlib's name
        """Values of observations, shape (num,)."""
        values: Tensor = self.value(self.trunk(batch["obs"])).squeeze(-1)
        return values
