"""The service's log: lines of text, or one JSON object a line. Secrets are taken out of both.

What a line is about is in fields of its own: of the request that is being answered, of this process, and what the call
gives as `extra`.
"""

from __future__ import annotations

import json
import logging
import re
import sys
import threading
from collections.abc import Iterable, Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any, Literal, Protocol

LogFormat = Literal["text", "json"]

ACCESS = "tune_jobs.access"
"""The logger of requests; it says nothing in the text format, which people read."""
FIELDS = (
    "request_id", "method", "route", "status", "duration_s", "caller", "process", "sweep", "trial", "job", "owner",
)  # fmt: skip
"""What a line may say besides its message, in this order."""
HIDDEN = "***"

_TEXT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_TOKEN = re.compile(r"(tune-jobs_[0-9a-f]{8}_)[A-Za-z0-9_-]{8,}")
_USERINFO = re.compile(r"(://)[^\s/]*@")
_SHORTEST = 4
"""Of a secret, in characters: to take out each `a` would leave nothing that can be read."""
_log = logging.getLogger(__name__)


class Described(Protocol):
    """Something that lines of the log are about."""

    def log_fields(self) -> Mapping[str, Any]:
        """Return what is known of it by now, by the names of `FIELDS`."""
        ...


answering: ContextVar[Described | None] = ContextVar("answering", default=None)
"""The request that is being answered."""


def configure(
    log_format: LogFormat,
    *,
    secrets: Iterable[str] = (),
    process: Mapping[str, Any] | None = None,
    level: int = logging.INFO,
    anew: bool = False,
) -> None:
    """Write the log of this process to standard error, unless something else was configured before.

    Args:
        log_format: The format.
        secrets: Texts that never appear in it, besides tokens and what URLs have before an `@`.
        process: Fields of every line.
        level: The least level.
        anew: Whether it replaces what was configured before.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter(log_format, secrets=secrets, process=process))
    logging.basicConfig(handlers=[handler], level=level, force=anew)
    logging.getLogger(ACCESS).setLevel(logging.NOTSET if log_format == "json" else logging.WARNING)
    logging.captureWarnings(log_format == "json")
    threading.excepthook = _log_thread if log_format == "json" else threading.__excepthook__


def formatter(
    log_format: LogFormat, *, secrets: Iterable[str] = (), process: Mapping[str, Any] | None = None
) -> logging.Formatter:
    """Return what makes lines of records; the arguments are those of `configure`."""
    made = _JsonFormatter if log_format == "json" else _TextFormatter
    return made(Redaction(secrets), process or {})


class Redaction:
    """Takes secrets out of texts: tokens, what URLs have before an `@`, and those that are named.

    Args:
        secrets: The texts that are named.
    """

    def __init__(self, secrets: Iterable[str] = ()) -> None:
        # One may be a part of another.
        known = sorted({secret for secret in secrets if len(secret) >= _SHORTEST}, key=len, reverse=True)
        self._known = re.compile("|".join(map(re.escape, known))) if known else None

    def __call__(self, text: str) -> str:
        """Return a text without secrets."""
        if self._known is not None:
            text = self._known.sub(HIDDEN, text)
        return _USERINFO.sub(rf"\1{HIDDEN}@", _TOKEN.sub(rf"\1{HIDDEN}", text))


class _TextFormatter(logging.Formatter):
    """Lines for people; the message says what it is about, and only what it can't know is added."""

    def __init__(self, redact: Redaction, process: Mapping[str, Any]) -> None:
        super().__init__(_TEXT)
        self._redact, self._process = redact, process

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 (logging's name)
        line = super().formatMessage(record)
        told = dict(self._process)
        request = answering.get()
        if request is not None:
            told["request"] = request.log_fields().get("request_id", "")
        return f"{line} [{', '.join(f'{name} {value}' for name, value in told.items())}]" if told else line

    def format(self, record: logging.LogRecord) -> str:
        return self._redact(super().format(record))


class _JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def __init__(self, redact: Redaction, process: Mapping[str, Any]) -> None:
        super().__init__()
        self._redact, self._process = redact, process

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line: dict[str, Any] = {
            "time": at.replace("+00:00", "Z"), "level": record.levelname, "logger": record.name,
            "message": record.getMessage(),
        }  # fmt: skip
        line |= self._fields(record)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        if record.stack_info:
            line["stack"] = self.formatStack(record.stack_info)
        # In the values, as JSON writes some characters of a secret in another way.
        clean = {name: self._redact(value) if isinstance(value, str) else value for name, value in line.items()}
        return json.dumps(clean, default=str)

    def _fields(self, record: logging.LogRecord) -> dict[str, Any]:
        request = answering.get()
        known = {**self._process, **({} if request is None else request.log_fields())}
        # `process` is a number that each record has.
        known |= {name: getattr(record, name) for name in FIELDS if name != "process" and hasattr(record, name)}
        return {name: known[name] for name in FIELDS if known.get(name) is not None}


def _log_thread(args: threading.ExceptHookArgs) -> None:
    """Log the error that ended a thread, which Python would print."""
    name = "of which nothing is known" if args.thread is None else args.thread.name
    if args.exc_value is not None:
        _log.error("The thread %s ended by an error.", name, exc_info=args.exc_value)
