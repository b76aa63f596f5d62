"""Tell webhooks and a command what happened: a sweep ended, failed, has a new best policy, or is stuck.

What is to be told is in the database before it is sent, so a service that is killed tells it later: each at least once,
perhaps twice. A receiver knows a message that it has by its id.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import hmac
import http.client
import json
import logging
import os
import re
import signal
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from sqlalchemy import Engine, RowMapping, delete, func, insert, or_, select, update

from policies.errors import SpecError, said_by
from tune_jobs.service.database.tables import messages
from tune_jobs.service.outages import Outages

Kind = Literal["webhook", "command"]
Delivery = Literal["arrived", "failed", "given_up"]
Event = Literal["sweep.ended", "sweep.failed", "sweep.stopped", "sweep.best", "sweep.stuck"]

COMMAND = "command:"
"""What a target begins with that is a command, not a URL."""
WAITS_S = (5.0, 30.0, 120.0, 600.0, 3_600.0, 6 * 3_600.0, 12 * 3_600.0)
"""How long to wait after each attempt that failed; after the last one it is given up."""
_ENCODED = "whsec_"
_SHORTEST_PATH = 8
"""Of a path that may be a secret, in characters: `/hook` is a word, and not one."""
_TIMEOUT_S = 15.0
_COMMAND_TIMEOUT_S = 60.0
_KILLED_S = 5.0
"""How long a killed command may take to be gone."""
_READ_BYTES = 2_000
"""Of what a command wrote to its standard error, from the end."""
_AT_ONCE = 100
"""How many messages a target is sent at most before the others have their turn."""
_KEPT_S = 7 * 24 * 3_600.0
_SENDING = "Messages can't be sent"
_log = logging.getLogger(__name__)


def check_target(url: str) -> str:
    """Return the URL of a webhook.

    Raises:
        SpecError: It is not one of http or https.
    """
    if not url.startswith(("http://", "https://")) or len(url) > 2_000:
        raise SpecError(f"{url[:80]!r} is no URL of a webhook.", "Begin it with https:// or http://.")
    try:
        parts = urlsplit(url)
        is_usable = bool(parts.hostname) and parts.port != 0 and url.isascii() and url.isprintable() and " " not in url
    except ValueError:
        is_usable = False
    if not is_usable:
        raise SpecError(
            f"The URL of a webhook at {told_target(url)!r} can't be used.",
            "Give https://HOST/PATH, or https://HOST:PORT/PATH; write other characters as %XX.",
        )
    if parts.username is not None or parts.password is not None:
        raise SpecError(
            f"The URL of a webhook at {parts.hostname!r} has a name or a password before its host, which is not sent.",
            "Leave it out, and let the receiver check `webhook-signature` (TUNE_JOBS_WEBHOOK_SECRET).",
        )
    return url


def check_secret(secret: str) -> str:
    """Return what webhooks are signed with.

    Raises:
        SpecError: It gives no key; what it is, the error does not tell.
    """
    try:
        why = "" if _key_of(secret) else "it is empty"
    except ValueError as error:
        why = said_by(error)
    if why:
        raise SpecError(
            f"The secret of webhooks (--webhook-secret, TUNE_JOBS_WEBHOOK_SECRET) gives no key to sign with: {why}.",
            f"Give it as the receiver shows it: after {_ENCODED} comes base64, up to its last `=`.",
        )
    return secret


def told_target(target: str) -> str:
    """Return what may be told of a target: the path of a URL, and a command's arguments, may be secrets."""
    if target.startswith(COMMAND):
        return f"the command {Path(json.loads(target.removeprefix(COMMAND))[0]).name}"
    scheme, _, rest = target.partition("://")
    return f"{scheme}://{re.split('[/?#]', rest)[0].rpartition('@')[2]}"


def secrets_of(url: str) -> tuple[str, ...]:
    """Return what of a webhook's URL never appears in a log: its path and its query, which say who may send there."""
    rest = url.partition("://")[2]
    path = rest[len(re.split("[/?#]", rest)[0]) :]
    return (path, path.lstrip("/")) if len(path) > _SHORTEST_PATH else ()


