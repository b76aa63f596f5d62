"""What may go wrong where a service is asked, as the errors that the same would raise on this machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from policies import errors
from policies.errors import CannotRunError, NotFoundError, SpecError, TuneJobsError, said_by

if TYPE_CHECKING:
    import httpx2

PROBLEM = "application/problem+json"
_SHOWN = 60
_SOON_S = 30
"""Seconds after which a service says that it is to be asked again, where what is wrong may pass by itself."""
_NOTHING_THERE = ("There is nothing at this path.", "Not Found")
"""What is answered where there is no such route; a sweep that is not there is told in other words."""


class NoServiceError(CannotRunError):
    """Nothing answers at the address, or what does is no service of tune-jobs."""


class UnavailableError(NoServiceError):
    """The service is there, and can't answer just now, such as while its database is started again."""


class LostConnectionError(CannotRunError):
    """The connection was lost before the whole answer was there."""


class TooManyError(CannotRunError):
    """As many ask for it as may, such as those that watch sweeps, or this address has asked too often."""


class ConflictError(CannotRunError):
    """It contradicts what the sweep does just now, such as resuming one that runs."""


_BY_STATUS: dict[int, type[TuneJobsError]] = {
    404: NotFoundError, 409: ConflictError, 422: SpecError, 429: TooManyError, 500: TuneJobsError,
}  # fmt: skip


def unreachable(url: str, error: Exception, ca_file: str | Path | None = None) -> NoServiceError:
    """Return the error for a service that can't be reached.

    Args:
        url: The service's address.
        error: What came of the attempt.
        ca_file: The certificates that are trusted; None: this machine's.
    """
    why = said_by(error) or type(error).__name__
    if "CERTIFICATE_VERIFY_FAILED" in why:
        return NoServiceError(f"The service at {url} can't be trusted: {why}.", _how_to_trust(why, ca_file))
    if "SSL" in why or "WRONG_VERSION_NUMBER" in why:
        hint = f"Does it speak TLS? If not, write http://{url.partition('://')[2]}."
    else:
        hint = "Check the address and its port, and that `tune-jobs serve` runs there."
    return NoServiceError(f"The service at {url} can't be reached: {why}.", hint)


def _how_to_trust(why: str, ca_file: str | Path | None) -> str:
    """Return what to do where a certificate was refused; another authority helps only if that is what is missing."""
    if "mismatch" in why:
        return "Give the address with a name that the service's certificate has."
    if "expired" in why or "not yet valid" in why:
        return "The service's operator has to renew its certificate; check this machine's clock, too."
    if ca_file is not None:
        return f"No certificate in {ca_file} is of the authority that has signed the service's: give that one's file."
    return "If its certificate is of an authority of your own, give that one's by --ca-file (in Python ca_file=)."


def media_type_of(answer: httpx2.Response) -> str:
    """Return the media type of an answer, without its parameters; empty: it has none."""
    return answer.headers.get("content-type", "").partition(";")[0].strip().lower()


def not_a_service(url: str, answer: httpx2.Response, body: bytes | None = None) -> NoServiceError:
    """Return the error for an answer that is not a service's.

    Args:
        url: The service's address.
        answer: The answer.
        body: A part of its body; None: it was read to its end.
    """
    status, media_type = answer.status_code, media_type_of(answer)
    beginning = " ".join((answer.content if body is None else body)[:400].decode("utf-8", "replace").split())[:_SHOWN]
    told = f", {beginning!r}" if beginning else ""
    if status in (502, 503, 504):
        return NoServiceError(
            f"A proxy answers at {url} in the place of the service, with status {status}{told}.",
            "Check that `tune-jobs serve` runs behind it, and try again.",
        )
    return NoServiceError(
        f"What answers at {url} is no service of tune-jobs: status {status}, {media_type or 'no media type'}{told}.",
        "Check the address and its port. A service says so at its /healthz.",
    )


def redirected(url: str, status: int, location: str) -> NoServiceError:
    """Return the error for a service that is elsewhere; a token is not carried there."""
    parts = urlsplit(location)
    to = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}" if parts.scheme and parts.netloc else "another path"
    return NoServiceError(
        f"{url} sends on to {to} (status {status}); a token is sent nowhere but to the address that is given.",
        "Give the address of the service itself.",
    )


def refusal(url: str, asked: str, answer: httpx2.Response) -> TuneJobsError:
    """Return the error for an answer that is a refusal.

    Args:
        url: The service's address.
        asked: What was asked for: method and path.
        answer: The answer, whose status is 300 or more; a service writes a problem document (RFC 9457).
    """
    status = answer.status_code
    if 300 <= status < 400:
        return redirected(url, status, answer.headers.get("location", ""))
    told = _document(answer)
    if told is None:
        return not_a_service(url, answer)
    message, hint = str(told["detail"]), str(told.get("hint") or "")
    if status == 405 or (status == 404 and message in _NOTHING_THERE):
        return CannotRunError(
            f"The service at {url} does not know {asked}.",
            f"It is of another version than this tune-jobs ({_own_version()}): update the older one of the two.",
        )
    if status == 401:
        return CannotRunError(
            f"The service at {url} lets nobody in without a valid token: {message}",
            "Set TUNE_JOBS_TOKEN, or give --token-file (in Python token=); an admin of the service makes one with "
            "`tune-jobs token make`.",
        )
    if status == 429 and not hint:
        wait = answer.headers.get("retry-after", "")
        hint = f"Try again in {wait} s." if wait.isdecimal() else "Try again later."
    if status == 503 and _is_soon(answer.headers.get("retry-after", "")):
        return UnavailableError(message, hint)
    return _kind(status, told.get("error"))(message, hint)


def _is_soon(retry_after: str) -> bool:
    return retry_after.isdecimal() and int(retry_after) <= _SOON_S


def _kind(status: int, name: object) -> type[TuneJobsError]:
    """Return the kind of an error: the one that the service names, else the one that the status stands for."""
    named = getattr(errors, name, None) if isinstance(name, str) else None
    if isinstance(named, type) and issubclass(named, TuneJobsError) and named is not TuneJobsError:
        return named
    return _BY_STATUS.get(status, CannotRunError)


def _document(answer: httpx2.Response) -> Mapping[str, Any] | None:
    if media_type_of(answer) != PROBLEM:
        return None
    try:
        found = json.loads(answer.content)
    except ValueError:
        return None
    return found if isinstance(found, dict) and isinstance(found.get("detail"), str) else None


def _own_version() -> str:
    try:
        return version("tune-jobs")
    except PackageNotFoundError:
        return "not installed"
