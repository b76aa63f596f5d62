"""A sweep and its trials as typed records, which the files of a sweep folder hold as JSON.

What came of them, the policy and the setting, is in `analysis.best_records`.

Words: *training return* is the mean undiscounted return of the last 100 whole exploring episodes; *evaluation return*
the mean of greedy episodes on the sweep's fixed evaluation seeds. `None` stands for "not known (yet)"; a score that is
NaN or infinite is written as `None`, so it can never win. Other numbers may be NaN or infinite: JSON has neither, so
files have the strings "NaN", "Infinity" and "-Infinity" for them. Files of older versions have null, read as NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, computed_field, field_validator

from analysis.notebook import Brief
from analysis.waits import WaitRecord
from policies.iteration_length import iteration_length

FORMAT_VERSION = 3
"""The newest format of a sweep's files, which sweep.json has: 0.1.0 would write it again without what it lacked."""
SEALED_FORMAT_VERSION = 2
"""The format of files that are written with a seal, which are as 0.1.0 had them."""

Objective = Literal["final", "area", "best", "steps_to_threshold"]
"""What a setting is judged by; see `analysis.objectives`."""
Cost = Literal["env_steps"]
"""What a setting may cost besides; see `analysis.front`."""
TRAINING_LENGTH = "stop.num_env_steps"
"""The name in `space` and in points by which the length of training is searched (decision 44)."""
TrialStatus = Literal["pending", "running", "paused", "completed", "failed", "stopped"]
SweepState = Literal["created", "running", "interrupted", "completed"]
"""`created` means written, but not begun."""
TRIAL_ID_PATTERN = "t[0-9]{4,9}"
"""The ids of trials, which are part of their folders' paths."""
TrialId = Annotated[str, Field(pattern=f"^{TRIAL_ID_PATTERN}$")]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Iteration = Count
FINISHED: frozenset[TrialStatus] = frozenset({"completed", "failed", "stopped"})


def length_of(point: Mapping[str, Any], num_env_steps: int) -> int:
    """Return the env steps that a point's trials have: its own if the length of training is searched, else all.

    Args:
        point: The searched values.
        num_env_steps: The env steps that a trial of the sweep has at most.
    """
    own = point.get(TRAINING_LENGTH)
    # A whole number may be written as 2e4, and a multiple of a step is a float.
    if isinstance(own, int | float) and not isinstance(own, bool) and 1 <= own < math.inf:
        return min(int(own), num_env_steps)
    return num_env_steps


def whole_length(
    point: Mapping[str, Any],
    hyperparams: Mapping[str, Any],
    *,
    num_env_steps: int,
    num_iterations: int | None = None,
) -> int:
    """Return the env steps that a trial is to have, as far as is known before; its last iteration may go beyond.

    Args:
        point: Its searched values, of which one may be its length.
        hyperparams: All of its hyperparameters, which say how long an iteration is.
        num_env_steps: The env steps that a trial of the sweep has at most.
        num_iterations: The iterations that it has at most; None: any number.
    """
    length, iteration = length_of(point, num_env_steps), iteration_length(hyperparams)
    return length if num_iterations is None or iteration is None else min(length, num_iterations * iteration)


def longest_length(trials: Iterable[TrialRecord], *, num_env_steps: int, num_iterations: int | None = None) -> int:
    """Return the env steps that the longest of a sweep's trials is to have, see `whole_length`.

    Args:
        trials: Those of one sweep; a trial whose point is not chosen yet says nothing.
        num_env_steps: The env steps that a trial of the sweep has at most.
        num_iterations: The iterations that it has at most; None: any number.
    """
    lengths = (
        whole_length(trial.point, trial.hyperparams, num_env_steps=num_env_steps, num_iterations=num_iterations)
        for trial in trials
        if trial.has_point
    )
    return max(lengths, default=num_env_steps)


def finite_or_none(value: float | None) -> float | None:
    """Return the value, or None if it is None, NaN or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def _nan_for_null(value: Any) -> Any:
    return math.nan if value is None else value


Number = Annotated[float, BeforeValidator(_nan_for_null)]
"""A number that is always known, but may be NaN or infinite."""


class Record(BaseModel):
    """What all records have in common."""

    # Unknown keys are ignored, so that an older version can read what a newer one wrote.
    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="strings")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield what the repr shows: what is not the default, and of long values their beginning."""
        fields = type(self).model_fields
        for name, value in super().__repr_args__():
            field = fields.get(name or "")
            if field is None or field.is_required() or value != field.get_default(call_default_factory=True):
                yield name, Brief(value)


class RewrittenRecord(Record):  # noqa: PLW1641 (frozen, so pydantic makes its hash)
    """A record whose file is written again while a sweep goes on, maybe by an older version than wrote it before.

    What a newer version added at its top level stays in the file, and nothing else is done with it: records that differ
    in it alone are equal.
    """

    model_config = ConfigDict(extra="allow")

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.__dict__ == other.__dict__


