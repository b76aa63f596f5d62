"""Who asks, and what they may do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tune_jobs.service.labels import Label

Role = Literal["viewer", "submitter", "admin"]
RANK: dict[Role, int] = {"viewer": 0, "submitter": 1, "admin": 2}


@dataclass(frozen=True)
class Caller:
    """Who asks.

    Args:
        name: The token's name; on this machine, without a token, `local`.
        role: A viewer looks, a submitter submits and changes their own sweeps, an admin changes all.
        token_id: The token that was shown; None: none was.
    """

    name: str
    role: Role
    token_id: str | None = None

    def may_change(self, label: Label) -> bool:
        """Whether they may change a sweep."""
        return self.role == "admin" or (self.role == "submitter" and label.owner == self.name)


LOCAL = Caller("local", "admin")
