"""The sweep file as a typed, frozen model: everything about a sweep that a person decides.

A `SweepSpec` is valid by itself: its hyperparameters exist for its algorithm and accept every value their
domains can give. Whether the environment exists and the machine is large enough is found by `plan.make_plan`.
Files, presets and `--set` are read by `spec_file.load_spec`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    create_model,
    model_validator,
)

from analysis.wording import counted
from policies.errors import SpecError
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from tune_jobs.plan.engine_choice import why_none_is_packed
from tune_jobs.spec.domains import Domain, Number, WholeNumber
from tune_jobs.spec.problems import Problem, WrongSpecError, details_of, did_you_mean, dotted, explain
from tune_jobs.spec.rules import search_problems
from tune_jobs.spec.seeds import MAX_EPISODES, SEEDS_PER_TRIAL

SchedulerType = Literal["none", "asha", "hyperband", "median", "pbt"]

_NAME_PATTERN = r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}"
_LARGEST_REWARD = 3.4e38
"""Beyond it a number is infinite in 32 bits, in which learners compute."""
NAME_RULE = "up to 100 letters, digits, '_', '-' and '.', beginning with none of the last two"

Flag = Annotated[bool, Field(strict=True)]
"""true or false; no text and no number stands for them."""
PositiveWhole = Annotated[WholeNumber, Field(ge=1)]
NonNegativeWhole = Annotated[WholeNumber, Field(ge=0)]
PositiveNumber = Annotated[Number, Field(gt=0)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class EnvSpec(_Section):
    """The environment all trials train in."""

    id: str = Field(description="Gymnasium id, such as CartPole-v1.", min_length=1)
    args: dict[str, Any] = Field(default_factory=dict, description="Keyword arguments of gymnasium.make.")
    frame_stack: Annotated[WholeNumber, Field(ge=1, le=64)] = Field(
        1, description="Observe the last so many observations at once."
    )
    pixels: Flag = Field(
        default=False, description="Observe small grey images of what the env renders, not its numbers."
    )
    failure_penalty: Annotated[Number, Field(ge=-_LARGEST_REWARD, le=_LARGEST_REWARD)] | None = Field(
        None,
        description="Reward of the step in which the env ends by failure, such as the pole's fall. Training sees it, "
        "evaluation and reported returns never do. null: the env's own reward.",
    )

    @property
    def wrapped_args(self) -> dict[str, Any]:
        """`args` and the wrappers of observations: what everybody who makes this environment needs."""
        # Not above: the command line reads and prints sweep files without Gymnasium.
        from policies.envs.wrappers import with_wrappers

        return with_wrappers(self.args, frame_stack=self.frame_stack, pixels=self.pixels)


class StopSpec(_Section):
    """When a trial ends: at whichever comes first. The three caps always hold, so nothing runs for ever."""

    training_return: Number | None = Field(
        None, description="End when the mean return of the last 100 whole training episodes reaches this."
    )
    evaluation_return: Number | None = Field(
        None, description="End when the mean return of the greedy evaluation episodes reaches this."
    )
    num_episodes: PositiveWhole | None = Field(
        None, description="End with the iteration in which this many whole training episodes are done."
    )
    num_env_steps: PositiveWhole = Field(200_000, description="End after this many env steps.")
    num_iterations: PositiveWhole = Field(100_000, description="End after this many iterations.")
    time_s: PositiveNumber = Field(3600.0, description="End after this many seconds of training.")


class SearchSpec(_Section):
    """How the points of the space are chosen."""

    type: Literal["random", "tpe"] = Field(
        "random",
        description="random: independent draws, and every combination of grids; tpe: a model of the finished trials "
        "proposes the next points (Bergstra et al. 2011; install tune-jobs[tpe]).",
    )
    num_startup_trials: PositiveWhole = Field(
        10, description="tpe: points are random until so many have been tried to their end; the model's follow."
    )


class SchedulerSpec(_Section):
    """Whether trials that do worse than others, after as many env steps, are ended early, or take over from them."""

    type: SchedulerType = Field(
        "none",
        description="none, asha (successive halving), hyperband, median (worse than the median) or pbt (population "
        "based training: the worst go on from copies of the best, with mutated hyperparameters).",
    )
    grace_env_steps: PositiveWhole | None = Field(
        None, description="No trial is ended before this many env steps; null: 1/20 of stop.num_env_steps."
    )
    reduction_factor: Annotated[Number, Field(gt=1)] = Field(
        3.0, description="asha, hyperband: one trial in this many goes on at each rung."
    )
    perturb_every_env_steps: PositiveWhole | None = Field(
        None, description="pbt: env steps between two comparisons of a trial; null: 1/10 of stop.num_env_steps."
    )
    quantile_fraction: Annotated[Number, Field(gt=0, le=0.5)] = Field(
        0.25, description="pbt: the worst share of the trials, which copies the best share."
    )
    resample_probability: Annotated[Number, Field(ge=0, le=1)] = Field(
        0.25, description="pbt: how often a mutation draws a new value; else it moves to a neighbouring one."
    )


class EvaluationSpec(_Section):
    """Greedy episodes during training, on seeds that are the same for all trials."""

    every_iterations: PositiveWhole = Field(5, description="Evaluate at each multiple of this, and at the end.")
    num_episodes: Annotated[WholeNumber, Field(ge=1, le=MAX_EPISODES)] = Field(
        10, description="Episodes of an evaluation."
    )


class CheckpointSpec(_Section):
    """Which checkpoints are kept. The best and the latest always are."""

    every_iterations: PositiveWhole = Field(10, description="Save at each multiple of this, and at the end.")
    keep: NonNegativeWhole = Field(2, description="How many of the newest to keep beside best and latest.")


class ResourcesSpec(_Section):
    """What one trial may use, and how many run at once."""

    num_cpus: PositiveWhole | None = Field(None, description="CPUs a trial; null: 1 and 1 for each env runner.")
    num_gpus: Annotated[Number, Field(ge=0)] = Field(0.0, description="GPUs a trial, fractions allowed.")
    num_env_runners: Annotated[WholeNumber, Field(ge=0, le=SEEDS_PER_TRIAL)] = Field(
        0, description="Processes that sample for one trial; 0: the trial's own process does."
    )
    max_concurrent: PositiveWhole | None = Field(None, description="Trials at once; null: as many as fit.")


def _from_text(key: str) -> BeforeValidator:
    """Let a section be written as one text: `env: CartPole-v1`, `scheduler: asha`."""

    def expand(value: Any) -> Any:
        return {key: value} if isinstance(value, str) else value

    return BeforeValidator(expand)


class SweepSpec(_Section):
    """One sweep: what is searched, how long, with which resources."""

    name: str | None = Field(
        None,
        pattern=f"^{_NAME_PATTERN}$",
        description="Name of the sweep and of its folder; null: the file's or preset's, with a number if it is taken.",
    )
    env: Annotated[EnvSpec, _from_text("id")] = Field(description="Gymnasium id, or a mapping of id and args.")
    algorithm: Algorithm = Field(description="ppo or dqn; or a baseline that does not learn: random or constant.")
    rl_module: str | None = Field(
        None,
        pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$",
        description="An RLModule class of your own as module:Class, in a module that was allowed.",
    )
    hyperparams: dict[str, Any] = Field(default_factory=dict, description="Fixed hyperparameters.")
    space: dict[str, Domain] = Field(default_factory=dict, description="Searched hyperparameters.")
    num_samples: PositiveWhole = Field(
        1, description="Random draws for each combination of the grids' values; with tpe: points."
    )
    seeds_per_point: PositiveWhole = Field(1, description="Trials a point, each with its own seed.")
    seed: Annotated[WholeNumber, Field(ge=0)] = Field(0, description="Sweep seed: fixes points and all other seeds.")
    stop: StopSpec = Field(default_factory=StopSpec, description="When a trial ends.")
    search: Annotated[SearchSpec, _from_text("type")] = Field(
        default_factory=SearchSpec, description="Search method: random or tpe, or a mapping."
    )
    scheduler: Annotated[SchedulerSpec, _from_text("type")] = Field(
        default_factory=SchedulerSpec, description="Early stopping: its type, or a mapping."
    )
    evaluation: EvaluationSpec = Field(default_factory=EvaluationSpec, description="Greedy evaluation.")
    checkpoints: CheckpointSpec = Field(default_factory=CheckpointSpec, description="What is kept of a trial.")
    resources: ResourcesSpec = Field(default_factory=ResourcesSpec, description="CPUs, GPUs, env runners.")
    engine: Literal["auto", "packed", "rllib"] = Field(
        "auto",
        description="packed: many trials at once in each process; rllib: each trial in a process of its own, by RLlib; "
        "auto: packed where it is possible.",
    )
    max_retries: NonNegativeWhole = Field(2, description="How often a failed trial is tried again.")
    iteration_timeout_s: PositiveNumber = Field(
        600.0, description="An iteration that takes longer counts as a failure of its trial."
    )

    @model_validator(mode="before")
    @classmethod
    def _empty_sections_are_defaults(cls, data: Any) -> Any:
        # In YAML a section whose lines are all commented out is null.
        if not isinstance(data, Mapping):
            return data
        return {key: value for key, value in data.items() if value is not None or key not in cls.model_fields}

    @model_validator(mode="wrap")
    @classmethod
    def _is_right(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Look at the whole too, and tell what is wrong in the sweep file's words; SpecErrors pass through pydantic."""
        try:
            spec = handler(data)
        except ValidationError as error:
            from tune_jobs.spec.messages import problems_of  # knows this class

            raise WrongSpecError.of("SweepSpec", problems_of(error, data)) from error
        problems = hyperparam_problems(spec.algorithm, spec.hyperparams, spec.space) + _section_problems(spec)
        if problems:
            raise WrongSpecError.of("SweepSpec", problems)
        return spec

    @property
    def grace_env_steps(self) -> int:
        """Env steps before which the scheduler ends no trial."""
        if self.scheduler.grace_env_steps is not None:
            return self.scheduler.grace_env_steps
        return max(1, self.stop.num_env_steps // 20)

    @property
    def perturb_every_env_steps(self) -> int:
        """pbt: env steps between two comparisons of a trial."""
        return self.scheduler.perturb_every_env_steps or max(1, self.stop.num_env_steps // 10)

    @property
    def cpus_per_trial(self) -> int:
        """CPUs one trial takes: its own process and its env runners."""
        if self.resources.num_cpus is not None:
            return self.resources.num_cpus
        return 1 + self.resources.num_env_runners


def check_sweep_name(name: str) -> str:
    """Return a sweep's name if a folder may be called so.

    Raises:
        SpecError: It may not.
    """
    if re.fullmatch(_NAME_PATTERN, name) is None:
        raise SpecError(f"The sweep name {name!r} is not allowed.", f"Use {NAME_RULE}.")
    return name


def _section_problems(spec: SweepSpec) -> list[Problem]:
    """Settings that contradict each other."""
    problems = [Problem(path, text) for path, text in search_problems(spec)]
    grace, cap, resources = spec.scheduler.grace_env_steps, spec.stop.num_env_steps, spec.resources
    if spec.scheduler.type != "none" and grace is not None and grace >= cap:
        text = f"{grace} is not less than stop.num_env_steps, {cap}: no trial would ever be ended early"
        problems.append(Problem("scheduler.grace_env_steps", text))
    needed = 1 + resources.num_env_runners
    if resources.num_cpus is not None and resources.num_cpus < needed:
        text = (
            f"{resources.num_cpus} is fewer than the {needed} that a trial with "
            f"{counted(resources.num_env_runners, 'env runner')} needs; leave it out to get just those"
        )
        problems.append(Problem("resources.num_cpus", text))
    if resources.num_gpus > 1 and not resources.num_gpus.is_integer():
        text = f"{resources.num_gpus:g} is not allowed: use a fraction of one GPU, or a whole number of GPUs"
        problems.append(Problem("resources.num_gpus", text))
    if spec.engine == "packed" and (reason := why_none_is_packed(spec)) is not None:
        text = f"packed cannot train any of the trials: {reason}. Set auto, which takes what can"
        problems.append(Problem("engine", text))
    return problems


def hyperparam_problems(
    algorithm: Algorithm, hyperparams: Mapping[str, Any], space: Mapping[str, Domain]
) -> list[Problem]:
    """What is wrong with fixed and searched hyperparameters, each looked at by itself.

    Args:
        algorithm: Whose hyperparameters they are.
        hyperparams: Fixed values by name.
        space: Domains by name.

    Returns:
        Unknown names, values that are refused, and names that are both fixed and searched.
    """
    fields = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    problems = []
    for section, names in (("hyperparams", hyperparams), ("space", space)):
        problems += [
            Problem(f"{section}.{name}", _unknown_hyperparam(algorithm, name)) for name in names if name not in fields
        ]
    for name, value in hyperparams.items():
        if name in fields:
            problems += _value_problems(algorithm, name, value, path=f"hyperparams.{name}")
        if name in space:
            text = f"is fixed at {value!r} and searched in space.{name} at once: take it out of one of them"
            problems.append(Problem(f"hyperparams.{name}", text))
    for name, domain in space.items():
        if name in fields:
            problems += _domain_problems(algorithm, name, domain)
    return problems


def _unknown_hyperparam(algorithm: Algorithm, name: str) -> str:
    known = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields
    others = [other for other, model in HYPERPARAMS_BY_ALGORITHM.items() if name in model.model_fields]
    have = "have" if len(others) > 1 else "has"
    suggestion = f" ({' and '.join(others)} {have} it.)" if others else did_you_mean(name, known)
    if name == "learning_rate":
        suggestion = " Did you mean 'lr'?"  # its letters are nearer to DQN's learning_starts
    listed = "" if suggestion else f" It has {', '.join(sorted(known))}."
    return f"{algorithm} has no hyperparameter {name!r}.{suggestion}{listed}"


def _domain_problems(algorithm: Algorithm, name: str, domain: Domain) -> list[Problem]:
    problems = []
    for index, value in domain.probes():
        path = f"space.{name}.{domain.kind}"
        found = _value_problems(algorithm, name, value, path=path if index is None else f"{path}[{index}]")
        if found and index is None:
            text = f"can give {value!r}, but {name} must be a whole number: use randint, qrandint or a log form"
            found = [Problem(path, text)]
        problems += found
        if found and domain.kind not in ("grid", "choice"):
            break  # both ends of a range are mostly wrong for the same reason
    return problems


@functools.cache
def _alone(algorithm: Algorithm, name: str) -> type[BaseModel]:
    """A hyperparameter without the checks across several: the plan makes these for each point."""
    field = HYPERPARAMS_BY_ALGORITHM[algorithm].model_fields[name]
    model: type[BaseModel] = create_model("Alone", **{name: (field.annotation, field)})  # type: ignore[call-overload]
    return model


def _value_problems(algorithm: Algorithm, name: str, value: Any, *, path: str) -> list[Problem]:
    try:
        checked = getattr(_alone(algorithm, name).model_validate({name: value}), name)
    except ValidationError as error:
        return [Problem(path + dotted(detail["loc"][1:], root=False), explain(detail)) for detail in details_of(error)]
    if not _same_kind(value, checked):
        meant = list(checked) if isinstance(checked, tuple) else checked
        return [Problem(path, f"{value!r} is of the wrong type: write {meant!r} if that is meant")]
    return []


def _same_kind(raw: Any, checked: Any) -> bool:
    """Whether pydantic left the kind of a value alone: it would read true as 1, 1 as true and "5" as 5."""
    if isinstance(checked, tuple):
        # One number may stand for a list of one.
        return all(map(_same_kind, raw if isinstance(raw, list | tuple) else [raw], checked))
    return isinstance(raw, str) == isinstance(checked, str) and isinstance(raw, bool) == isinstance(checked, bool)
