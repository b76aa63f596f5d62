"""The results of a sweep as typed records, which the files of a sweep folder hold as JSON.

Words: *training return* is the mean undiscounted return of the last 100 whole exploring episodes; *evaluation return*
the mean of greedy episodes on the sweep's fixed evaluation seeds. `None` stands for "not known (yet)"; a score that is
NaN or infinite is written as `None`, so it can never win. Other numbers may be NaN or infinite: JSON has neither, so
files have the strings "NaN", "Infinity" and "-Infinity" for them. Files of older versions have null, read as NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, computed_field, field_validator

from analysis.notebook import Brief, facts_html
from analysis.waits import WaitRecord

FORMAT_VERSION = 2

Objective = Literal["final", "area", "best", "steps_to_threshold"]
"""What a setting is judged by; see `analysis.objectives`."""
TrialStatus = Literal["pending", "running", "paused", "completed", "failed", "stopped"]
SweepState = Literal["created", "running", "interrupted", "completed"]
"""`created` means written, but not begun."""
TRIAL_ID_PATTERN = "t[0-9]{4,9}"
"""The ids of trials, which are part of their folders' paths."""
TrialId = Annotated[str, Field(pattern=f"^{TRIAL_ID_PATTERN}$")]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Iteration = Count
FINISHED: frozenset[TrialStatus] = frozenset({"completed", "failed", "stopped"})


def finite_or_none(value: float | None) -> float | None:
    """Return the value, or None if it is None, NaN or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def _nan_for_null(value: Any) -> Any:
    return math.nan if value is None else value


Number = Annotated[float, BeforeValidator(_nan_for_null)]
"""A number that is always known, but may be NaN or infinite."""


class _Record(BaseModel):
    # Unknown keys are ignored, so that an older version can read what a newer one wrote.
    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="strings")

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield what the repr shows: what is not the default, and of long values their beginning."""
        fields = type(self).model_fields
        for name, value in super().__repr_args__():
            field = fields.get(name or "")
            if field is None or field.is_required() or value != field.get_default(call_default_factory=True):
                yield name, Brief(value)


class CheckpointRecord(_Record):
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


class IterationRecord(_Record):
    """One iteration of one trial: a line of results.jsonl."""

    iteration: Iteration
    num_env_steps: Count = Field(description="Env steps sampled so far in this trial.")
    num_episodes: Count = Field(description="Whole episodes so far in this trial.")
    time_s: Number = Field(description="Seconds of training so far, evaluation and checkpoints included.")
    training_return: float | None = None
    evaluation_return: float | None = Field(None, description="None: not evaluated at this iteration.")
    episode_returns: tuple[Number, ...] = Field((), description="Whole training episodes that ended here.")
    episode_lengths: tuple[int, ...] = ()
    learner: dict[str, float | None] = Field(default_factory=dict, description="Losses, entropy, lr, ...")

    @field_validator("training_return", "evaluation_return")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)


class ChangeRecord(_Record):
    """A trial of a population that continued from a copy of another's checkpoint, with other hyperparameters."""

    iteration: int = Field(description="Iterations the trial itself had done.")
    num_env_steps: int = Field(description="Env steps the trial itself had done.")
    source_trial_id: TrialId = Field(description="The trial whose weights and optimizer state it continued with.")
    source_iteration: int = Field(description="Iteration of the copied checkpoint in that trial.")
    before: dict[str, Any] = Field(description="The trial's searched values until then.")
    after: dict[str, Any] = Field(description="Its searched values from then on.")
    time: Number = Field(description="Unix time, seconds.")


class TrialPlan(_Record):
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


class TrialState(_Record):
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

    @field_validator("training_return", "evaluation_return", "best_evaluation_return")
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        return finite_or_none(value)


class TrialRecord(TrialState, TrialPlan):
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


