"""What came of a sweep as typed records: the policy to deploy, the setting to train with, and how both were found."""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field

from analysis.notebook import facts_html
from analysis.records import SEALED_FORMAT_VERSION, CheckpointRecord, Cost, Count, Number, Objective, Record, TrialId


class EvaluationRecord(Record):
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


class SettingRecord(Record):
    """A point of a sweep as a setting to train with, judged over its training seeds."""

    point_index: Count
    point: dict[str, Any]
    trial_ids: tuple[TrialId, ...] = Field(description="The trials it was trained in, one a training seed.")
    scores: tuple[Number, ...] = Field(description="The objective's value of each of them, higher is better.")
    num_failed: Count = Field(description="How many of them failed, which count as the worst of the sweep or worse.")
    num_solved: Count | None = Field(None, description="How many reached the threshold; None: the env has none.")
    score: Number = Field(description="Mean of the scores.")
    expected: Number = Field(description="What it is expected to be over many seeds, by which settings are ranked.")
    lower: float | None = Field(None, description="The 95 % interval over training seeds; None: no two seeds differ.")
    upper: float | None = None
    probability_best: float | None = Field(None, description="That no other is better; None: no two seeds differ.")
    may_be_best: bool = Field(default=True, description="Whether the data can't tell it from the best.")


class FrontPointRecord(Record):
    """A setting on the front of score against cost."""

    rank: Count = Field(description="Its place among the settings, by score; 1: the best.")
    point_index: Count
    point: dict[str, Any]
    num_seeds: Count
    score: Number = Field(description="Mean of the objective over its seeds, higher is better.")
    expected: Number = Field(description="What it is expected to be over many seeds, by which the front is found.")
    num_env_steps: Number = Field(description="Its cost: the mean env steps of a training with it.")
    lower: float | None = Field(None, description="The 95 % interval over training seeds; None: no two seeds differ.")
    upper: float | None = None


class FrontRecord(Record):
    """The Pareto front of score against cost over the settings of a sweep; see `analysis.front`."""

    cost: Cost = "env_steps"
    points: tuple[FrontPointRecord, ...] = Field(min_length=1, description="The settings on it, the cheapest first.")
    num_on_front: Count = Field(description="All that are on it, not only those that are listed.")
    undecided: tuple[FrontPointRecord, ...] = Field(
        (), description="Others that the data can't tell from being on it, the cheapest ones."
    )
    num_undecided: Count | None = Field(None, description="How many these are; None: no two seeds differ.")
    cheapest_near: FrontPointRecord = Field(description="The cheapest setting near the best.")
    best_env_steps: float | None = Field(None, description="What the best one costs; None: a former record.")
    near_share: Number = Field(description="The share of what the best gained that one near it loses at most.")
    untrained: float | None = Field(None, description="The return that gains are counted from; None: it is not known.")
    near_score: Number = Field(description="The least expected score that is near the best.")
    may_be_best: bool | None = Field(
        None, description="Whether the data can't tell `cheapest_near` from the best; None: no two seeds differ."
    )
    most_seeds: Count | None = Field(None, description="The most that any setting has; None: a former record.")

    @property
    def several_seeds(self) -> bool:
        """Whether any setting, listed or not, has two seeds or more; of a former record, any that is listed."""
        return (self.most_seeds or max(item.num_seeds for item in self.points)) > 1


class SettingsRecord(Record):
    """The settings of a sweep, ranked: which to train with."""

    objective: Objective = Field(description="What they are judged by.")
    threshold: float | None = None
    num_settings: Count = Field(description="All that were trained, not only those that are listed.")
    num_may_be_best: Count = Field(description="How many of all the data can't tell from the best, itself included.")
    ranking: tuple[SettingRecord, ...] = Field(min_length=1, description="The leading ones, best first.")
    front: FrontRecord | None = Field(None, description="Score against cost; None: the sweep doesn't ask for it.")
    never_reached: Count | None = Field(
        None,
        description="steps_to_threshold: what a seed that never reaches it counts as, in env steps, twice those of the "
        "longest training; None: another objective, or a former record.",
    )
    most_seeds: Count | None = Field(None, description="The most that any setting has; None: a former record.")

    @property
    def best(self) -> SettingRecord:
        """The setting to train with."""
        return self.ranking[0]

    @property
    def several_seeds(self) -> bool:
        """Whether any setting, listed or not, has two seeds or more; of a former record, any that is listed."""
        return (self.most_seeds or max(len(item.scores) for item in self.ranking)) > 1

    def num_never(self, item: SettingRecord) -> int:
        """Return how many seeds of a setting never reached the threshold, those that failed included."""
        return 0 if self.never_reached is None else item.scores.count(-float(self.never_reached))


class CandidateRecord(Record):
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


class ChoiceRecord(Record):
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


class BestRecord(Record):
    """Both answers of a sweep, the policy to deploy and the setting to train with: best/evaluation.json."""

    format_version: int = SEALED_FORMAT_VERSION
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
            f"gap {difference_text(self.optimism_gap, confirmed.mean_return)}",
            "random policy": return_text(self.random.mean_return),
        }
        if confirmed.solved is not None:
            solved = "solved" if confirmed.solved else "not solved"
            facts[confirmed.env_id] = f"{solved} (threshold {confirmed.threshold:g})"
        return facts_html("Best policy", facts)


class FilmsRecord(Record):
    """Whose films lie in best/: films.json, written once they are whole."""

    format_version: int = SEALED_FORMAT_VERSION
    checkpoint: CheckpointRecord = Field(description="The winner that they show.")
