"""What the service can't take for the name of a sweep, though it may be that of a folder."""

from __future__ import annotations

from policies.errors import CheckpointError
from tune_jobs.service.database.tables import MOST_LETTERS


def check_text(name: str) -> None:
    """Check that a name can be encoded: Linux takes any bytes for one, and Python makes halves of surrogates of them.

    Raises:
        CheckpointError: It can't.
    """
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise CheckpointError(
            f"The name of the folder {name!a} is no text in UTF-8, so no page can link it.", "Rename the folder."
        ) from error


def check_for_job(name: str) -> None:
    """Check that a sweep of this name can have a job.

    Raises:
        CheckpointError: It can't.
    """
    check_text(name)
    if len(name) > MOST_LETTERS:
        raise CheckpointError(
            f"The name of the folder {name[:40]!a}... has {len(name)} letters, and the queue takes {MOST_LETTERS}.",
            "Rename the folder.",
        )
