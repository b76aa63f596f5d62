"""Say why an object store did not do something, whether that may pass, and what to do about it; never a secret.

What obstore raises holds the request and the server's whole answer. Of these only the status, the server's code and
message, and what happened to the connection are told.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass

_CODE, _MESSAGE = re.compile(r"<Code>([^<]{1,80})</Code>"), re.compile(r"<Message>([^<]{1,300})</Message>")
_STATUS = re.compile(r"status code: (\d{3})[^:\n]{0,40}")
MISSING_BUCKET = ("NoSuchBucket", "ContainerNotFound", "The specified bucket does not exist")
"""What S3, Azure and Google say of a bucket that does not exist."""
NO_STORE = (
    "what answers there is no object store",
    "Correct the endpoint in the storage's address: its host and its port.",
)
"""Why nothing can be done with what is no object store, and what to do."""
_PASSING_CODES = ("RequestTimeout", "OperationAborted", "ConditionalRequestConflict", "SlowDown")
_EXPIRED = ("ExpiredToken", "TokenRefreshRequired", "InvalidToken", "ExpiredTokenException", "RequestExpired")
_REGION = ("PermanentRedirect", "AuthorizationHeaderMalformed", "IllegalLocationConstraintException")
_REGION_TOLD = re.compile(r"(?:<Region>|expecting ')([a-z0-9-]{2,40})(?:</Region>|')")
_CONNECTIONS = {
    "ConnectionRefused|Connection refused": "the connection was refused",
    "TimedOut|timed out": "there was no answer in time",
    "dns error|failed to lookup address": "the host's name is not known",
    "IncompleteMessage|IncompleteBody|UnexpectedEof|ConnectionReset|BrokenPipe|body error|connection closed": (
        "the connection was closed before the whole answer came"
    ),
    "NetworkUnreachable|HostUnreachable": "there is no way to the host",
}
# Variables with a secret of any store: the id of a key, a secret, a token.
_SECRET_NAMES = re.compile(r"(AWS|AZURE|GOOGLE|GCP|GCS|MINIO|S3)_.*(KEY|SECRET|TOKEN|PASSWORD|CREDENTIAL|SAS)")
_SIGNATURE = re.compile(r"(?i)\b(signature|x-amz-[a-z-]+|credential|sig)=[^\s&,;\"]+")
_VARIABLES = {
    "s3": "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    "gs": "GOOGLE_SERVICE_ACCOUNT",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY",
}


@dataclass(frozen=True)
class Reason:
    """Why something was not done."""

    text: str
    """Without a full stop."""
    passes: bool
    """Whether another try may do it."""
    hint: str
    """What to do."""


def reason_of(error: Exception, place: str) -> Reason:
    """Return the reason for what obstore raised.

    Args:
        error: What it raised.
        place: The store's address, for the hint.
    """
    text = str(error)
    found, status, said = _CODE.search(text), _STATUS.search(text), _MESSAGE.search(text)
    code, number = found[1] if found else "", int(status[1]) if status else 0
    reach = f"Check that {place} is reached from this machine, and try again."
    if found is not None or status is not None:
        parts = [status[0].rstrip() if status else "", code, _first_line(said[1]) if said else ""]
        passes = number >= 500 or number in (408, 429) or code in _PASSING_CODES
        why, hint = ", ".join(part for part in parts if part), _hint(number, code, text, place) or reach
    elif "Header missing from response" in text:
        # A web server's page, say: an object has a tag and a length.
        why, passes, hint = NO_STORE[0], False, NO_STORE[1]
    elif "redirect without LOCATION" in text:
        why, passes, hint = "the store sends to another place (status code: 301)", False, _hint(301, "", text, place)
    elif "invalid path" in text:
        why, passes, hint = _first_line(text), False, f"Remove that object from {place}: it is none of a sweep's."
    elif "certificate" in text.lower() or "InvalidContentType" in text:
        why, passes = "there is no TLS connection, or the store's certificate is not trusted", False
        hint = "Check the endpoint: whether it begins with http or https, and whether its certificate is known here."
    elif "169.254." in text or "metadata" in text.lower():
        # Without any in the environment, obstore asks the machine for those of its role.
        why, passes, hint = "there are no credentials", True, _credentials(place)
    else:
        happened = (reason for pattern, reason in _CONNECTIONS.items() if re.search(pattern, text))
        why, passes, hint = next(happened, None) or _first_line(text), True, reach
    return Reason(_without_secrets(why), passes=passes, hint=hint)


def _credentials(place: str) -> str:
    return (
        f"Check the credentials in this process's environment ({_VARIABLES[place.partition(':')[0]]}, say) or its "
        "machine's role, and what they allow."
    )


def _hint(status: int, code: str, text: str, place: str) -> str:
    if any(said in text for said in MISSING_BUCKET):
        return "Make the bucket, or correct its name in the storage's address."
    if code in _EXPIRED:
        return (
            "The session token of this process's credentials has expired or is not valid: get new ones "
            "(AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_SESSION_TOKEN, say), or let the machine's role give "
            "them, and resume the sweep."
        )
    if code == "RequestTimeTooSkewed":
        return "Set this machine's clock: it differs from the store's by more than that allows."
    if status == 301 or code in _REGION:
        return _region_hint(text, place)
    if status in (401, 403) or (status == 400 and not code):
        return _credentials(place)
    return ""


def _region_hint(text: str, place: str) -> str:
    told, hint = _REGION_TOLD.search(text), "The bucket is in another region: add ?region={} to the storage's address."
    if told is not None:
        return hint.format(told[1])
    # AWS says it in a header of its redirect, which obstore 0.12 does not hand on.
    bucket = place.partition("://")[2].partition("/")[0]
    look = f" At AWS, `curl -sI https://{bucket}.s3.amazonaws.com` tells it: x-amz-bucket-region."
    return hint.format("REGION") + (look if place.startswith("s3://") else "")


def _first_line(text: str) -> str:
    first = text.strip().splitlines()[0] if text.strip() else "no reason was given"
    return re.sub(r"https?://\S+", "the store", first)[:300].rstrip(".")


def _without_secrets(text: str) -> str:
    """Return a text without this process's credentials, which some servers answer with."""
    secrets = {value for name, value in os.environ.items() if _SECRET_NAMES.match(name) and len(value) >= 8}
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, "***")
    return _SIGNATURE.sub(r"\1=***", text)