class CheckpointRecord(Record):
    """One kept checkpoint of a trial."""

    trial_id: TrialId
    iteration: Iteration
    num_env_steps: Count
    training_return: float | None = None
    evaluation_return: float | None = Field(None, description="None: not evaluated at this iteration.")

    @field_validator("training_return", "evaluation_return")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def path(self) -> str:
        """The folder, relative to the sweep folder, with forward slashes; it is never read from a file."""
        return f"trials/{self.trial_id}/checkpoints/{self.iteration:06d}"


class IterationRecord(Record):
    """One iteration of one trial: a line of results.jsonl."""

    iteration: Iteration
    num_env_steps: Count = Field(description="Env steps sampled so far in this trial.")
    num_episodes: Count = Field(description="Whole episodes so far in this trial.")
    time_s: Number = Field(description="Seconds of training so far, evaluation and checkpoints included.")
    waited_s: Number = Field(
        0.0, description="The seconds of these in which it waited for others in its pack, before this iteration."
    )
    training_return: float | None = None
    evaluation_return: float | None = Field(None, description="None: not evaluated at this iteration.")
    episode_returns: tuple[Number, ...] = Field((), description="Whole training episodes that ended here.")
    episode_lengths: tuple[int, ...] = ()
    learner: dict[str, float | None] = Field(default_factory=dict, description="Losses, entropy, lr, ...")

    @field_validator("training_return", "evaluation_return")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)


class ChangeRecord(Record):
    """A trial of a population that continued from a copy of another's checkpoint, with other hyperparameters."""

    iteration: int = Field(description="Iterations the trial itself had done.")
    num_env_steps: int = Field(description="Env steps the trial itself had done.")
    source_trial_id: TrialId = Field(description="The trial whose weights and optimizer state it continued with.")
    source_iteration: int = Field(description="Iteration of the copied checkpoint in that trial.")
    before: dict[str, Any] = Field(description="The trial's searched values until then.")
    after: dict[str, Any] = Field(description="Its searched values from then on.")
    values_trial_id: TrialId | None = Field(
        None,
        description="The trial whose values these were, where a trial of another sub-population was copied; null: they "
        "are new.",
    )
    time: Number = Field(description="Unix time, seconds.")


class TrialPlan(Record):
    """What is known about a trial before it begins: its point, its seed and its place in the sweep."""

    trial_id: TrialId
    index: int
    point_index: int
    seed_index: int = 0
    seed: int
    point: dict[str, Any] = Field(description="The sampled values alone; in a population the newest.")
    hyperparams: dict[str, Any] = Field(default_factory=dict, description="All values, fixed ones too.")
    has_point: bool = Field(
        default=True, description="False: the search method chooses the point when the trial starts."
    )
    engine: str = Field(
        "rllib", description="What trains it: packed (with others, in one process), rllib, or baseline."
    )
    changes: tuple[ChangeRecord, ...] = Field((), description="What population based training changed, oldest first.")


class TrialState(Record):
    """The state of a trial, which its process reports; the process that drives the sweep counts the failures."""

    status: TrialStatus = "pending"
    stop_reason: str | None = Field(None, description="The stop rule, cap or scheduler that ended it.")
    error: str | None = Field(None, description="Why it failed, with the end of its log.")
    num_failures: int = 0
    num_iterations: int = 0
    num_env_steps: int = 0
    num_episodes: int = 0
    time_s: Number = 0.0
    training_return: float | None = None
    evaluation_return: float | None = Field(None, description="The newest evaluation.")
    best_evaluation_return: float | None = None
    best_iteration: int | None = None
    objective_score: float | None = Field(
        None,
        description="Its score by the sweep's objective, if it ended here; null: no search method learns of it.",
    )
    notes: tuple[str, ...] = Field((), description="What was damaged in it, and what it continued from instead.")
    node: str | None = Field(None, description="Address or name of the node it last ran on.")
    pid: int | None = Field(None, description="Process it last ran in.")
    ran_with: dict[str, str] = Field(
        default_factory=dict,
        description="CPU, versions and environment variables that its numbers may depend on, where it last ran.",
    )
    started_at: float | None = Field(None, description="Unix time, seconds.")
    ended_at: float | None = None
    checkpoints: tuple[CheckpointRecord, ...] = Field((), description="The kept ones, oldest first.")

    @field_validator("training_return", "evaluation_return", "best_evaluation_return", "objective_score")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)


class TrialRecord(TrialState, TrialPlan, RewrittenRecord):
    """One training run: trial.json. The fields of a plan come first there, then those of the state."""

    def point_at(self, iteration: int) -> dict[str, Any]:
        """Return the searched values that the trial had in an iteration; they change only in a population."""
        # A change after iteration i takes effect from i + 1 on.
        later = [change for change in self.changes if change.iteration >= iteration]
        return later[0].before if later else self.point

    @property
    def first_hyperparams(self) -> dict[str, Any]:
        """All hyperparameters that the trial began with."""
        return {**self.hyperparams, **self.changes[0].before} if self.changes else self.hyperparams