def signature(secret: str, message_id: str, timestamp: int, body: str) -> str:
    """Return what the header `webhook-signature` says.

    Args:
        secret: The secret that both sides know; after `whsec_` it is base64.
        message_id: The header `webhook-id`.
        timestamp: The header `webhook-timestamp`, seconds since 1970.
        body: The body.

    Source:
        Standard Webhooks 1.0, "Webhook headers": HMAC-SHA256 of id, timestamp and body with dots between, base64.
    """
    signed = f"{message_id}.{timestamp}.{body}".encode()
    return "v1," + base64.b64encode(hmac.new(_key_of(secret), signed, hashlib.sha256).digest()).decode()


def _key_of(secret: str) -> bytes:
    if not secret.startswith(_ENCODED):
        return secret.encode()
    return base64.b64decode(secret.removeprefix(_ENCODED), validate=True)


class Teller:
    """Sends what is to be told, in a thread.

    Args:
        engine: The database.
        targets: URLs of webhooks, and commands as `command:` and a JSON list.
        secret: What webhooks are signed with; None: they are not.
        on_attempt: Called after each attempt to send.
        now: Returns seconds since 1970.
        outages: Where it is noted that messages can't be read.
    """

    def __init__(
        self,
        engine: Engine,
        targets: Sequence[str],
        *,
        secret: str | None = None,
        on_attempt: Callable[[Kind, Delivery], None] = lambda _kind, _delivery: None,
        now: Callable[[], float] = time.time,
        outages: Outages | None = None,
    ) -> None:
        self._outages = Outages() if outages is None else outages
        self._engine, self._targets, self._secret, self._now = engine, tuple(targets), secret, now
        self._on_attempt = on_attempt
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="telling", daemon=True)

    def start(self) -> None:
        """Begin to send."""
        if self._targets:
            self._thread.start()

    def close(self) -> None:
        """End; what is not yet sent is sent by the next service."""
        self._end.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(_TIMEOUT_S)

    def tell(self, event: Event, body: Mapping[str, Any]) -> None:
        """Note what happened, for each target."""
        if not self._targets:
            return
        now = self._now()
        text = json.dumps({"type": event, "timestamp": now, "data": dict(body)}, sort_keys=True)
        rows = [
            {"id": f"msg_{uuid.uuid4().hex}", "event": event, "target": target, "body": text, "created_at": now,
             "next_at": now, "num_attempts": 0}
            for target in self._targets
        ]  # fmt: skip
        with self._engine.begin() as connection:
            connection.execute(insert(messages), rows)
        self._wake.set()

    def waiting(self) -> int:
        """Return how many messages wait to be sent, those that are tried again among them."""
        if not self._targets:
            return 0
        wanted = messages.c.next_at.is_not(None) & messages.c.target.in_(self._targets)
        with self._engine.begin() as connection:
            return int(connection.execute(select(func.count()).select_from(messages).where(wanted)).scalar_one())

    def _run(self) -> None:
        while not self._end.is_set():
            try:
                self.send_due()
                self._outages.worked(_SENDING)
            except Exception as error:  # noqa: BLE001 (such as a database that is away for a while)
                self._outages.failed(_SENDING, error)
                self._end.wait(5.0)
            self._wake.wait(1.0)
            self._wake.clear()

    def send_due(self) -> int:
        """Send what is due now; return how many arrived."""
        now = self._now()
        with self._engine.begin() as connection:
            done = or_(messages.c.next_at.is_(None), messages.c.target.not_in(self._targets))
            connection.execute(delete(messages).where(done, messages.c.created_at < now - _KEPT_S))
            query = select(messages).where(messages.c.next_at <= now).order_by(messages.c.created_at).limit(_AT_ONCE)
            due = [
                connection.execute(query.where(messages.c.target == target)).mappings().all()
                for target in dict.fromkeys(self._targets)
            ]
        return sum(self._send(rows) for rows in due)

    def _send(self, rows: Sequence[RowMapping]) -> int:
        """Send messages of one target until one does not arrive, or it took long; return how many arrived.

        The others wait for it meanwhile, and a receiver that is dead takes a timeout for each message: what is left is
        due in the next round.
        """
        began, arrived = self._now(), 0
        for row in rows:
            if self._end.is_set() or self._now() - began > _TIMEOUT_S or not self._attempt(row):
                break
            arrived += 1
        return arrived

    def _attempt(self, row: RowMapping) -> bool:
        """Send one message, and note what came of it; return whether it arrived."""
        try:
            error = self._sent(row["id"], row["event"], row["target"], row["body"])
        except Exception as raised:  # noqa: BLE001 (whatever it is, the other messages have to be sent)
            error = f"unexpected {type(raised).__name__}: {said_by(raised)}"[:500]
        attempts = row["num_attempts"] + 1
        wait = None if error is None or attempts > len(WAITS_S) else WAITS_S[attempts - 1]
        delivery: Delivery = "arrived" if error is None else "given_up" if wait is None else "failed"
        self._on_attempt("command" if row["target"].startswith(COMMAND) else "webhook", delivery)
        if error is not None:
            told = (told_target(row["target"]), row["event"], attempts, error)
            _log.warning("%s could not be told %s (attempt %d): %s", *told)
        values = {
            "num_attempts": attempts, "error": error, "next_at": None if wait is None else self._now() + wait,
        }  # fmt: skip
        with self._engine.begin() as connection:
            connection.execute(update(messages).where(messages.c.id == row["id"]).values(values))
        return error is None

    def _sent(self, message_id: str, event: str, target: str, body: str) -> str | None:
        """Send one message; return why it did not arrive, if it did not."""
        if target.startswith(COMMAND):
            return _run_command(json.loads(target.removeprefix(COMMAND)), message_id, event, body)
        timestamp = int(self._now())
        headers = {
            "Content-Type": "application/json", "User-Agent": "tune-jobs",
            "webhook-id": message_id, "webhook-timestamp": str(timestamp),
        }  # fmt: skip
        if self._secret is not None:
            headers["webhook-signature"] = signature(self._secret, message_id, timestamp, body)
        request = urllib.request.Request(target, data=body.encode(), headers=headers, method="POST")  # noqa: S310 (checked)
        try:
            with _opener.open(request, timeout=_TIMEOUT_S) as answer:
                answer.read(1_000)
        except urllib.error.HTTPError as error:
            return f"it answered {error.code}"
        except (OSError, ValueError, http.client.HTTPException) as error:
            return (str(getattr(error, "reason", error)) or type(error).__name__)[:500]
        return None


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """A redirect counts as a failure: the operator named one place, and no other gets what happened."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


_opener = urllib.request.build_opener(_NoRedirects)


def _run_command(command: Sequence[str], message_id: str, event: str, body: str) -> str | None:
    told = {"TUNE_JOBS_MESSAGE_ID": message_id, "TUNE_JOBS_EVENT": event}
    try:
        # No pipes for what it says: they end with the last process that the command began, and may be held for long by
        # one in the background, which is left to run. The command's own exit counts.
        with tempfile.TemporaryFile() as errors:
            process = subprocess.Popen(  # noqa: S603 (the operator's own)
                list(command), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors,
                env=os.environ | told, start_new_session=True,
            )  # fmt: skip
            try:
                process.communicate(body.encode(), _COMMAND_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                _kill_group(process)
                # Its own words have the command's arguments.
                return f"it took longer than {_COMMAND_TIMEOUT_S:g} s"
            errors.seek(max(0, errors.seek(0, os.SEEK_END) - _READ_BYTES))
            said = errors.read().decode("utf-8", "replace").strip()
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)[:500]
    if process.returncode == 0:
        return None
    return f"exit code {process.returncode}" + (f": {said[-300:]}" if said else "")


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """End a command that leads a group of its own, with all of the group: the next attempt is to be alone."""
    # One that has become another user's, as by sudo, may not be ended, and is not waited for.
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        os.killpg(process.pid, signal.SIGKILL)
        process.wait(_KILLED_S)
