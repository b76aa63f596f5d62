"""Set the environment variables of Ray and Ray Tune; this module imports neither."""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

_TRIAL_CLEANUP_S = 5
_ENVIRONMENT = {
    # The driver has its own signal handler, which lets trials save a checkpoint first.
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_FORCE_TRIAL_CLEANUP_S": str(_TRIAL_CLEANUP_S),
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    # Tune's state is never read back, so saving it every ten seconds would be a waste.
    "TUNE_GLOBAL_CHECKPOINT_S": "3600",
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
}
# Read by a Ray that is started here, unless the user says otherwise. By Ray's own default of 15 its processes get 3 %
# of a core beside anything else that runs there.
_NICENESS = "RAY_worker_niceness", "0"
# Set as a Ray is started, see `local_ray`.
_USAGE = "RAY_USAGE_STATS_ENABLED"


def prepare_environment() -> None:
    """Set the variables that Ray and Ray Tune read; call it before Ray starts, so that its workers inherit them."""
    os.environ.update(_ENVIRONMENT)
    os.environ.setdefault(*_NICENESS)


@contextlib.contextmanager
def variables_for_start() -> Iterator[None]:
    """Let a Ray that is started in the block have a sweep's niceness, and give back the variables that say so.

    Its token stays, which other processes need to join it.
    """
    names = {_NICENESS[0], _USAGE} - os.environ.keys()
    os.environ.setdefault(*_NICENESS)
    try:
        yield
    finally:
        for name in names:
            os.environ.pop(name, None)


def provide_token() -> None:
    """Give a Ray that is started here a token if it could not store one; call it before Ray starts.

    Ray 2.60 stores one in `~/.ray`, and fails if the home folder can't be written or does not exist, as in many
    containers.
    """
    if any(os.environ.get(name) for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")):
        return
    try:
        folder = Path.home() / ".ray"
        if os.access(folder / "auth_token", os.R_OK):
            return
        folder.mkdir(parents=True, exist_ok=True)
        can_write = os.access(folder, os.W_OK)
    except (OSError, RuntimeError):
        can_write = False
    if not can_write:
        os.environ["RAY_AUTH_TOKEN"] = _own_token()


@functools.cache
def _own_token() -> str:
    """Return one token for all sweeps of this process, because Ray reads a token only once."""
    return secrets.token_hex(32)
