"""Choose the engine of the table in `tune_jobs.spec.engines` that trains a trial.

Words: a *pack* is one process of the packed engine; its trials are its *members*. Members whose *key* is the same are
*stacked*: their weights lie in one array each, and one operation computes all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from policies.errors import EnvError, EnvFailedError, SpecError
from policies.hyperparams import (
    DQNHyperparams,
    Hyperparams,
    RandomHyperparams,
)
from policies.packed.shared import shared_of
from tune_jobs.plan.estimates import products_per_image
from tune_jobs.search.points import largest_hyperparams
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.engines import Engine, engine_on_record, engines_for
from tune_jobs.spec.rules import is_baseline, why_none

if TYPE_CHECKING:
    from policies.envs.make import EnvInfo
    from policies.packed.envs.vector import EnvKind
    from tune_jobs.spec.sweep_spec import SweepSpec

MAX_PRODUCTS = 300_000
"""The most multiplications of a network for an image that packs are chosen for where trials have no GPU.

Measured by CPU time beside the `rllib` engine (decision 49): 1.7 to 2.8 times as fast up to 200,000, 1.0 to 1.9 times
at 480,000, and slower from 1.7 million on, where the products are what takes time, and those of RLlib are as fast.
"""
_MOST_NAMED = 8
"""The most trials that a note lists by name; more are counted."""


@dataclass(frozen=True)
class PackPlan:
    """The packs of a sweep: processes of the packed engine, each of which trains many trials at once."""

    num_packs: int
    slots: int
    """The most trials that one pack trains at once."""
    cpus_per_pack: float
    """CPUs of a pack, including those of its environments' processes."""
    gpus_per_pack: float
    trial_ids: tuple[str, ...]
    """The packed trials in the order in which they begin; trials that can be stacked follow each other."""
    env_kind: EnvKind
    """How the environments of a pack are stepped."""
    env_step_us: float | None
    """Microseconds per env step, as measured; None: the env raised an error before a step could be measured."""
    num_env_processes: int
    """Processes that step environments for one pack; 0: the pack's own process steps them."""
    notes: tuple[str, ...] = ()
    """Notes on why there are fewer packs or slots than CPUs would allow."""
    reward: float | None = None
    """How large rewards are in random play; see `policies.packed.envs.make.StepTime`."""
    largest: float | None = None
    """How large what is observed is there."""
    why_env_kind: str = ""
    """The reason for `env_kind`, as a phrase."""

    @property
    def max_concurrent(self) -> int:
        """How many trials all packs train at once."""
        return min(len(self.trial_ids), self.num_packs * self.slots)


@dataclass(frozen=True)
class EngineChoice:
    """The engine of each trial."""

    engines: tuple[str, ...]
    """The engines' names, by the trial's index."""
    notes: tuple[str, ...] = ()
    """Notes on which trials the first engine of the table cannot train, and why."""


def pack_key(hyperparams: Hyperparams) -> tuple[Any, ...]:
    """Return what the members of a stack have in common; everything else may differ between them."""
    if isinstance(hyperparams, RandomHyperparams):
        raise TypeError("Trials that do not learn are never packed.")
    # Not needed by a stack's program, but members with the same activation and sizes can be in one group.
    key = (shared_of(hyperparams), len(hyperparams.hidden_sizes))
    if isinstance(hyperparams, DQNHyperparams):
        return (*key, hyperparams.target_update_interval is None, hyperparams.tau == 1.0)
    return key


def may_pack(spec: SweepSpec) -> bool:
    """Whether trials of a sweep may be packed, as far as its file tells."""
    able = (engine for engine in engines_for(spec.algorithm) if spec.engine in ("auto", engine.name))
    return any(engine.trains_many and why_none(engine, spec) is None for engine in able)


def forked_of(spec: SweepSpec, *, packs: bool) -> Literal["packs", "trials"] | None:
    """Return what a Ray of this machine forks for a sweep (see `tune_jobs.ray_tune.forks`); None: nothing.

    Args:
        spec: The sweep.
        packs: Whether there are packs.
    """
    if packs:
        return "packs"
    # A baseline needs nothing of RLlib's. Where a trial has several CPUs for its own process, Ray has the libraries of
    # that use as many threads, of which they take note when they are loaded.
    is_alone = spec.cpus_per_trial - spec.resources.num_env_runners == 1
    return "trials" if is_alone and not is_baseline(spec) else None


def why_not(
    engine: Engine, spec: SweepSpec, hyperparams: Hyperparams | None = None, env: EnvInfo | None = None
) -> str | None:
    """Return why an engine cannot train a trial, or None if it can; whether its env can be seeded is not checked.

    Args:
        engine: The engine.
        spec: The sweep.
        hyperparams: The trial's; None: its point is not known yet, and may be any of the space.
        env: The sweep's environment; None: it is not checked.
    """
    if (reason := why_none(engine, spec)) is not None:
        return reason
    reasons = (engine.why_not("convolutions", setting) for setting in _convolutions(spec, hyperparams, env))
    return next((reason for reason in reasons if reason is not None), None)


def _convolutions(spec: SweepSpec, hyperparams: Hyperparams | None, env: EnvInfo | None) -> Iterator[str]:
    """Yield the settings of a trial that need convolutions."""
    if hyperparams is not None:
        filters = None if isinstance(hyperparams, RandomHyperparams) else hyperparams.conv_filters
    else:
        filters = next((found for found in possible_filters(spec) if found is not None), None)
    if filters is not None:
        yield f"conv_filters is {[list(one) for one in filters]}"
    if env is not None and env.observes_images:
        yield f"{env.env_id} has images as observations"


