"""The RLModules of PPO and DQN, built from hyperparameters.

RLlib's default modules support only a part of `policies.hyperparams`. The modules here add the rest: initial weights,
convolutions without padding, normalised observations, DQN without a target network. Names of weights: an encoder's
are `conv.N` and `mlp.N`; PPO's encoders are `encoder.actor_encoder` and `encoder.critic_encoder`, or `encoder.encoder`
if they are shared, and its heads `pi` and `vf`; DQN has `encoder`, `af` (Q-values, or advantages), `vf` if dueling, and
the same names with `_target_` before them.
"""

from __future__ import annotations

from typing import Any, TypeAlias, cast

import gymnasium as gym
import torch
from ray.rllib.algorithms.dqn.torch.default_dqn_torch_rl_module import DefaultDQNTorchRLModule
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.core.columns import Columns
from ray.rllib.core.learner.utils import make_target_network
from ray.rllib.core.models.catalog import Catalog
from ray.rllib.core.rl_module.rl_module import RLModule, RLModuleSpec
from torch import Tensor, nn

from policies.errors import SpecError
from policies.hyperparams import PPOHyperparams, TrainedHyperparams
from policies.networks.exploration import EpsilonGreedy
from policies.networks.layers import Encoder, ObservationStatistics
from policies.networks.own_modules import ASKED, check_own_module
from policies.networks.parts import DQNNetworks, PPONetworks, model_config

QF_PREDS, QF_NEXT_PREDS, QF_TARGET_NEXT_PREDS = "qf_preds", "qf_next_preds", "qf_target_next_preds"
RL_MODULE_KEY = "rl_module"
"""The key of `model_config` with the path of a user's own RLModule class."""

_LOG_STD_CLIP = 20.0  # RLlib's default (log_std_clip_param of its DefaultModelConfig)

Batch: TypeAlias = dict[str, Any]


class ActionCatalog(Catalog):  # type: ignore[misc]
    """RLlib's catalog, reduced to the distribution of actions, because our modules build their networks themselves."""

    def _determine_components_hook(self) -> None:
        self._action_dist_class_fn = lambda framework: self._get_dist_cls_from_action_space(
            self.action_space, framework=framework
        )


class PPOModule(ObservationStatistics, DefaultPPOTorchRLModule):  # type: ignore[misc]
    """PPO's policy and value function, with two encoders or a shared one."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "catalog_class": ActionCatalog})

    def setup(self) -> None:
        """Build the networks; see `RLModule.setup`."""
        config = self.model_config
        self.add_statistics()
        self._shares = bool(config["vf_share_layers"])
        parts = PPONetworks(self.observation_space, self.action_space, config, inference_only=self.inference_only)
        self.encoder, self.pi, self.vf = parts.encoder, parts.pi, parts.vf
        self._actor_name = "encoder" if self._shares else "actor_encoder"
        self._is_gaussian = isinstance(self.action_space, gym.spaces.Box)
        self._has_free_log_std = bool(config.get("free_log_std"))

    @property
    def _actor(self) -> Encoder:
        # Not stored as an attribute, or torch would list its weights twice.
        return cast("Encoder", self.encoder[self._actor_name])

    def _forward(self, batch: Batch, **_: Any) -> Batch:
        features = self._actor(self.prepare(batch[Columns.OBS]))
        return {Columns.ACTION_DIST_INPUTS: self.allowed(self._policy(features), batch[Columns.OBS])}

    def _forward_train(self, batch: Batch, **_: Any) -> Batch:
        observations = self.prepare(batch[Columns.OBS])
        features = self._actor(observations)
        embeddings = features if self._shares else self.encoder["critic_encoder"](observations)
        outputs = self.allowed(self._policy(features), batch[Columns.OBS])
        return {Columns.EMBEDDINGS: embeddings, Columns.ACTION_DIST_INPUTS: outputs}

    def _policy(self, features: Tensor) -> Tensor:
        if not self._is_gaussian:
            outputs: Tensor = self.pi(features)
            return outputs
        if self._has_free_log_std:
            # The other rows of the weights are 0, and get no gradient.
            num_actions = self.pi.out_features // 2
            mean = nn.functional.linear(features, self.pi.weight[:num_actions], self.pi.bias[:num_actions])
            log_std = self.pi.bias[num_actions:].expand_as(mean)
        else:
            mean, log_std = self.pi(features).chunk(2, dim=-1)
        return torch.cat((mean, log_std.clamp(-_LOG_STD_CLIP, _LOG_STD_CLIP)), dim=-1)

    def compute_values(self, batch: Batch, embeddings: Tensor | None = None) -> Tensor:
        """Return the values, shape (B,); `embeddings` come from `forward_train`, if it was called with this batch."""
        if embeddings is None:
            encoder = self._actor if self._shares else self.encoder["critic_encoder"]
            embeddings = encoder(self.prepare(batch[Columns.OBS]))
        values: Tensor = self.vf(embeddings).squeeze(-1)
        return values


class DQNModule(EpsilonGreedy, ObservationStatistics, DefaultDQNTorchRLModule):  # type: ignore[misc]
    """DQN's Q-network, dueling or not, with or without a target network."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "catalog_class": ActionCatalog})

    def setup(self) -> None:
        """Build the networks; see `RLModule.setup`."""
        config = self.model_config
        self.add_statistics()
        self.uses_dueling = bool(config["dueling"])
        self.uses_double_q = bool(config["double_q"])
        self.uses_target_network = bool(config["target_network"])
        self.num_atoms = 1  # read by RLlib's learner
        parts = DQNNetworks(self.observation_space, self.action_space, config)
        self.encoder, self.af, self.vf = parts.encoder, parts.af, parts.vf

    def make_target_networks(self) -> None:
        """Copy the networks with their weights, unless there is no target network."""
        if self.uses_target_network:
            self._target_encoder = make_target_network(self.encoder)
            self._target_af = make_target_network(self.af)
            self._target_vf = make_target_network(self.vf) if self.uses_dueling else None

    def get_target_network_pairs(self) -> list[tuple[nn.Module, nn.Module]]:
        """Return pairs of a network and its target network, for the target updates."""
        if not self.uses_target_network:
            return []
        networks: list[Any] = [self.encoder, self.af]
        targets = [self._target_encoder, self._target_af]
        if self.uses_dueling:
            networks, targets = [*networks, self.vf], [*targets, self._target_vf]
        return list(zip(networks, targets, strict=True))

    def get_non_inference_attributes(self) -> list[str]:
        """Return the names of the attributes that acting does not need."""
        return ["_target_encoder", "_target_af", "_target_vf"]

    def get_initial_state(self) -> Batch:
        """Return an empty state, because the networks are not recurrent."""
        return {}

    def compute_q_values(self, batch: Batch) -> Batch:
        """Return the Q-values of the online network, shape (B, num_actions)."""
        observations = batch[Columns.OBS]
        q_values = _q_values(self.prepare(observations), self.encoder, self.af, self.vf)
        return {QF_PREDS: self.allowed(q_values, observations)}

    def forward_target(self, batch: Batch) -> Batch:
        """Return the Q-values of the target network, or of the online one if there is none, without gradient."""
        return {QF_PREDS: self._bootstrap(batch[Columns.OBS])}

    def _forward_inference(self, batch: Batch, **_: Any) -> Batch:
        return {Columns.ACTIONS: self.compute_q_values(batch)[QF_PREDS].argmax(dim=-1)}

    def _forward_train(self, batch: Batch, **_: Any) -> Batch:
        next_observations = batch[Columns.NEXT_OBS]
        out = self.compute_q_values(batch)
        if self.uses_double_q:
            # Only the best action is used, so no gradient is needed.
            with torch.no_grad():
                out[QF_NEXT_PREDS] = self.compute_q_values({Columns.OBS: next_observations})[QF_PREDS]
        out[QF_TARGET_NEXT_PREDS] = self._bootstrap(next_observations)
        return out

    @torch.no_grad()
    def _bootstrap(self, observations: Tensor) -> Tensor:
        prepared = self.prepare(observations)
        if self.uses_target_network:
            q_values = _q_values(prepared, self._target_encoder, self._target_af, self._target_vf)
        else:
            q_values = _q_values(prepared, self.encoder, self.af, self.vf)
        return self.allowed(q_values, observations)


