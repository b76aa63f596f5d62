"""RLlib's connectors, made in a test, look no source files up."""

import inspect
import sys
from collections.abc import Iterator
from types import FrameType

import pytest


def _frames(context: int = 1) -> list[inspect.FrameInfo]:
    """Return what `inspect.stack` returns, without the lines of source code around each call."""
    frames = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        frames.append(inspect.FrameInfo(frame, code.co_filename, frame.f_lineno, code.co_name, None, None))
        frame = frame.f_back
    return frames


@pytest.fixture(scope="session", autouse=True)
def _no_source_is_looked_up() -> Iterator[None]:
    """Ray 2.60's `ConnectorV2.__init__` asks for the frame of its caller, and gets the source of all frames read.

    From a test, under sixty frames of pytest's, that takes half a second for each Algorithm (50 ms in a trial of a
    sweep), a quarter of what tests of RLlib take.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inspect, "stack", _frames)
        yield