class ReplicationRecord(Record):
    """More seeds that some points of a sweep were given, one each; see `analysis.numbering`."""

    num_points: Annotated[int, Field(ge=1, le=2**31)] = Field(description="The points that the sweep had then.")
    points: tuple[Annotated[int, Field(ge=0, le=2**31)], ...] = Field(
        description="Their indices, in the order of the trials."
    )
    by: Literal["replicate", "confirm"] = Field(
        "replicate", description="Who asked for them: a person, or the sweep's own `confirm`."
    )
    race: str = Field("", description="The name of the race that it is a round of; empty: `confirm`, or an old record.")
    contenders: tuple[Annotated[int, Field(ge=0, le=2**31)], ...] = Field((), description="The points that race in it.")
    num_seeds: Annotated[int, Field(ge=0, le=100_000)] = Field(0, description="The most seeds that it gives a point.")


class ChosenPointRecord(Record):
    """A point that somebody chose, beside those that the search gives; see `analysis.numbering`."""

    num_points: Annotated[int, Field(ge=0, le=2**31)] = Field(
        description="The points that the sweep had then, which is the index of this one."
    )
    point: dict[str, Any] = Field(description="Its values of the searched hyperparameters.")


class PriorPointRecord(Record):
    """A point of an earlier sweep, as the model of a later one is told it."""

    point: dict[str, Any] = Field(description="Its values of what the later sweep searches.")
    share: Annotated[float, Field(ge=0, le=1)] | None = Field(
        description="The share of its sweep's points that it is better than; null: a seed of it failed."
    )
    env_steps: Count | None = Field(None, description="Mean env steps that a training takes; None: a former record.")
    trained: Annotated[float, Field(ge=0, le=1)] = Field(
        1.0, description="The share of its training that it has had; a former record tells none."
    )


class PriorRecord(Record):
    """An earlier sweep that a search begins with, as it was when the sweep was created."""

    sweep: str = Field(description="Its name.")
    env_id: str = Field(description="The environment that it trained in.")
    points: tuple[PriorPointRecord, ...] = Field(description="Its points that the later sweep could have.")
    num_ended: int | None = Field(None, description="How many of its points had ended; None: a former record.")
    by_best_evaluation: bool = Field(
        default=False,
        description="Whether they are ranked by their best evaluations, as scores by its objective are not known.",
    )


class JobRecord(Record):
    """The job of a Ray cluster that drives a sweep, or was asked to."""

    id: str = Field(description="Its submission id.")
    address: str = Field(description="The address of the Jobs API that runs it; it never holds a token.")
    place: str = Field("", description="The folder or URL of the sweep that it is of; empty in older records.")


class SweepRecord(RewrittenRecord):
    """The record of a sweep: sweep.json."""

    format_version: int = FORMAT_VERSION
    name: str
    state: SweepState
    spec: dict[str, Any] = Field(description="The resolved sweep file.")
    evaluation_seeds: tuple[int, ...]
    confirmation_seeds: tuple[int, ...]
    num_trials: int
    created_at: Number
    started_at: float | None = None
    ended_at: float | None = None
    run_time_s: Number = Field(0.0, description="Seconds that launches and resumes took together.")
    versions: dict[str, str] = Field(default_factory=dict)
    git_commit: str | None = None
    address: str | None = None
    job: JobRecord | None = Field(None, description="The job that drove it last; None: another process did.")
    allowed_modules: tuple[str, ...] = Field((), description="Modules of the user's own that its trials may import.")
    waiting: WaitRecord | None = Field(None, description="The nodes it waits for; if nothing runs it: waited, in vain.")
    replications: tuple[ReplicationRecord, ...] = Field((), description="More seeds of some points, oldest first.")
    chosen_points: tuple[ChosenPointRecord, ...] = Field((), description="Points that somebody chose, oldest first.")
    prior: tuple[PriorRecord, ...] = Field((), description="What its search began with, of earlier sweeps.")
    repeats: str | None = Field(
        None, description="The trial that it repeats, SWEEP/TRIAL, and has alone; None: it is no repetition."
    )
    env_threshold: float | None = Field(None, description="The env's own threshold when it was planned, if it has one.")
    env_spaces: dict[str, str] = Field(
        default_factory=dict,
        description="The shapes of the env's observations and actions when trials were last planned; empty: not known.",
    )
    is_flattened: bool = Field(
        default=False,
        description="Whether the env's own observations were neither vectors nor images; False in older records.",
    )
    is_masked: bool = Field(
        default=False, description="Whether the env says which actions are allowed; False in older records."
    )

    @property
    def max_iterations(self) -> int | None:
        """The iterations that a trial has at most, `stop.num_iterations`; None: the record doesn't say.

        None, too, in a population: how long an iteration is may change there, as its trials' values do.
        """
        if self.is_population:
            return None
        stated = self.section("stop").get("num_iterations")
        return stated if isinstance(stated, int) else None

    @property
    def is_population(self) -> bool:
        """Whether its trials go on from copies of others, with other values."""
        return self.section("scheduler").get("type") in ("pbt", "pb2")

    def section(self, name: str) -> Mapping[str, Any]:
        """Return a section of the sweep file, empty where a record lacks it or has something else there.

        A text is the section's `type`: `objective: area` is `objective: {type: area}`.
        """
        found = self.spec.get(name)
        if isinstance(found, str):
            return {"type": found}
        return found if isinstance(found, Mapping) else {}
