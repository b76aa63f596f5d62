"""Keep Ray Tune from showing its own progress in a notebook, in the place of ours."""

from __future__ import annotations

from typing import Any

from ray import tune
from ray.widgets.util import in_notebook


class SilentReporter(tune.ProgressReporter):  # type: ignore[misc]
    """Reports nothing."""

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """Take what Tune tells of the run."""

    def should_report(self, *_: Any, **__: Any) -> bool:
        """Return that there is nothing to report."""
        return False

    def report(self, *_: Any, **__: Any) -> None:
        """Report nothing."""


def reporter() -> SilentReporter | None:
    """Return the reporter for `tune.RunConfig`.

    In notebooks Tune (2.60) takes one that clears the cell's output, whatever `verbose` is. Elsewhere it is silent by
    itself, and warns of a reporter that it is given.
    """
    return SilentReporter() if in_notebook() else None
