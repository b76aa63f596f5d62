"""Rules for when hyperparameters of PPO are idle; see `policies.idle.find`."""

from __future__ import annotations

from collections.abc import Callable

from policies.hyperparams import PPOHyperparams
from policies.idle.rule import ALWAYS, Limits, Rule, Rules, equal_ends


def _makes_one_update(h: PPOHyperparams, limits: Limits) -> bool:
    # RLlib's batches have more rows: one more at the end of each piece of an episode.
    is_whole = h.minibatch_size == h.train_batch_size and h.train_batch_size % h.num_envs == 0
    return limits.is_packed and h.num_epochs == 1 and is_whole


_ONE_UPDATE = Rule(
    "num_epochs is 1 and minibatch_size is train_batch_size, so the one update of an iteration is made by the policy "
    "that sampled",
    _makes_one_update,
    ("num_epochs", "minibatch_size", "train_batch_size", "num_envs"),
    divides=True,
)
_NO_KL_LOSS = Rule("use_kl_loss is false", lambda h, _: not h.use_kl_loss, ("use_kl_loss",))
_NO_KL_COEFF = Rule(
    "kl_coeff is 0, and stays 0 as it is changed by factors", lambda h, _: h.kl_coeff == 0.0, ("kl_coeff",)
)
_NO_VALUE_LOSS = Rule(
    "vf_loss_coeff is 0, and the value error has no weight", lambda h, _: h.vf_loss_coeff == 0.0, ("vf_loss_coeff",)
)
_ONE_ITERATION = Rule(
    "a trial makes no second iteration",
    lambda _, limits: limits.num_iterations <= 1,
    ("train_batch_size", "num_envs"),
)


def _start_of_schedule(decay: str, final: str) -> Rules:
    """Return the rules for the first value of a PPO schedule; the first batch is sampled before the first update."""
    why = f"{decay} is not more than train_batch_size, so {final} is reached before the first update"
    return (Rule(why, _is_over_at_first(decay, final), (decay, final, "train_batch_size")),)


def _is_over_at_first(decay: str, final: str) -> Callable[[PPOHyperparams, Limits], bool]:
    def holds(h: PPOHyperparams, _: Limits) -> bool:
        steps = getattr(h, decay)
        return getattr(h, final) is not None and steps is not None and steps <= h.train_batch_size

    return holds


def _decay_of_schedule(decay: str, start: str, final: str) -> Rules:
    why = f"it is not more than train_batch_size, so {final} is reached before the first update"
    return (
        equal_ends(start, final),
        Rule(why, _is_over_at_first(decay, final), (decay, final, "train_batch_size"), of_value=True),
    )


PPO_RULES: dict[str, Rules] = {
    "hidden_sizes": ALWAYS,
    "activation": ALWAYS,
    "initializer": ALWAYS,
    "conv_filters": ALWAYS,  # without images they are refused
    "normalize_observations": ALWAYS,
    "lr": _start_of_schedule("lr_decay_steps", "lr_final"),
    "lr_final": ALWAYS,
    "lr_decay_steps": _decay_of_schedule("lr_decay_steps", "lr", "lr_final"),
    "gamma": ALWAYS,
    "grad_clip": ALWAYS,
    "num_envs": ALWAYS,
    "gae_lambda": (Rule("gamma is 0, and no later reward counts", lambda h, _: h.gamma == 0.0, ("gamma",)),),
    "clip_param": (_ONE_UPDATE, *_start_of_schedule("clip_decay_steps", "clip_param_final")),
    "clip_param_final": (_ONE_UPDATE,),
    "clip_decay_steps": (_ONE_UPDATE, *_decay_of_schedule("clip_decay_steps", "clip_param", "clip_param_final")),
    "vf_clip_param": (_NO_VALUE_LOSS,),
    # Where one update is made, values have not moved, but for rounding, which a very small range would see.
    "vf_clip_range": (_NO_VALUE_LOSS,),
    "vf_loss_coeff": ALWAYS,
    "vf_share_layers": ALWAYS,
    "free_log_std": ALWAYS,  # without continuous actions it is refused
    "entropy_coeff": _start_of_schedule("entropy_decay_steps", "entropy_coeff_final"),
    "entropy_coeff_final": ALWAYS,
    "entropy_decay_steps": _decay_of_schedule("entropy_decay_steps", "entropy_coeff", "entropy_coeff_final"),
    "use_kl_loss": (_NO_KL_COEFF, _ONE_UPDATE),
    "kl_coeff": (_NO_KL_LOSS, _ONE_UPDATE),
    "kl_target": (_NO_KL_LOSS, _NO_KL_COEFF, _ONE_UPDATE, _ONE_ITERATION),
    "normalize_advantages": ALWAYS,
    "normalize_rewards": ALWAYS,
    "train_batch_size": ALWAYS,
    "minibatch_size": ALWAYS,
    "num_epochs": ALWAYS,
}  # fmt: skip
