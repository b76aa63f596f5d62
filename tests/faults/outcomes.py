"""What became of each fault, kept in a file so that a run that was cut goes on, and as a table."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass
class Outcome:
    """One fault."""

    scenario: str
    moment: str
    problems: list[str] = field(default_factory=list)
    recomputed: int | None = None
    """The most iterations of a trial that had to be trained again."""
    told: str = ""
    """The end of what the run printed, if the fault ended it."""
    seconds: float = 0.0
    check: Callable[[], list[str]] | None = None
    """Called when the sweep is at its end."""

    def as_line(self) -> str:
        """As the file has it."""
        kept = {name: value for name, value in vars(self).items() if name != "check"}
        return json.dumps(kept) + "\n"


class Outcomes:
    """The outcomes of this run and of those that it goes on from.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.all: list[dict[str, Any]] = []
        if path.is_file():
            self.all = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]

    def add(self, found: Iterable[Outcome]) -> None:
        """Keep what a sweep came to."""
        with self._path.open("a", encoding="utf-8") as file:
            for outcome in found:
                file.write(outcome.as_line())
                self.all.append(json.loads(outcome.as_line()))
                verdict = "; ".join(outcome.problems) or "ok"
                print(f"{outcome.scenario:<32} {outcome.moment:<12} {outcome.seconds:6.1f} s  {verdict}", flush=True)

    def count(self, scenario: str) -> int:
        """How many faults of a scenario there were."""
        return sum(outcome["scenario"] == scenario for outcome in self.all)

    @property
    def num_bad(self) -> int:
        """How many left a problem."""
        return sum(bool(outcome["problems"]) for outcome in self.all)

    def table(self) -> str:
        """In Markdown, a row for each scenario and moment."""
        groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
        for outcome in self.all:
            groups[outcome["scenario"], outcome["moment"]].append(outcome)
        rows = [
            "| fault | moment | count | without a problem | iterations trained again, at most |",
            "|---|---|---|---|---|",
        ]
        for (scenario, moment), outcomes in sorted(groups.items()):
            good = sum(not outcome["problems"] for outcome in outcomes)
            again = [outcome["recomputed"] for outcome in outcomes if outcome["recomputed"] is not None]
            rows.append(f"| {scenario} | {moment} | {len(outcomes)} | {good} | {max(again) if again else '-'} |")
        return "\n".join(rows)
