"""What Stable-Baselines3 and RLlib call the hyperparameters, and where a name of theirs means something else.

The one table of such names: messages about unknown hyperparameters, `tune-jobs hyperparams` and the reference are made
from it. It is about Stable-Baselines3 2.7 to 2.9 and RLlib's `AlgorithmConfig` of Ray 2.60 (the new API stack), whose
sources it was read from, with names of older versions that are still met.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

from policies.hyperparams import Algorithm

Library = Literal["SB3", "RLlib"]
LIBRARIES: dict[Library, str] = {"SB3": "Stable-Baselines3", "RLlib": "RLlib"}
"""The libraries, with their whole names."""
SB3: Library = "SB3"
RLLIB: Library = "RLlib"


class ForeignName(NamedTuple):
    """A setting of another library."""

    library: Library
    name: str
    ours: tuple[str, ...]
    """Our hyperparameters for it, the first being nearest; empty: there is none."""
    difference: str = ""
    """How to compute ours, or why there is none; empty: the same values mean the same."""


_LR = "a schedule from a to b over n env steps is lr a, lr_final b, lr_decay_steps n"
_CLIP = "a number; a schedule from a to b over n env steps is clip_param a, clip_param_final b, clip_decay_steps n"
_ENTROPY = "a schedule from a to b over n env steps is entropy_coeff a, entropy_coeff_final b, entropy_decay_steps n"
_FROM_PLAN = "it follows from the other settings"

_SHARED: tuple[ForeignName, ...] = (
    ForeignName(SB3, "learning_rate", ("lr",), _LR),
    ForeignName(SB3, "gamma", ("gamma",)),
    ForeignName(SB3, "max_grad_norm", ("grad_clip",)),
    ForeignName(SB3, "n_envs", ("num_envs",)),
    ForeignName(SB3, "net_arch", ("hidden_sizes",), "a list of sizes; there are none for one of two networks alone"),
    ForeignName(SB3, "activation_fn", ("activation",), "by its name: nn.ReLU is relu, nn.Tanh is tanh"),
    ForeignName(SB3, "norm_obs", ("normalize_observations",), "of VecNormalize"),
    ForeignName(SB3, "policy_kwargs", (), "set hidden_sizes for its net_arch, activation for its activation_fn"),
    ForeignName(SB3, "total_timesteps", (), "set stop.num_env_steps"),
    ForeignName(SB3, "n_timesteps", (), "of RL Zoo: set stop.num_env_steps"),
    ForeignName(SB3, "policy", (), f"{_FROM_PLAN}: conv_filters or env.pixels for images, else dense layers"),
    ForeignName(SB3, "use_sde", (), "there is no state-dependent exploration here"),
    ForeignName(SB3, "sde_sample_freq", (), "there is no state-dependent exploration here"),
    ForeignName(RLLIB, "lr", ("lr",), _LR),
    ForeignName(RLLIB, "lr_schedule", ("lr", "lr_final", "lr_decay_steps"), _LR),
    ForeignName(RLLIB, "gamma", ("gamma",)),
    ForeignName(RLLIB, "grad_clip", ("grad_clip",)),
    ForeignName(RLLIB, "grad_clip_by", (), "grad_clip is always by the global norm"),
    ForeignName(RLLIB, "num_envs_per_env_runner", ("num_envs",)),
    ForeignName(RLLIB, "num_envs_per_worker", ("num_envs",)),
    ForeignName(RLLIB, "num_env_runners", (), "set resources.num_env_runners"),
    ForeignName(RLLIB, "num_workers", (), "set resources.num_env_runners"),
    ForeignName(RLLIB, "train_batch_size", ("train_batch_size",)),
    ForeignName(RLLIB, "train_batch_size_per_learner", ("train_batch_size",)),
    ForeignName(RLLIB, "fcnet_hiddens", ("hidden_sizes",)),
    ForeignName(RLLIB, "fcnet_activation", ("activation",)),
    ForeignName(RLLIB, "fcnet_kernel_initializer", ("initializer",), "by our names: torch, he_uniform and orthogonal"),
    ForeignName(RLLIB, "conv_filters", ("conv_filters",), "here without padding, there padded by default"),
    ForeignName(RLLIB, "observation_filter", ("normalize_observations",), "true for MeanStdFilter, false for NoFilter"),
)

_PPO: tuple[ForeignName, ...] = (
    ForeignName(
        SB3,
        "n_steps",
        ("train_batch_size",),
        "it counts each environment's steps: train_batch_size is n_steps x n_envs",
    ),
    ForeignName(SB3, "norm_reward", ("normalize_rewards",), "of VecNormalize; scaled anew once per iteration"),
    ForeignName(SB3, "normalize", ("normalize_observations", "normalize_rewards"), "of RL Zoo; true is both"),
    ForeignName(SB3, "clip_reward", (), "of VecNormalize: normalised rewards are always clipped at -/+ 10"),
    ForeignName(SB3, "batch_size", ("minibatch_size",)),
    ForeignName(SB3, "n_epochs", ("num_epochs",)),
    ForeignName(SB3, "gae_lambda", ("gae_lambda",)),
    ForeignName(SB3, "clip_range", ("clip_param",), _CLIP),
    ForeignName(
        SB3,
        "clip_range_vf",
        ("vf_clip_range",),
        "SB3 counts the limited value's error alone, we the larger one, as PPO2 and CleanRL do",
    ),
    ForeignName(
        SB3,
        "normalize_advantage",
        ("normalize_advantages",),
        "over the whole train batch (SB3: over each minibatch)",
    ),
    ForeignName(SB3, "ent_coef", ("entropy_coeff",)),
    ForeignName(SB3, "vf_coef", ("vf_loss_coeff",)),
    ForeignName(
        SB3, "target_kl", (), "it ends an iteration's epochs early; kl_target here is RLlib's, which weighs a penalty"
    ),
    ForeignName(
        SB3,
        "ortho_init",
        ("initializer",),
        "orthogonal for true, which SB3 has by default; gains of the layers are not quite the same",
    ),
    ForeignName(
        SB3,
        "log_std_init",
        ("free_log_std",),
        "true for SB3's deviation, the same for all observations; its logarithm is 0 at first, as by default there",
    ),
    ForeignName(SB3, "share_features_extractor", ("vf_share_layers",), "SB3 shares its extractor alone, not net_arch"),
    ForeignName(RLLIB, "minibatch_size", ("minibatch_size",)),
    ForeignName(RLLIB, "sgd_minibatch_size", ("minibatch_size",)),
    ForeignName(RLLIB, "num_epochs", ("num_epochs",)),
    ForeignName(RLLIB, "num_sgd_iter", ("num_epochs",)),
    ForeignName(RLLIB, "lambda_", ("gae_lambda",)),
    ForeignName(RLLIB, "lambda", ("gae_lambda",)),
    ForeignName(RLLIB, "clip_param", ("clip_param",)),
    ForeignName(RLLIB, "vf_clip_param", ("vf_clip_param",), "RLlib's default is 10, not null"),
    ForeignName(RLLIB, "vf_loss_coeff", ("vf_loss_coeff",)),
    ForeignName(RLLIB, "vf_share_layers", ("vf_share_layers",)),
    ForeignName(RLLIB, "free_log_std", ("free_log_std",)),
    ForeignName(RLLIB, "entropy_coeff", ("entropy_coeff",), _ENTROPY),
    ForeignName(
        RLLIB, "entropy_coeff_schedule", ("entropy_coeff", "entropy_coeff_final", "entropy_decay_steps"), _ENTROPY
    ),
    ForeignName(RLLIB, "use_kl_loss", ("use_kl_loss",), "RLlib's default is true, not false"),
    ForeignName(RLLIB, "kl_coeff", ("kl_coeff",)),
    ForeignName(RLLIB, "kl_target", ("kl_target",)),
    ForeignName(RLLIB, "use_critic", (), "there always is a value function"),
    ForeignName(RLLIB, "use_gae", (), "advantages are always generalised; gae_lambda 1 is without"),
    ForeignName(RLLIB, "rollout_fragment_length", (), f"{_FROM_PLAN}: train_batch_size / (num_envs x env runners)"),
)

_EPSILON = "epsilon: [[0, a], [n, b]] is epsilon_initial a, epsilon_decay n, epsilon_final b"
_DQN: tuple[ForeignName, ...] = (
    ForeignName(SB3, "normalize", ("normalize_observations",), "of RL Zoo; rewards are normalised with ppo alone"),
    ForeignName(SB3, "buffer_size", ("replay_capacity",)),
    ForeignName(
        SB3, "learning_starts", ("learning_starts",), "SB3's actions are all random until then, ours as epsilon says"
    ),
    ForeignName(SB3, "batch_size", ("train_batch_size",)),
    ForeignName(
        SB3, "tau", ("tau",),
        "SB3 moves the target at each target_update_interval, also between updates: set target_update_freq, and tau to "
        "1 - (1 - SB3's tau) ^ (target_update_freq / target_update_interval)",
    ),
    ForeignName(
        SB3, "train_freq", ("train_freq",),
        "SB3 counts steps of all environments at once, we count each: train_freq is SB3's x n_envs",
    ),
    ForeignName(
        SB3, "gradient_steps", ("updates_per_env_step",),
        "updates_per_env_step is gradient_steps / (SB3's train_freq x n_envs), and 1 for gradient_steps -1",
    ),
    ForeignName(SB3, "n_steps", ("n_step",)),
    ForeignName(
        SB3, "target_update_interval", ("target_update_freq",),
        "SB3 updates it between training phases alone: target_update_freq is at least SB3's train_freq x n_envs",
    ),
    ForeignName(
        SB3, "exploration_fraction", ("epsilon_decay",),
        "epsilon_decay is in env steps: exploration_fraction x SB3's total_timesteps (here stop.num_env_steps)",
    ),
    ForeignName(SB3, "exploration_initial_eps", ("epsilon_initial",)),
    ForeignName(SB3, "exploration_final_eps", ("epsilon_final",)),
    ForeignName(SB3, "optimizer_class", ("optimizer",), "adam or rmsprop; SB3's default is adam"),
    ForeignName(SB3, "replay_buffer_class", ("replay",), "uniform, prioritized or none"),
    ForeignName(SB3, "replay_buffer_kwargs", ("prioritized_alpha", "prioritized_beta"), "those of prioritized replay"),
    ForeignName(SB3, "optimize_memory_usage", (), "there is no such choice here"),
    ForeignName(
        RLLIB, "replay_buffer_config", ("replay_capacity", "replay", "prioritized_alpha", "prioritized_beta"),
        "its capacity, type, alpha and beta; RLlib's default is prioritized, ours uniform",
    ),
    ForeignName(RLLIB, "capacity", ("replay_capacity",)),
    ForeignName(RLLIB, "alpha", ("prioritized_alpha",)),
    ForeignName(RLLIB, "beta", ("prioritized_beta",)),
    ForeignName(
        RLLIB, "prioritized_replay_eps", ("prioritized_epsilon",),
        "of the old API stack; the new one adds nothing, and no |TD error| is less than 1e-12",
    ),
    ForeignName(RLLIB, "num_steps_sampled_before_learning_starts", ("learning_starts",)),
    ForeignName(
        RLLIB, "target_network_update_freq", ("target_update_freq",),
        "RLlib updates it once in a training phase at most: target_update_freq is RLlib's, rounded up to a multiple of "
        "train_freq; 0 there is after each update",
    ),
    ForeignName(
        RLLIB, "tau", ("tau",),
        "RLlib moves the target at each target_network_update_freq: set target_update_freq, without which a tau below "
        "1 acts after each update here",
    ),
    ForeignName(
        RLLIB, "training_intensity", ("updates_per_env_step",),
        "RLlib counts replayed transitions: updates_per_env_step is training_intensity / train_batch_size",
    ),
    ForeignName(
        RLLIB, "rollout_fragment_length", ("train_freq",),
        "RLlib counts each environment's steps: train_freq is rollout_fragment_length x num_envs x env runners",
    ),
    ForeignName(RLLIB, "double_q", ("double_q",)),
    ForeignName(RLLIB, "dueling", ("dueling",)),
    ForeignName(RLLIB, "n_step", ("n_step",), "a number; RLlib may also draw it from a range"),
    ForeignName(RLLIB, "td_error_loss_fn", ("td_loss",)),
    ForeignName(RLLIB, "adam_epsilon", ("optimizer_epsilon",), "RLlib's new API stack leaves it at 1e-08"),
    ForeignName(RLLIB, "epsilon", ("epsilon_initial", "epsilon_decay", "epsilon_final"), _EPSILON),
    ForeignName(RLLIB, "min_sample_timesteps_per_iteration", ("env_steps_per_iteration",)),
    ForeignName(RLLIB, "hiddens", ("hidden_sizes",), "ours are all hidden layers; the heads have none of their own"),
    ForeignName(RLLIB, "num_atoms", (), "there is no distributional DQN here"),
    ForeignName(RLLIB, "v_min", (), "there is no distributional DQN here"),
    ForeignName(RLLIB, "v_max", (), "there is no distributional DQN here"),
    ForeignName(RLLIB, "noisy", (), "there are no noisy networks here: exploration is by epsilon"),
)  # fmt: skip

FOREIGN_NAMES: dict[Algorithm, tuple[ForeignName, ...]] = {
    "ppo": _SHARED + _PPO,
    "dqn": _SHARED + _DQN,
    "random": (),
    "constant": (),
}
"""The names of other libraries by algorithm; those of our own name are among them where they mean the same."""


def names_for(algorithm: Algorithm, ours: str) -> Iterator[ForeignName]:
    """Yield what other libraries call one of our hyperparameters, the usual name of each library first."""
    known = [foreign for foreign in FOREIGN_NAMES[algorithm] if ours in foreign.ours]
    # A setting that is several of ours is named after those that are this one alone.
    return iter(sorted(known, key=lambda foreign: (list(LIBRARIES).index(foreign.library), len(foreign.ours))))


def answer_to(algorithm: Algorithm, name: str) -> str:
    """Return what to write in place of another library's name, beginning with a space; empty: no such name is known.

    Args:
        algorithm: The algorithm that has no hyperparameter of this name.
        name: The unknown name.
    """
    return "".join(_answer(foreign) for foreign in FOREIGN_NAMES[algorithm] if foreign.name == name)


def answer_for_others(algorithm: Algorithm, name: str) -> str:
    """Return what another library's name is in another algorithm, beginning with a space; empty: it is not known."""
    for other, names in FOREIGN_NAMES.items():
        for foreign in names:
            if other != algorithm and foreign.name == name and foreign.ours:
                return f" ({other} has it: {foreign.library}'s {name} is {' and '.join(foreign.ours)} there.)"
    return ""


def _answer(foreign: ForeignName) -> str:
    if not foreign.ours:
        return f" {foreign.library}'s {foreign.name} is no hyperparameter here: {foreign.difference}."
    meant = " and ".join(repr(name) for name in foreign.ours)
    why = f"; {foreign.difference}" if foreign.difference else ""
    return f" Did you mean {meant}? That is {foreign.library}'s {foreign.name}{why}."
