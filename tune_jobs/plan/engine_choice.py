"""Which engine trains a trial: many of them packed into one process, RLlib, or a baseline's own.

Words: a *pack* is one process of the packed engine; its trials are its *members*. Members whose *key* is the same are
*stacked*: their weights lie in one array each, and one operation computes all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from policies.errors import EnvError, EnvFailedError, SpecError
from policies.hyperparams import (
    DQNHyperparams,
    Hyperparams,
    PPOHyperparams,
    RandomHyperparams,
)
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.rules import is_baseline, why_none_is_packed

if TYPE_CHECKING:
    from policies.envs.make import EnvInfo
    from policies.packed.envs.vector import EnvKind
    from tune_jobs.spec.sweep_spec import SweepSpec

Engine = Literal["packed", "rllib", "baseline"]

_SHARED = ("num_envs", "normalize_observations")
_SHARED_BY_PPO = ("vf_share_layers", "use_kl_loss", "train_batch_size", "minibatch_size", "num_epochs")
_SHARED_BY_DQN = (
    "train_batch_size", "env_steps_per_iteration", "train_freq", "updates_per_env_step", "double_q", "dueling",
    "n_step", "td_loss", "optimizer", "target_network", "replay", "learning_starts", "target_update_unit",
    "epsilon_unit",
)  # fmt: skip
_MOST_NAMED = 8
"""So many trials are named in a note; more are counted."""


@dataclass(frozen=True)
class PackPlan:
    """The packs of a sweep: processes of the packed engine, each of which trains many trials at once."""

    num_packs: int
    slots: int
    """Most trials of one pack at once."""
    cpus_per_pack: float
    """With those of its environments' processes."""
    gpus_per_pack: float
    trial_ids: tuple[str, ...]
    """The packed trials in the order in which they are handed out: those that are stacked follow each other."""
    env_kind: EnvKind
    """How the environments of a pack step."""
    env_step_us: float | None
    """Microseconds of one env step, as measured; None: the env raised an error before one could be."""
    num_env_processes: int
    """Processes that step environments for one pack; 0: its own does."""
    notes: tuple[str, ...] = ()
    """Why there are fewer packs or slots than there would be."""
    why_env_kind: str = ""
    """In a phrase."""

    @property
    def max_concurrent(self) -> int:
        """Trials at once, of all packs."""
        return min(len(self.trial_ids), self.num_packs * self.slots)


@dataclass(frozen=True)
class EngineChoice:
    """The engine of each trial."""

    engines: tuple[Engine, ...]
    """By the trial's index."""
    notes: tuple[str, ...] = ()
    """Which trials are not packed, and why."""


def pack_key(hyperparams: Hyperparams) -> tuple[Any, ...]:
    """What the members of a stack have in common; all else may differ between them."""
    if isinstance(hyperparams, RandomHyperparams):
        raise TypeError("Trials that do not learn are never packed.")
    names = (*_SHARED, *(_SHARED_BY_PPO if isinstance(hyperparams, PPOHyperparams) else _SHARED_BY_DQN))
    shared = (len(hyperparams.hidden_sizes), *(getattr(hyperparams, name) for name in names))
    if isinstance(hyperparams, DQNHyperparams):
        return ("dqn", *shared, hyperparams.target_update_interval is None, hyperparams.tau == 1.0)
    return ("ppo", *shared)


def why_not_packed(spec: SweepSpec, hyperparams: Hyperparams | None = None, env: EnvInfo | None = None) -> str | None:
    """Why a trial cannot be trained in a pack, or None if it can.

    Args:
        spec: The sweep.
        hyperparams: Of the trial; None: its point is not known, and may be any of the space.
        env: The sweep's environment; None: it is not looked at.
    """
    if (reason := why_none_is_packed(spec)) is not None:
        return reason
    if hyperparams is not None:
        filters = None if isinstance(hyperparams, RandomHyperparams) else hyperparams.conv_filters
    else:
        filters = next((found for found in _possible_filters(spec) if found is not None), None)
    if filters is not None:
        return f"conv_filters is {[list(one) for one in filters]}, and packs have no convolutions"
    if env is not None and env.observes_images:
        return f"{env.env_id} has images as observations, and packs have no convolutions"
    return None


def _possible_filters(spec: SweepSpec) -> list[Any]:
    domain: Domain | None = spec.space.get("conv_filters")
    if domain is None:
        return [spec.hyperparams.get("conv_filters")]
    return [value for _, value in domain.probes()]


def choose_engines(
    spec: SweepSpec,
    env: EnvInfo,
    trials: Sequence[tuple[str, Hyperparams | None]],
    recorded: Mapping[str, str],
    place: Callable[[int], str],
) -> EngineChoice:
    """Choose the engine of each trial.

    Args:
        spec: The sweep; its `engine` is a wish.
        env: Its environment.
        trials: Id and hyperparameters of each; None: they are chosen when it starts.
        recorded: Engines of trials that are there already: they go on with them.
        place: What messages call the trial of an index.

    Raises:
        SpecError: The wish is that all are packed, and one cannot be.
    """
    engines: list[Engine] = []
    if is_baseline(spec):
        engines = ["baseline"] * len(trials)
        return EngineChoice(tuple(engines))
    why_not_seeded: str | None = None
    is_checked = False
    refused: dict[str, list[str]] = {}
    for index, (trial_id, hyperparams) in enumerate(trials):
        if trial_id in recorded or spec.engine == "rllib":
            engines.append("packed" if recorded.get(trial_id) == "packed" else "rllib")
            continue
        reason = why_not_packed(spec, hyperparams, env)
        if reason is None:
            if not is_checked:
                why_not_seeded, is_checked = _why_not_seeded(spec), True
            reason = why_not_seeded
        if reason is not None:
            if spec.engine == "packed":
                raise SpecError(
                    f"engine is packed, but {place(index)} cannot be: {reason}.",
                    "Set engine to rllib, which can train it, or to auto, which packs what can be packed.",
                )
            refused.setdefault(reason, []).append(trial_id)
        engines.append("packed" if reason is None else "rllib")
    return EngineChoice(tuple(engines), tuple(_note(reason, ids, len(trials)) for reason, ids in refused.items()))


def _why_not_seeded(spec: SweepSpec) -> str | None:
    """Why the environment's episodes do not depend on their seeds alone, or None if they do."""
    from policies.guard.guarded import check_seedable

    try:
        check_seedable(spec.env.id, spec.env.wrapped_args, timeout_s=spec.iteration_timeout_s)
    except EnvFailedError:
        raise
    except EnvError as error:
        return error.message.rstrip(".")
    return None


def _note(reason: str, trial_ids: Sequence[str], num_trials: int) -> str:
    if len(trial_ids) == num_trials:
        return f"No trial is packed, RLlib trains them all: {reason}."
    told = ", ".join(trial_ids) if len(trial_ids) <= _MOST_NAMED else f"{len(trial_ids):,} trials"
    is_ = "is" if len(trial_ids) == 1 else "are"
    return f"{told} {is_} not packed, RLlib trains {'it' if is_ == 'is' else 'them'}: {reason}."
