"""Keep track of which rows belong to which member of a pack."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.intp]


class MemberRows:
    """The members in the order of their rows, each with the same number of rows.

    Methods that change the order return the old rows in their new order: `array[rows]` is an array in the new order.

    Args:
        num_envs: Rows of each member.
    """

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.ids: tuple[str, ...] = ()

    def __len__(self) -> int:
        """The number of rows."""
        return len(self.ids) * self.num_envs

    def of(self, member_id: str) -> slice:
        """Return a member's rows."""
        first = self.ids.index(member_id) * self.num_envs
        return slice(first, first + self.num_envs)

    def check_new(self, member_id: str) -> None:
        """Refuse a member that is in the pack already.

        Raises:
            ValueError: It is in the pack.
        """
        if member_id in self.ids:
            raise ValueError(f"{member_id!r} is a member already; the members are {', '.join(self.ids)}")

    def add(self, member_id: str) -> None:
        """Add a member after all others."""
        self.check_new(member_id)
        self.ids += (member_id,)

    def remove(self, member_id: str) -> Rows:
        """Take a member out."""
        return self._choose([other for other in self.ids if other != member_id])

    def arrange(self, member_ids: Sequence[str]) -> Rows:
        """Put the members into another order.

        Raises:
            ValueError: These are not the members.
        """
        if sorted(member_ids) != sorted(self.ids):
            raise ValueError(f"the members are {', '.join(self.ids)}, not {', '.join(member_ids)}")
        return self._choose(member_ids)

    def _choose(self, member_ids: Sequence[str]) -> Rows:
        positions = np.array([self.ids.index(member_id) for member_id in member_ids], dtype=np.intp)
        self.ids = tuple(member_ids)
        rows: Rows = (positions[:, None] * self.num_envs + np.arange(self.num_envs)).ravel()
        return rows