def _q_values(observations: Tensor, encoder: nn.Module, af: nn.Module, vf: nn.Module | None) -> Tensor:
    """Return Q(s, a) = A(s, a), or V(s) + A(s, a) - mean A(s, .) if dueling (Wang et al. 2016, equation 9)."""
    features = encoder.forward(observations)
    advantages: Tensor = af.forward(features)
    if vf is None:
        return advantages
    values: Tensor = vf.forward(features)
    return values + advantages - advantages.mean(dim=-1, keepdim=True)


# -- from hyperparameters


def module_spec(hyperparams: TrainedHyperparams, rl_module: str | None = None) -> RLModuleSpec:
    """Return the specification that RLlib builds the RLModule from.

    Args:
        hyperparams: Validated hyperparameters; their type chooses PPO or DQN.
        rl_module: `module:Class` of an RLModule of the user's own, in an allowed module; None: ours. The user's class
            gets the same `model_config` and may use it as it likes.

    Raises:
        SpecError: The class cannot be imported, or the algorithm cannot train it.
    """
    config = model_config(hyperparams)
    if rl_module is None:
        ours = PPOModule if isinstance(hyperparams, PPOHyperparams) else DQNModule
        return RLModuleSpec(module_class=ours, model_config=config)
    return RLModuleSpec(
        module_class=_own_class(hyperparams, rl_module), model_config={**config, RL_MODULE_KEY: rl_module}
    )


def _own_class(hyperparams: TrainedHyperparams, rl_module: str) -> type[RLModule]:
    found = import_module_class(rl_module)
    if isinstance(hyperparams, PPOHyperparams):
        check_own_module(rl_module, found, "ppo", {})
    else:
        check_own_module(rl_module, found, "dqn", {name: [getattr(hyperparams, name)] for name in ASKED})
    return found


def import_module_class(rl_module: str) -> type[RLModule]:
    """Import an RLModule class from an allowed module.

    Args:
        rl_module: `module:Class`.

    Raises:
        SpecError: Its module is not allowed, or the path does not name an RLModule class.
    """
    from policies.envs.modules import import_allowed

    found = import_allowed(rl_module)
    if not (isinstance(found, type) and issubclass(found, RLModule)):
        raise SpecError(
            f"rl_module {rl_module!r} is {found!r}, which is not an RLModule class.",
            "Give the import path of a class, such as my_package.networks:MyModule.",
        )
    return found
