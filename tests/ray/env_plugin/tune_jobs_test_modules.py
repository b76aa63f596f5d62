"""RLModule classes as a user writes them, and what is none."""

from typing import Any

import torch
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.core.rl_module.apis import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import nn

from policies.networks import DQNModule

NUMBER = 3


class OwnPPO(TorchRLModule, ValueFunctionAPI):  # type: ignore[misc]  # RLlib is not typed
    """From scratch: an LSTM-free trunk with layer normalisation, which no hyperparameter can ask for."""

    def setup(self) -> None:
        size = self.model_config["fcnet_hiddens"][0]
        self.trunk = nn.Sequential(nn.Linear(self.observation_space.shape[0], size), nn.LayerNorm(size), nn.Tanh())
        box = self.action_space.shape
        self.policy = nn.Linear(size, 2 * box[0] if box else int(self.action_space.n))
        self.value = nn.Linear(size, 1)

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {"action_dist_inputs": self.policy(self.trunk(batch["obs"]))}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return self.value(self.trunk(batch["obs"])).squeeze(-1)


class OwnDQN(DQNModule):
    """Ours, with one more number."""

    def setup(self) -> None:
        super().setup()
        self.offset = nn.Parameter(torch.zeros(int(self.action_space.n)))

    def compute_q_values(self, batch: dict[str, Any]) -> dict[str, Any]:
        out = super().compute_q_values(batch)
        out["qf_preds"] = out["qf_preds"] + self.offset
        return out


class PlainDQN(DefaultDQNTorchRLModule):  # type: ignore[misc]
    """RLlib's."""


class NoValues(TorchRLModule):  # type: ignore[misc]
    """Cannot learn PPO."""


class RecurrentPPO(OwnPPO):
    """Asks for what it gave at the step before."""

    def get_initial_state(self) -> dict[str, Any]:
        return {"h": torch.zeros(4)}

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {**super()._forward(batch), "state_out": {"h": batch["state_in"]["h"] + 1.0}}


class RecurrentDQN(OwnDQN):
    """Asks for what it gave at the step before."""

    def get_initial_state(self) -> dict[str, Any]:
        return {"h": torch.zeros(4)}


class NotOfVectors(OwnPPO):
    """Can't be built."""

    def setup(self) -> None:
        raise NotImplementedError("of images only")


class OfNoState(OwnPPO):
    """Says itself that it is not recurrent."""

    def get_initial_state(self) -> dict[str, Any]:
        return {}