class EvaluationRecord(_Record):
    """Greedy episodes of one policy on known seeds."""

    policy: str = Field(description="What was evaluated: a path, or 'random'.")
    env_id: str
    env_args: dict[str, Any] = Field(default_factory=dict)
    seeds: tuple[int, ...]
    returns: tuple[Number, ...] = Field(description="Undiscounted return of each episode, in the order of seeds.")
    lengths: tuple[int, ...] = Field(description="Env steps of each episode.")
    threshold: float | None = Field(None, description="The env's reward threshold; None if it has none.")

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    @property
    def mean_return(self) -> float:
        """Mean episode return."""
        return sum(self.returns) / len(self.returns)

    @property
    def std_return(self) -> float:
        """Population standard deviation of the episode returns."""
        mean = self.mean_return
        return math.sqrt(sum((value - mean) * (value - mean) for value in self.returns) / len(self.returns))

    @property
    def solved(self) -> bool | None:
        """Whether the mean reaches the env's threshold; None if it has none."""
        return None if self.threshold is None else self.mean_return >= self.threshold


class SettingRecord(_Record):
    """A point of a sweep as a setting to train with, judged over its training seeds."""

    point_index: Count
    point: dict[str, Any]
    trial_ids: tuple[TrialId, ...] = Field(description="The trials it was trained in, one a training seed.")
    scores: tuple[Number, ...] = Field(description="The objective's value of each of them, higher is better.")
    num_failed: Count = Field(description="How many of them failed; their scores are the worst of the sweep.")
    num_solved: Count | None = Field(None, description="How many reached the threshold; None: the env has none.")
    score: Number = Field(description="Mean of the scores.")
    expected: Number = Field(description="What it is expected to be over many seeds, by which settings are ranked.")
    lower: float | None = Field(None, description="The 95 % interval over training seeds; None: one seed a setting.")
    upper: float | None = None
    probability_best: float | None = Field(None, description="That no other is better; None: one seed a setting.")
    may_be_best: bool = Field(default=True, description="Whether the data can't tell it from the best.")


class SettingsRecord(_Record):
    """The settings of a sweep, ranked: which to train with."""

    objective: Objective = Field(description="What they are judged by.")
    threshold: float | None = None
    num_settings: Count = Field(description="All that were trained, not only those that are listed.")
    num_may_be_best: Count = Field(description="How many of all the data can't tell from the best, itself included.")
    ranking: tuple[SettingRecord, ...] = Field(min_length=1, description="The leading ones, best first.")

    @property
    def best(self) -> SettingRecord:
        """The setting to train with."""
        return self.ranking[0]


class CandidateRecord(_Record):
    """A kept checkpoint that might have been the policy to deploy, and how it fared."""

    checkpoint: CheckpointRecord
    point: dict[str, Any]
    num_episodes: Count = Field(description="Greedy episodes that it was judged by, those of its evaluation included.")
    score: Number = Field(description="Mean return over them.")
    lower: float | None = Field(
        None, description="The 95 % interval over episodes of this policy; None: none were played."
    )
    upper: float | None = None
    rejected_in: Count | None = Field(
        None, description="The round after which it was rejected; 0: it played in none; None: it won."
    )
    reason: str = Field("", description="Why it was rejected; empty: for its score.")
    confirmation: EvaluationRecord | None = Field(
        None, description="A runner-up on the confirmation seeds; the winner's is the record's own."
    )


