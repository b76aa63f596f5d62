"""Where a service is, and what it is asked with: its address, a token, a certificate authority."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit

from policies.errors import SpecError

_EXAMPLE = "Write it as http://127.0.0.1:8470 or https://tune.example.org."
_MOST_BYTES = 10_000


def service_url(text: str) -> str:
    """Return the address of a service, without a slash at its end.

    Raises:
        SpecError: It is none, or holds what is a secret: that would be in histories and logs. It is not shown then.
    """
    text = text.strip()
    if "@" in text:
        raise SpecError(
            "The service's address has a user name or password in it, before the @; it would be seen in lists of "
            "processes, histories and logs.",
            "Leave it out. A token is given by TUNE_JOBS_TOKEN or --token-file (in Python token=).",
        )
    if "?" in text or "#" in text:
        raise SpecError(
            "The service's address has a query or fragment, behind its ? or #; neither belongs there, a token least.",
            _EXAMPLE,
        )
    try:
        parts = urlsplit(text)
        has_port = parts.port is None or parts.port > 0
    except ValueError:
        has_port = False
    if not has_port:
        raise SpecError(f"The service's address {text[:200]!r} has no port that there is.", _EXAMPLE)
    if parts.scheme not in ("http", "https") or not parts.hostname or any(part.isspace() for part in text):
        raise SpecError(f"The service's address {text[:200]!r} does not begin with http:// or https://.", _EXAMPLE)
    return text.rstrip("/")


def token_of(token: str | None, file: str | Path | None) -> str | None:
    """Return the token that was given, or that a file holds; None: none.

    Raises:
        SpecError: Both are given, the file can't be read, or it is no token. No token is ever shown.
    """
    if token is not None and file is not None:
        raise SpecError("A token and a file with a token are given.", "Give one of them.")
    if file is not None:
        try:
            with Path(file).expanduser().open("rb") as stream:
                token = stream.read(_MOST_BYTES).decode("ascii", "replace")
        except (OSError, RuntimeError) as error:
            why = getattr(error, "strerror", None) or error
            raise SpecError(f"The token's file {file} can't be read: {why}.", "Name a file that holds one.") from error
    where = "in its file" if file is not None else "that is given"
    if token is None:
        return None
    token = token.strip()
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise SpecError(
            f"The token {where} is none: it is empty, or has characters that no token has.",
            "Give it as `tune-jobs token make` has printed it, in one line.",
        )
    return token
