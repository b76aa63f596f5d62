"""What changed of a user's own code since a sweep began: its environment's spaces, and the commit of its repository.

A sweep's trials are compared with each other, so those that come later are to train in the same environment.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from analysis.records import SweepRecord, TrialRecord
from policies.errors import CannotRunError

if TYPE_CHECKING:
    import gymnasium as gym

    from policies.envs.make import EnvInfo

_SHORT = 12
"""Characters of a commit that are told, as many as tell it from others."""


def git_commit() -> str | None:
    """Return the commit of the working directory's repository, which tells the version of a user's own code."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"],  # noqa: S607 (the user's git)
            capture_output=True, text=True, timeout=5, check=False,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def notes_on_commit(record: SweepRecord) -> tuple[str, ...]:
    """Return the note on a sweep of a user's own code that is at another commit now; empty if it is not known to be."""
    if not record.allowed_modules or record.git_commit is None:
        return ()
    here = git_commit()
    if here is None or here == record.git_commit:
        return ()
    note = (
        f"The sweep was begun at commit {record.git_commit[:_SHORT]}, and the working directory is at {here[:_SHORT]} "
        f"now: what is left of it trains with {', '.join(record.allowed_modules)} as that is now. If what trials see "
        "or are rewarded for changed, they are not to be compared with those that ended before."
    )
    return (note,)


def spaces_of(env: EnvInfo) -> dict[str, str]:
    """Return the shapes of an environment's observations and actions, in words.

    Bounds and formats are left out: libraries change how these are written, and one may well be corrected.
    """
    return {"observations": _shape(env.observation_space), "actions": _shape(env.action_space)}


def _shape(space: gym.Space[Any]) -> str:
    numbers = getattr(space, "n", getattr(space, "nvec", None))
    return f"shape {space.shape}" if numbers is None else f"{numbers} choices"


def check_same_spaces(record: SweepRecord, trials: Iterable[TrialRecord], env: EnvInfo) -> None:
    """Check that an environment observes and takes what the trained trials of a sweep did.

    Args:
        record: The sweep's record.
        trials: Its trials.
        env: Its environment, as it is now.

    Raises:
        CannotRunError: It does not, as its code was changed.
    """
    # Where none has trained, what was wrong with the environment may have been mended since.
    if not any(trial.num_iterations for trial in trials):
        return
    other = [
        f"its {name} are of {now}, and were of {before}"
        for name, now in spaces_of(env).items()
        if (before := record.env_spaces.get(name, now)) != now
    ]
    if other:
        raise CannotRunError(
            f"{env.env_id} is not the environment that the trials of sweep {record.name} trained in: "
            f"{'; '.join(other)}.",
            "Go on with the code that they trained with, or launch a new sweep.",
        )