class ChoiceRecord(_Record):
    """How the policy to deploy was chosen: by successive rejects among the leading checkpoints of all trials."""

    candidates: tuple[CandidateRecord, ...] = Field(min_length=1, description="The winner first.")
    num_known: Count = Field(description="All kept checkpoints that had an evaluation.")
    num_evaluation_episodes: Count = Field(description="The episodes of an evaluation during training.")
    first_seed: Count | None = Field(None, description="The seed of the first further episode; None: there was none.")
    num_rounds: Count = 0
    num_episodes: Count = Field(0, description="Further episodes that were played, of all candidates together.")
    num_env_steps: Count = Field(0, description="Env steps of these.")
    max_env_steps: Count = Field(0, description="How many env steps they might take.")
    note: str = Field("", description="Why the rounds ended before the last one; empty: they did not.")

    @property
    def winner(self) -> CandidateRecord:
        """The policy to deploy."""
        return self.candidates[0]

    @property
    def played(self) -> tuple[CandidateRecord, ...]:
        """The candidates that could play, the winner first."""
        return tuple(item for item in self.candidates if item.rejected_in != 0)

    @property
    def runners_up(self) -> tuple[CandidateRecord, ...]:
        """Those that were confirmed beside the winner."""
        return tuple(item for item in self.candidates if item.confirmation is not None)


class BestRecord(_Record):
    """Both answers of a sweep, the policy to deploy and the setting to train with: best/evaluation.json."""

    format_version: int = FORMAT_VERSION
    checkpoint: CheckpointRecord
    point: dict[str, Any]
    seed: int
    selection_score: Number = Field(description="Mean return of the greedy episodes it was chosen by.")
    confirmation: EvaluationRecord = Field(description="The winner on seeds it was not chosen on.")
    random: EvaluationRecord = Field(description="A random policy on the confirmation seeds.")
    settings: SettingsRecord | None = Field(
        None, description="The settings, which are another question than the policy; None: of an older version."
    )
    choice: ChoiceRecord | None = Field(
        None, description="What the policy was chosen from, and how; None: of an older version."
    )

    @property
    def optimism_gap(self) -> float:
        """Selection score minus confirmation mean: how much choosing the maximum raised the score."""
        return self.selection_score - self.confirmation.mean_return

    def _repr_html_(self) -> str:
        from analysis.wording import difference_text, return_text, setting_text

        point = ", ".join(f"{name} {setting_text(value)}" for name, value in self.point.items())
        confirmed = self.confirmation
        facts = {
            "values": point or "no searched values",
            "trial": f"{self.checkpoint.trial_id}, at {self.checkpoint.num_env_steps:,} env steps",
            "chosen by": f"{return_text(self.selection_score)} mean evaluation return"
            + (f" over {self.choice.winner.num_episodes:,} episodes" if self.choice is not None else ""),
            "confirmed at": f"{return_text(confirmed.mean_return)} over {confirmed.num_episodes} fresh episodes; "
            f"gap {difference_text(self.optimism_gap)}",
            "random policy": return_text(self.random.mean_return),
        }
        if confirmed.solved is not None:
            solved = "solved" if confirmed.solved else "not solved"
            facts[confirmed.env_id] = f"{solved} (threshold {confirmed.threshold:g})"
        return facts_html("Best policy", facts)


class FilmsRecord(_Record):
    """Whose films lie in best/: films.json, written once they are whole."""

    format_version: int = FORMAT_VERSION
    checkpoint: CheckpointRecord = Field(description="The winner that they show.")


class ReplicationRecord(_Record):
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


class ChosenPointRecord(_Record):
    """A point that somebody chose, beside those that the search gives; see `analysis.numbering`."""

    num_points: Annotated[int, Field(ge=0, le=2**31)] = Field(
        description="The points that the sweep had then, which is the index of this one."
    )
    point: dict[str, Any] = Field(description="Its values of the searched hyperparameters.")


class JobRecord(_Record):
    """The job of a Ray cluster that drives a sweep, or was asked to."""

    id: str = Field(description="Its submission id.")
    address: str = Field(description="The address of the Jobs API that runs it; it never holds a token.")


class SweepRecord(_Record):
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

    def section(self, name: str) -> Mapping[str, Any]:
        """Return a section of the sweep file, empty where a record lacks it or has something else there.

        A text is the section's `type`: `objective: area` is `objective: {type: area}`.
        """
        found = self.spec.get(name)
        if isinstance(found, str):
            return {"type": found}
        return found if isinstance(found, Mapping) else {}
