"""The front of score against cost with all that it takes to draw it and to say what it shows, for the web page."""

from __future__ import annotations

from pydantic import Field

from analysis.best_records import FrontRecord
from analysis.exports.frames import SweepData, ranked_settings
from analysis.front import costs_lie_far_apart, front_of, other_settings, settings_on_front, untrained_return
from analysis.front_words import about_front, cheapest_near_text
from analysis.objectives import SettingScores
from analysis.records import Cost, Count, Number, Objective, Record

_MOST_OTHERS = 1_000


class OtherSettingRecord(Record):
    """A setting that is not listed on the front."""

    rank: Count = Field(description="Its place among the settings, by score; 1: the best.")
    point_index: Count
    expected: Number = Field(description="What its score is expected to be over many seeds.")
    num_env_steps: Number = Field(description="Its cost: the mean env steps of a training with it.")


class FrontView(Record):
    """Score against cost over the settings of a sweep, as far as trials have ended."""

    objective: Objective = Field(description="What scores are.")
    num_settings: Count = Field(description="All that have ended trials.")
    front: FrontRecord | None = Field(
        None, description="Their front; null: the sweep doesn't ask for it, or has nothing to judge them by yet."
    )
    more_on_front: tuple[OtherSettingRecord, ...] = Field(
        (), description="Those on it beyond the ones that `front` lists, the cheapest first."
    )
    others: tuple[OtherSettingRecord, ...] = Field(
        (),
        description=f"Settings that are neither on it nor undecided, best first; at most {_MOST_OTHERS:,}.",
    )
    costs_lie_far_apart: bool = Field(default=False, description="Whether costs are better drawn to a log scale.")
    cheapest_near: str = Field("", description="What the cheapest setting near the best is, in words.")
    about: tuple[str, ...] = Field((), description="What the front is, and how sure, in sentences.")


def front_view(data: SweepData, cost: Cost | None) -> FrontView:
    """Return the front of a sweep; empty if it doesn't ask for one.

    Args:
        data: The sweep; it may still run.
        cost: What its settings cost; None: it doesn't ask for that.
    """
    ranking = [] if cost is None else ranked_settings(data)
    front = front_of(ranking, untrained_return(data.results))
    if front is None:
        return FrontView(objective=data.objective, num_settings=len(ranking))
    ranks = {item.point_index: rank for rank, item in enumerate(ranking, start=1)}

    def told(item: SettingScores) -> OtherSettingRecord:
        return OtherSettingRecord(
            rank=ranks[item.point_index],
            point_index=item.point_index,
            expected=item.expected,
            num_env_steps=item.cost,
        )

    return FrontView(
        objective=data.objective,
        num_settings=len(ranking),
        front=front,
        more_on_front=tuple(map(told, settings_on_front(ranking)[len(front.points) :])),
        others=tuple(map(told, other_settings(ranking, front, _MOST_OTHERS))),
        costs_lie_far_apart=costs_lie_far_apart(ranking),
        cheapest_near=cheapest_near_text(front),
        about=tuple(about_front(front)),
    )
