"""Say in words what the front of score against cost shows, and its rows, for the command line and the report."""

from __future__ import annotations

from typing import NamedTuple

from analysis.best_records import FrontPointRecord, FrontRecord
from analysis.wording import counted, number, range_text, return_text, setting_text

ON_FRONT, MAY_BE = "yes", "may be"
NEAREST = "yes, the cheapest near the best"
_ABOUT = (
    "On the front are the settings than which no other is as cheap and better, or as good and cheaper, by expected "
    "means over seeds. The cost is the mean env steps of a training: less than its length where it reached its goal, "
    "and the whole length where a scheduler ended it or it failed. A setting of which no seed was scored is not on it."
)


class FrontRow(NamedTuple):
    """A setting that is, or may be, on the front."""

    item: FrontPointRecord
    on_front: str
    """Whether it is on the front, in words."""

    @property
    def is_on_front(self) -> bool:
        """Whether it is, by the expected means."""
        return self.on_front != MAY_BE


def front_rows(front: FrontRecord) -> list[FrontRow]:
    """Return the listed settings, the cheapest first."""
    near = front.cheapest_near.point_index
    found = [FrontRow(item, NEAREST if item.point_index == near else ON_FRONT) for item in front.points]
    found += [FrontRow(item, MAY_BE) for item in front.undecided]
    return sorted(found, key=lambda row: (row.item.num_env_steps, row.item.rank))


def interval_text(item: FrontPointRecord, none: str) -> str:
    """Return the 95 % interval of a setting's score over training seeds."""
    if item.lower is None or item.upper is None:
        return none
    return range_text(item.lower, item.upper)


def cheapest_near_text(front: FrontRecord | None) -> str:
    """Name the cheapest setting near the best one, and say how much it saves; empty: the sweep doesn't ask for it."""
    if front is None:
        return ""
    near = front.cheapest_near
    if near.rank == 1:
        return "the best setting itself: no cheaper one is near it"
    point = ", ".join(f"{name} {setting_text(value)}" for name, value in near.point.items())
    whole = front.best_env_steps
    if whole is None and front.points[-1].rank == 1:
        whole = front.points[-1].num_env_steps
    share = f", {100 * near.num_env_steps / whole:.0f} % of the best one's" if whole else ""
    text = f"{point}: {return_text(near.score)} for {env_steps_text(near)} a training{share}"
    if front.may_be_best is None:
        return text
    return f"{text}; the data {'cannot' if front.may_be_best else 'can'} tell it from the best"


def about_front(front: FrontRecord) -> list[str]:
    """Say what the front is, how sure that is, and what of it is listed."""
    told = [_ABOUT, near_text(front), undecided_text(front)]
    if front.num_on_front > len(front.points):
        told.append(f"The {len(front.points)} cheapest of {front.num_on_front:,} on the front are listed.")
    return told


def near_text(front: FrontRecord) -> str:
    """Say what is near the best one."""
    if front.untrained is None:
        return "No episode was whole before training, so only what scores as the best does is near it."
    if front.near_score <= front.untrained:
        return (
            f"The best one gained nothing on the untrained policies' {return_text(front.untrained)}, so only what "
            "scores as it does is near it."
        )
    return (
        f"Near the best is a setting that loses at most {100 * front.near_share:.0f} % of what the best one gained on "
        f"the untrained policies' {return_text(front.untrained)}: one whose mean, drawn back to that of all settings, "
        f"is {return_text(front.near_score)} or more."
    )


def undecided_text(front: FrontRecord) -> str:
    """Say how sure it is who is on the front."""
    if front.num_undecided is None:
        why = "It is not known how much seeds differ" if front.several_seeds else "Each setting has one seed"
        return f"{why}: nothing says how sure it is who is on the front."
    if not front.num_undecided:
        return "The data tell all other settings from those on the front."
    text = f"{counted(front.num_undecided, 'other setting')} can't be told from being on the front"
    listed = len(front.undecided)
    return f"{text}{f'; the {listed} cheapest are listed' if listed < front.num_undecided else ''}."


def env_steps_text(item: FrontPointRecord) -> str:
    """Return a setting's cost."""
    return f"{number(round(item.num_env_steps))} env steps"
