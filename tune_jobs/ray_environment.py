"""What Ray and Ray Tune read from the environment; a module of its own, so that setting it imports neither."""

from __future__ import annotations

import os

_TRIAL_CLEANUP_S = 5
_ENVIRONMENT = {
    # The driver has its own handler, which lets trials save a checkpoint first.
    "TUNE_DISABLE_SIGINT_HANDLER": "1",
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_FORCE_TRIAL_CLEANUP_S": str(_TRIAL_CLEANUP_S),
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    # Tune's state is never read back: saving it every ten seconds would only cost.
    "TUNE_GLOBAL_CHECKPOINT_S": "3600",
    "RAY_AIR_NEW_OUTPUT": "0",
    "RAY_CHDIR_TO_TRIAL_DIR": "0",
}


def prepare_environment() -> None:
    """Set what Ray Tune reads from the environment; before Ray starts, so that its workers inherit it."""
    os.environ.update(_ENVIRONMENT)
