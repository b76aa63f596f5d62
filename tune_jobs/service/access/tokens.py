"""Tokens: who may come in. The database has their SHA-256, never the tokens."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import re
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

from sqlalchemy import Engine, func, insert, or_, select, update
from sqlalchemy.exc import SQLAlchemyError

from policies.errors import NotFoundError, SpecError
from tune_jobs.service.access.callers import LOCAL, Caller, Role
from tune_jobs.service.database.tables import tokens

PREFIX = "tune-jobs"
"""What tokens begin with, so that scanners for leaked secrets know them."""
FRESH_S = 2.0
"""How long a token is believed before the database is asked again: a revocation takes effect within this time."""
MAX_DAYS = 36_500
_USED_S = 60.0
"""How exactly the last use of a token is known."""
_DAY_S = 86_400.0
_NAME = re.compile(r"\w[\w.@+-]{0,99}")
_FORM = re.compile(rf"{PREFIX}_([0-9a-f]{{8}})_[A-Za-z0-9_-]{{43}}")
_NOBODY = "0" * 64

State = Literal["valid", "expired", "revoked"]


@dataclass(frozen=True)
class Token:
    """What is known of a token; times are seconds since 1970."""

    id: str
    name: str
    role: Role
    created_at: float
    expires_at: float | None
    revoked_at: float | None
    last_used_at: float | None

    def state(self, now: float) -> State:
        """Whether it opens anything at a time, in seconds since 1970."""
        if self.revoked_at is not None:
            return "revoked"
        return "expired" if self.expires_at is not None and self.expires_at <= now else "valid"

    @property
    def caller(self) -> Caller:
        """Who shows it."""
        return Caller(self.name, self.role, self.id)


class Tokens:
    """The tokens in a database; threads may share one.

    Args:
        engine: The database.
        now: Returns the time in seconds since 1970.
    """

    def __init__(self, engine: Engine, now: Callable[[], float] = time.time) -> None:
        self._engine, self.now = engine, now
        self._known: dict[str, tuple[Token, float]] = {}
        self._lock = threading.Lock()

    def make(self, name: str, role: Role, days: float = 365.0) -> tuple[Token, str]:
        """Make a token, and return it with its secret, which can't be had again.

        Args:
            name: Whose it is: the owner of what is submitted with it. Several tokens may have one name.
            role: What it allows.
            days: How long it is valid.

        Raises:
            SpecError: The name is not allowed, or the time is none.
        """
        if not _NAME.fullmatch(name) or name == LOCAL.name:
            raise SpecError(
                f"{name[:120]!r} can't be the name of a token"
                + (f": {LOCAL.name!r} is who needs none." if name == LOCAL.name else "."),
                "Give a name of at most 100 letters, digits and . _ @ + -, such as a user's name.",
            )
        if not 0 < days <= MAX_DAYS:
            raise SpecError(f"A token can't be valid for {days:g} days; choose more than 0 and at most {MAX_DAYS:,}.")
        made_at = self.now()
        token = Token(secrets.token_hex(4), name, role, made_at, made_at + days * _DAY_S, None, None)
        secret = f"{PREFIX}_{token.id}_{secrets.token_urlsafe(32)}"
        with self._engine.begin() as connection:
            connection.execute(insert(tokens).values(vars(token) | {"digest": _digest(secret)}))
        return token, secret

    def all(self) -> list[Token]:
        """Return all tokens, the oldest first, those that are no longer valid among them."""
        with self._engine.begin() as connection:
            rows = connection.execute(select(tokens).order_by(tokens.c.created_at, tokens.c.id)).mappings().all()
        return [_token(row) for row in rows]

    def revoke(self, token_id: str) -> Token:
        """Revoke a token; one that was revoked before stays so.

        Raises:
            NotFoundError: There is no such token.
        """
        with self._engine.begin() as connection:
            connection.execute(
                update(tokens)
                .where(tokens.c.id == token_id, tokens.c.revoked_at.is_(None))
                .values(revoked_at=self.now())
            )
            row = connection.execute(select(tokens).where(tokens.c.id == token_id)).mappings().first()
        if row is None:
            raise NotFoundError(f"There is no token {token_id[:80]!r}.", "List their ids with `tune-jobs token list`.")
        with self._lock:
            self._known.clear()
        return _token(row)

    def any_valid(self) -> bool:
        """Whether anybody could come in with a token."""
        usable = tokens.c.revoked_at.is_(None) & or_(tokens.c.expires_at.is_(None), tokens.c.expires_at > self.now())
        with self._engine.begin() as connection:
            return bool(connection.execute(select(func.count()).select_from(tokens).where(usable)).scalar_one())

    def remembered(self, secret: str) -> tuple[Token, bool] | None:
        """Return a token that was found a while ago, and whether that is recent enough to be believed."""
        with self._lock:
            known = self._known.get(_digest(secret))
        return None if known is None else (known[0], 0 <= self.now() - known[1] < FRESH_S)

    def find(self, secret: str) -> Token | None:
        """Return the token of a secret, also if it is no longer valid; None: there is none."""
        form = _FORM.fullmatch(secret)
        if form is None:
            return None
        digest = _digest(secret)
        with self._engine.begin() as connection:
            row = connection.execute(select(tokens).where(tokens.c.id == form[1])).mappings().first()
            # It is looked up by its id, which is no secret, so that the time of a comparison tells nothing.
            matches = hmac.compare_digest(digest, _NOBODY if row is None else row["digest"])
            if row is None or not matches:
                with self._lock:
                    self._known.pop(digest, None)
                return None
        token, now = _token(row), self.now()
        if token.state(now) == "valid" and not 0 <= now - (token.last_used_at or 0.0) < _USED_S:
            self._note_use(token, now)
        with self._lock:
            self._known[digest] = (token, now)
        return token

    def _note_use(self, token: Token, now: float) -> None:
        # With a full disk nothing can be noted, and people have to get in to make room.
        with contextlib.suppress(SQLAlchemyError), self._engine.begin() as connection:
            connection.execute(update(tokens).where(tokens.c.id == token.id).values(last_used_at=now))


def _digest(secret: str) -> str:
    # A token is random, unlike a password: nothing slower is needed.
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def _token(row: Mapping[Any, Any]) -> Token:
    return Token(
        id=row["id"],
        name=row["name"],
        role=cast("Role", row["role"]),
        created_at=row["created_at"],
        expires_at=row["expires_at"],
        revoked_at=row["revoked_at"],
        last_used_at=row["last_used_at"],
    )