def possible_filters(spec: SweepSpec) -> list[Any]:
    """Return the conv_filters that trials of a sweep may have; None among them: a trial without convolutions."""
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
    """Choose the engine of each trial: the first of the table that can train it, or the one that the sweep sets.

    Args:
        spec: The sweep; `engine` may be `auto`.
        env: Its environment.
        trials: Id and hyperparameters of each trial; None: they are chosen when it starts.
        recorded: Engines of trials that exist already, which keep them.
        place: Returns what messages call the trial of an index.

    Raises:
        SpecError: The sweep sets an engine that cannot train one of the trials.
        CheckpointError: A trial's record names an unknown engine.
    """
    able = engines_for(spec.algorithm)
    wished = _of_population(spec, recorded) or tuple(engine for engine in able if engine.name == spec.engine)
    seeding, images = _Seeding(spec), _Images(spec, env, [values for _, values in trials if values is not None])
    engines: list[str] = []
    refused: dict[tuple[str, str, str], list[str]] = {}
    for index, (trial_id, hyperparams) in enumerate(trials):
        if trial_id in recorded:
            engines.append(engine_on_record(recorded[trial_id], spec.algorithm).name)
            continue
        reasons: list[tuple[Engine, str]] = []
        for engine in wished or able:
            reason = why_not(engine, spec, hyperparams, env)
            reason = reason or images.why_not(engine, hyperparams) or seeding.why_not(engine)
            if reason is None:
                engines.append(engine.name)
                for other, why in reasons:
                    refused.setdefault((other.trained, engine.title, why), []).append(trial_id)
                break
            reasons.append((engine, reason))
        else:
            first, reason = reasons[0]
            raise SpecError(
                f"engine is {spec.engine}, but {place(index)} cannot be: {reason}.",
                f"Set engine to {able[-1].name}, which can train it, or to auto, which takes {first.name} where it is "
                "possible.",
            )
    notes = (_note(trained, title, why, ids, len(trials)) for (trained, title, why), ids in refused.items())
    return EngineChoice(tuple(engines), tuple(notes))


def _of_population(spec: SweepSpec, recorded: Mapping[str, str]) -> tuple[Engine, ...]:
    """Return the engine of the trials that exist, if those that are added have to be compared with them.

    A sweep's packs are run before its single trials, so that trials of two engines would be two populations.
    """
    if not spec.scheduler.waits_for_others:
        return ()
    known = {engine_on_record(name, spec.algorithm).name: None for name in recorded.values()}
    return tuple(engine_on_record(name, spec.algorithm) for name in known)


class _Images:
    """Finds out whether images are too large for an engine that nobody asked for.

    Args:
        spec: The sweep.
        env: Its environment.
        known: The hyperparameters of the points that are known.
    """

    def __init__(self, spec: SweepSpec, env: EnvInfo, known: Sequence[Hyperparams]) -> None:
        self._spec, self._env, self._known = spec, env, known
        self._largest: list[Hyperparams] = []

    def why_not(self, engine: Engine, hyperparams: Hyperparams | None) -> str | None:
        """Return why an engine is not chosen for a trial, or None if it is; None for a point that is not known."""
        image = self._env.image
        if self._spec.engine == engine.name or "large_images" not in engine.lacks or image is None:
            return None
        if self._spec.resources.num_gpus:  # decision 54
            return None
        if hyperparams is None and not self._largest and self._known:
            self._largest = largest_hyperparams(self._spec, self._known)
        most = max(
            (products_per_image(image, each) for each in ([hyperparams] if hyperparams else self._largest)), default=0
        )
        if most <= MAX_PRODUCTS:
            return None
        size = " x ".join(map(str, image.shape))
        return engine.why_not("large_images", f"a network makes {most:,} multiplications for an image of {size}")


class _Seeding:
    """Finds out, once and only if it is needed, whether the environment's episodes depend only on their seeds."""

    def __init__(self, spec: SweepSpec) -> None:
        self._spec = spec
        self._is_checked = False
        self._fault: str | None = None

    def why_not(self, engine: Engine) -> str | None:
        """Return why an engine cannot train in this environment, or None if it can."""
        if "unseeded" not in engine.lacks:
            return None
        if not self._is_checked:
            self._fault, self._is_checked = _seed_fault(self._spec), True
        return None if self._fault is None else engine.why_not("unseeded", self._fault)


def _seed_fault(spec: SweepSpec) -> str | None:
    """Return why the environment's episodes depend on more than their seeds, or None if they don't."""
    from policies.guard.guarded import check_seedable

    try:
        check_seedable(spec.env.id, spec.env.wrapped_args, timeout_s=spec.iteration_timeout_s)
    except EnvFailedError:
        raise
    except EnvError as error:
        return error.message.rstrip(".")
    return None


def _note(trained: str, title: str, reason: str, trial_ids: Sequence[str], num_trials: int) -> str:
    if len(trial_ids) == num_trials:
        return f"No trial is {trained}, {title} trains them all: {reason}."
    told = ", ".join(trial_ids) if len(trial_ids) <= _MOST_NAMED else f"{len(trial_ids):,} trials"
    is_ = "is" if len(trial_ids) == 1 else "are"
    return f"{told} {is_} not {trained}, {title} trains {'it' if is_ == 'is' else 'them'}: {reason}."
