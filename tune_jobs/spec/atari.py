"""The section `env.atari` of a sweep file."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from tune_jobs.spec.domain_kinds import WholeNumber
from tune_jobs.spec.fields import Flag, Section


class AtariSpec(Section):
    """The standard preprocessing of Atari games: Machado et al. 2018, and Mnih et al. 2015 for training alone."""

    frame_skip: Annotated[WholeNumber, Field(ge=1, le=64)] = Field(
        4, description="The frames for which an action is repeated; the brighter of the last two are observed."
    )
    noop_max: Annotated[WholeNumber, Field(ge=0, le=1_000)] = Field(
        30, description="The most no-ops, of a random number, at the start of a game."
    )
    screen_size: Annotated[WholeNumber, Field(ge=8, le=210)] = Field(
        84, description="Rows and columns of the grey image that is observed."
    )
    terminal_on_life_loss: Flag = Field(
        default=True,
        description="Training alone: a lost life is an end, after which nothing counts; the game itself goes on.",
    )
    clip_rewards: Flag = Field(default=True, description="Training alone: rewards are their signs, -1, 0 or 1.")

    @property
    def frames(self) -> dict[str, int]:
        """What is the same in training, evaluations and videos."""
        return {"frame_skip": self.frame_skip, "noop_max": self.noop_max, "screen_size": self.screen_size}

    @property
    def training(self) -> dict[str, bool]:
        """What training alone sees."""
        return {"terminal_on_life_loss": self.terminal_on_life_loss, "clip_rewards": self.clip_rewards}


def atari_from_a_flag(value: Any) -> Any:
    """Let `atari` be switched by true or false."""
    if value is True:
        return {}
    return None if value is False else value
