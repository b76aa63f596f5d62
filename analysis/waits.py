"""What a sweep waits for: nodes of a cluster that have room for one of its trials."""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict, Field

from analysis.wording import duration, moment


class WaitRecord(BaseModel):
    """A wait for nodes, as the sweep's record has it while it waits; it stays there if the wait was in vain."""

    model_config = ConfigDict(frozen=True, extra="ignore", ser_json_inf_nan="strings")

    since: float = Field(description="Unix time, seconds.")
    until: float | None = Field(None, description="Unix time at which the sweep gives up; None: it has no limit.")
    resources: dict[str, float] = Field(default_factory=dict, description="CPU and GPU of one trial.")
    lacking: str = Field("", description="Why no trial runs: what one needs, what the nodes have, what is missing.")

    def told(self, now: float, *, is_over: bool = False) -> str:
        """Describe the wait in one line: for what, since when, and how much longer.

        Args:
            now: Unix time, seconds.
            is_over: Whether nothing waits any more, as the limit or a person ended it before a node came.
        """
        parts = [f"{count:g} {name}{'s' * (count != 1)}" for name, count in self.resources.items() if count]
        since = f"nodes with room for one trial ({' and '.join(parts)}), since {moment(self.since)}"
        if is_over:
            return f"{since}, in vain. {self.lacking}".strip()
        told = f"{since} ({_whole(now - self.since)})"
        if self.until is not None:
            told += f", at most {_whole(self.until - now)} more"
        return f"{told}. {self.lacking}".strip()


def _whole(seconds: float) -> str:
    # Clocks of two machines differ.
    return duration(max(0.0, seconds) if math.isfinite(seconds) else 0.0, tenths=False)
