"""The sections of a sweep file, and all fields of a sweep, with their types and ranges.

Rules for several fields together are in `tune_jobs.spec.rules`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_serializer,
    model_serializer,
)

from analysis.records import Cost, Objective
from policies.errors import shortened
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM, Algorithm
from tune_jobs.spec.atari import AtariSpec, atari_from_a_flag
from tune_jobs.spec.domain_kinds import Number, WholeNumber
from tune_jobs.spec.domains import Domain
from tune_jobs.spec.engines import ENGINES
from tune_jobs.spec.fields import Flag, NameText, NonNegativeWhole, PositiveNumber, PositiveWhole, Section
from tune_jobs.spec.masks import ListedActions, mask_as_given
from tune_jobs.spec.scheduler import SchedulerSpec
from tune_jobs.spec.seeds import MAX_EPISODES, SEEDS_PER_TRIAL

SearchType = Literal["random", "auto", "gp", "forest", "tpe"]
AUTO_SEARCH: SearchType = "gp"
"""What `search: auto` is: the method that found the best points in decision 40, and needs nothing to be installed."""

_RETURN = {"return": "final"}
"""What `objective` may be called besides: the return that training comes to."""
NAME_PATTERN = r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}"
_LARGEST_REWARD = 3.4e38
"""The largest number of 32 bits; training computes in 32 bits, where anything larger is infinite."""
NAME_RULE = "up to 100 letters, digits, '_', '-' and '.', beginning with none of the last two"


class AboutSpec(Section):
    """What a sweep is for, in words for its readers; nothing that is trained depends on it."""

    title: str = Field("", description="What it is, in one line.")
    source: str = Field("", description="Where its settings come from.")
    shows: str = Field("", description="What is to be seen.")
    expected: str = Field("", description="The score that it should reach.")
    env_steps: str = Field("", description="How many env steps it takes.")
    time: str = Field("", description="How long it takes, and on what.")
    description: str = Field("", description="More, in as many lines as it needs.")


class EnvSpec(Section):
    """The environment all trials train in."""

    id: str = Field(description="Gymnasium id, such as CartPole-v1.", min_length=1)
    args: dict[str, Any] = Field(default_factory=dict, description="Keyword arguments of gymnasium.make.")
    frame_stack: Annotated[WholeNumber, Field(ge=1, le=64)] = Field(
        1, description="How many of the last observations are observed at once."
    )
    pixels: Flag = Field(
        default=False, description="Observe small grey images of what the env renders, not its numbers."
    )
    action_mask: Annotated[NameText | bool | ListedActions | None, BeforeValidator(mask_as_given)] = Field(
        None,
        description="The name of what says which actions are allowed: a member of Dict observations, a method, or an "
        "info of reset and step; {actions: NAME} if it lists them in place of zeros and ones. true: a member "
        "action_mask, the method that MaskablePPO asks for, or an info action_mask. null: the first two, if there is "
        "one. false: what there is, is no mask.",
    )
    atari: Annotated[AtariSpec | None, BeforeValidator(atari_from_a_flag)] = Field(
        None,
        description="true, or a mapping: the standard preprocessing of an Atari game. Evaluations and reported returns "
        "are of whole games, with the game's own rewards. null: none.",
    )
    own_process: Flag = Field(
        default=False,
        description="Whether each of its environments is in a process of its own, because a process can hold one only.",
    )
    failure_penalty: Annotated[Number, Field(ge=-_LARGEST_REWARD, le=_LARGEST_REWARD)] | None = Field(
        None,
        description="Reward of the step in which the env ends by failure, such as the pole's fall. Training sees it, "
        "evaluation and reported returns never do. null: the env's own reward.",
    )

    @property
    def wrapped_args(self) -> dict[str, Any]:
        """`args` with the wrappers of observations and the mask, as needed wherever this environment is made."""
        # Imported here because the command line reads and prints sweep files without Gymnasium.
        from policies.envs.wrappers import with_wrappers

        return with_wrappers(
            self.args,
            frame_stack=self.frame_stack,
            pixels=self.pixels,
            action_mask=dict(self.action_mask) if isinstance(self.action_mask, ListedActions) else self.action_mask,
            atari=None if self.atari is None else self.atari.frames,
            own_process=self.own_process,
        )

    @model_serializer(mode="wrap")
    def _only_if_set(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Versions that don't know the fields read sweeps that don't use them.
        content: dict[str, Any] = handler(self)
        if self.atari is None:
            content.pop("atari", None)
        if not self.own_process:
            content.pop("own_process", None)
        return content


class StopSpec(Section):
    """When a trial ends: at whichever limit it reaches first. Three caps always apply, so nothing runs forever."""

    NEVER_EMPTY: ClassVar[frozenset[str]] = frozenset({"num_env_steps", "num_iterations", "time_s"})

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


class SearchSpec(Section):
    """How the points of the space are chosen."""

    type: Annotated[SearchType, AfterValidator(lambda given: AUTO_SEARCH if given == "auto" else given)] = Field(
        "random",
        description="random: independent draws, and every combination of grids. The others have a model of the "
        "finished trials, which proposes the next points: gp (a Gaussian process), forest (a random forest, as SMAC's; "
        "install tune-jobs[forest]), tpe (Bergstra et al. 2011; install tune-jobs[tpe]); auto: the best of them, "
        f"{AUTO_SEARCH}.",
    )
    num_startup_trials: PositiveWhole = Field(
        10,
        description="gp, forest, tpe: how many points have to end before the model proposes points; until then they "
        "are random, and as long as all that ended are equally good. With a scheduler, one that it ended or that "
        "failed counts for the share of its training that it has had, until a third of all that don't run have ended.",
    )

    @property
    def has_model(self) -> bool:
        """Whether the points of trials that have not begun depend on those that have ended."""
        return self.type != "random"


class ObjectiveSpec(Section):
    """What a setting is judged by; the best policy is chosen by its evaluations, whatever this says."""

    type: Objective = Field(
        "final",
        description="final: the later half of its training, three parts evaluations and one part training episodes; "
        "area: the mean evaluation over all of it; best: its best evaluation; steps_to_threshold: the env steps to the "
        "first evaluation that reaches the threshold, and twice those of the longest training where none does.",
    )
    threshold: Number | None = Field(None, description="steps_to_threshold: the return to reach; null: the env's own.")
    cost: Cost | None = Field(
        None,
        description="env_steps: the score is set against the env steps that a training takes, as their Pareto front; "
        "null: it is not.",
    )


class ConfirmSpec(Section):
    """How the leading settings are trained again when the search is over, by which it is known which is the best."""

    top: Annotated[WholeNumber, Field(ge=2)] = Field(5, description="How many of the leading settings race at most.")
    seeds: PositiveWhole = Field(5, description="How many more seeds a setting gets at most.")
    max_share: Annotated[Number, Field(ge=0, le=10)] = Field(
        0.5, description="The most env steps that this may take, as a share of those of the search; 0: it is off."
    )


class EvaluationSpec(Section):
    """Greedy episodes during training, on seeds that are the same for all trials."""

    every_iterations: PositiveWhole = Field(5, description="Evaluate at each multiple of this, and at the end.")
    num_episodes: Annotated[WholeNumber, Field(ge=1, le=MAX_EPISODES)] = Field(
        10, description="Episodes per evaluation."
    )


class CheckpointSpec(Section):
    """Which checkpoints are kept. The best and the latest always are."""

    NEVER_EMPTY: ClassVar[frozenset[str]] = frozenset({"keep"})

    every_iterations: PositiveWhole = Field(10, description="Save at each multiple of this, and at the end.")
    keep: NonNegativeWhole = Field(2, description="How many of the newest to keep, the latest among them.")


class ResourcesSpec(Section):
    """What one trial may use, and how many run at once."""

    num_cpus: PositiveWhole | None = Field(None, description="CPUs per trial; null: 1, and 1 for each env runner.")
    num_gpus: Annotated[Number, Field(ge=0)] = Field(
        0.0, description="GPUs per trial, or per pack of trials: 1, or a share of one such as 0.25."
    )
    num_env_runners: Annotated[WholeNumber, Field(ge=0, le=SEEDS_PER_TRIAL)] = Field(
        0, description="Processes that sample for one trial; 0: the trial's own process samples."
    )
    max_concurrent: PositiveWhole | None = Field(None, description="Trials at once; null: as many as fit.")


def _from_text(key: str) -> BeforeValidator:
    """Let a section be written as one string: `env: CartPole-v1`, `scheduler: asha`."""

    def expand(value: Any) -> Any:
        return {key: value} if isinstance(value, str) else value

    return BeforeValidator(expand)


def _one_or_several(value: Any) -> Any:
    """Let a list of one text be written as the text."""
    return (value,) if isinstance(value, str) else value


def _two_objectives(value: Any) -> Any:
    """Let `objective` be written as a score, or as a score and its cost: `[return, env_steps]`."""
    if isinstance(value, str):
        return {"type": _RETURN.get(value, value)}
    if isinstance(value, Mapping) and isinstance(value.get("type"), str):
        return {**value, "type": _RETURN.get(value["type"], value["type"])}
    if not isinstance(value, list | tuple):
        return value
    names = [_RETURN.get(name, name) if isinstance(name, str) else name for name in value]
    costs = [name for name in names if name in get_args(Cost)]
    scores = [name for name in names if name not in costs]
    write = "write a score and its cost, such as [return, env_steps]"
    if len(costs) == 1 and len(scores) == 1 and isinstance(scores[0], str):
        return {"type": scores[0], "cost": costs[0]}
    if len(names) == 1:
        why = "is a cost alone" if costs else "is one objective, and no list"
        alone = f"; for a score alone write {value[0]}" if not costs and isinstance(value[0], str) else ""
        raise ValueError(f"{shortened(list(value))} {why}: {write}{alone}")
    if not names:
        raise ValueError(f"[] names nothing: {write}")
    if len(names) > 2:
        raise ValueError(f"{shortened(list(value))} has {len(names)} objectives: {write}")
    if names[0] == names[1]:
        same = "" if value[0] == value[1] else f" ({value[0]} and {value[1]} are the same)"
        raise ValueError(f"{shortened(list(value))} names one objective twice{same}: {write}")
    raise ValueError(f"{shortened(list(value))} has no cost, of which there is env_steps: {write}")


def _from_a_word(value: Any) -> Any:
    """Let `confirm` be switched by a word: none, false or true."""
    if value == "none" or value is False:
        return {"max_share": 0.0}
    return {} if value is True else value


_ASKED_FOR = [engine for engine in ENGINES if engine.can_be_asked_for]
_ENGINE_WISHES = (
    f"{'; '.join(f'{engine.name}: {engine.about}' for engine in _ASKED_FOR)}; "
    f"auto: {_ASKED_FOR[0].name} where it is possible."
)
if TYPE_CHECKING:
    EngineWish = str
else:
    EngineWish = Literal["auto", *(engine.name for engine in _ASKED_FOR)]


class SweepFields(Section):
    """The fields of a sweep, each valid by itself."""

    name: str | None = Field(
        None,
        pattern=f"^{NAME_PATTERN}$",
        description="Name of the sweep and of its folder, other than random and constant, the baselines' names; null: "
        "the file's or preset's, with a number if it is taken.",
    )
    about: Annotated[AboutSpec, _from_text("title")] = Field(
        default_factory=AboutSpec, description="What the sweep is for: a text, or a mapping. The report shows it."
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
        1,
        description="Random draws for each combination of the grids' values, no point twice while there are others; "
        "with a search by a model: points.",
    )
    points: tuple[dict[str, Any], ...] = Field(
        (),
        description="Points of your own, tried before all others and beside num_samples: a list of mappings, each with "
        "a value for each searched hyperparameter, which may lie outside of its domain.",
    )
    seeds_per_point: PositiveWhole = Field(1, description="Trials per point, each with its own seed.")
    seed: Annotated[WholeNumber, Field(ge=0)] = Field(0, description="Sweep seed: fixes points and all other seeds.")
    stop: StopSpec = Field(default_factory=StopSpec, description="When a trial ends.")
    search: Annotated[SearchSpec, _from_text("type")] = Field(
        default_factory=SearchSpec, description="Search method: random, auto, gp, forest or tpe, or a mapping."
    )
    prior: Annotated[
        tuple[NameText, ...],
        BeforeValidator(_one_or_several, json_schema_input_type=NameText | tuple[NameText, ...]),
    ] = Field(
        (),
        description="Earlier sweeps, by name or place, whose points the model begins with: of the same algorithm and "
        "space, and of any environment. They are copied when the sweep is created.",
    )
    scheduler: Annotated[SchedulerSpec, _from_text("type")] = Field(
        default_factory=SchedulerSpec, description="Early stopping: its type, or a mapping."
    )
    evaluation: EvaluationSpec = Field(default_factory=EvaluationSpec, description="Greedy evaluation.")
    objective: Annotated[ObjectiveSpec, BeforeValidator(_two_objectives)] = Field(
        default_factory=ObjectiveSpec,
        description="What a setting is judged by: its type, [type, env_steps] for the front of score against cost, or "
        "a mapping. In a list, return is final.",
    )
    confirm: Annotated[ConfirmSpec, BeforeValidator(_from_a_word)] = Field(
        default_factory=ConfirmSpec,
        description="Train the leading settings again with fresh seeds, to know which is the best: a mapping, or none.",
    )
    checkpoints: CheckpointSpec = Field(
        default_factory=CheckpointSpec, description="Which checkpoints of a trial are kept."
    )
    resources: ResourcesSpec = Field(default_factory=ResourcesSpec, description="CPUs, GPUs, env runners.")
    engine: EngineWish = Field("auto", description=_ENGINE_WISHES)
    max_retries: NonNegativeWhole = Field(2, description="How often a failed trial is retried.")
    iteration_timeout_s: PositiveNumber = Field(
        600.0, description="An iteration that takes longer counts as a failure of its trial."
    )

    @field_serializer("about")
    def _only_what_is_said(self, about: AboutSpec) -> dict[str, str] | None:
        # In sweep.json null if nothing is: versions that don't know the field skip one that is null.
        return about.model_dump(exclude_defaults=True) or None

    @field_serializer("prior")
    def _only_given_sweeps(self, prior: tuple[str, ...]) -> list[str] | None:
        # As for `about`.
        return list(prior) or None

    @field_serializer("points")
    def _only_given_points(self, points: tuple[dict[str, Any], ...]) -> list[dict[str, Any]] | None:
        # As for `about`.
        return [dict(point) for point in points] or None

    def value_without(self, name: str) -> Any:
        """Return the value of a hyperparameter where it is not searched: the fixed one, or the default."""
        field = HYPERPARAMS_BY_ALGORITHM[self.algorithm].model_fields.get(name)
        if field is None:  # the length of training, the only other name that is searched
            return self.stop.num_env_steps
        return self.hyperparams.get(name, field.get_default(call_default_factory=True))

    @property
    def grace_env_steps(self) -> int:
        """The env steps before which the scheduler ends no trial."""
        if self.scheduler.grace_env_steps is not None:
            return self.scheduler.grace_env_steps
        return max(1, self.stop.num_env_steps // 20)

    @property
    def perturb_every_env_steps(self) -> int:
        """pbt, pb2: the env steps between two comparisons of a trial."""
        return self.scheduler.perturb_every_env_steps or max(1, self.stop.num_env_steps // 10)

    @property
    def cpus_per_trial(self) -> int:
        """The CPUs of one trial: for its own process and its env runners."""
        if self.resources.num_cpus is not None:
            return self.resources.num_cpus
        return 1 + self.resources.num_env_runners
