"""How often the live table of a sweep is drawn, which the trials' driver does in its own process."""

import io
import types
from typing import Any

import pytest
from fake_engine import FakeClock
from rich.console import Console, RenderableType
from test_monitor import make_monitor, make_trial

from tune_jobs.sweeps import live_view
from tune_jobs.sweeps.live_view import _Screen
from tune_jobs.sweeps.monitor import SweepMonitor


class Drawn:
    """A table of so many seconds, and how often it was drawn."""

    def __init__(self, monitor: SweepMonitor, clock: FakeClock) -> None:
        self.monitor, self.screen, self.clock = monitor, _Screen(monitor), clock
        self.takes_s = 0.0
        self.count = 0

    def render(self, *_: object) -> RenderableType:
        self.clock.now += self.takes_s
        self.count += 1
        return f"table {self.count}"

    def looked_at(self, width: int = 80, height: int = 24) -> str:
        console = Console(file=io.StringIO(), width=width, height=height)
        console.print(self.screen)
        return str(console.file.getvalue().strip())  # type: ignore[attr-defined]

    def for_seconds(self, seconds: float) -> int:
        """Look at it four times a second; return how often it was drawn."""
        before, until = self.count, self.clock.now + seconds
        while self.clock.now < until:
            self.clock.now += 0.25
            self.looked_at()
        return self.count - before


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    clock = FakeClock()
    found = Drawn(make_monitor(make_trial(0)), clock)
    monkeypatch.setattr(live_view, "render", found.render)
    monkeypatch.setattr(live_view, "time", types.SimpleNamespace(monotonic=clock))
    return found


@pytest.mark.parametrize(("takes_s", "most"), [(0.1, 0.1), (0.2, 0.1), (1.0, 0.27)])
def test_a_table_that_takes_long_is_drawn_rarely(drawn: Drawn, takes_s: float, most: float) -> None:
    drawn.takes_s = takes_s
    times = drawn.for_seconds(60)
    assert 5 <= times <= most * 60 / takes_s


def test_a_table_that_takes_no_time_is_drawn_each_time(drawn: Drawn) -> None:
    drawn.takes_s = 0.01
    assert drawn.for_seconds(10) >= 38


def test_it_is_never_older_than_a_few_seconds(drawn: Drawn) -> None:
    drawn.takes_s = 60.0
    drawn.looked_at()
    drawn.takes_s = 0.0
    drawn.clock.now += 3.1
    assert drawn.looked_at() == "table 2"


@pytest.mark.parametrize("change", ["stopping", "is_over", "width", "height"])
def test_another_size_a_stop_and_the_end_are_drawn_at_once(drawn: Drawn, change: str) -> None:
    drawn.takes_s = 1.0
    assert [drawn.looked_at(), drawn.looked_at()] == ["table 1", "table 1"]
    size: dict[str, Any] = {change: 50} if change in ("width", "height") else {}
    if not size:
        setattr(drawn.monitor, change, True)
    assert drawn.looked_at(**size) == "table 2"


def test_what_is_left_at_the_end_is_the_newest(drawn: Drawn) -> None:
    drawn.takes_s = 1.0
    drawn.monitor.end()
    assert [drawn.looked_at(), drawn.looked_at()] == ["table 1", "table 2"]
