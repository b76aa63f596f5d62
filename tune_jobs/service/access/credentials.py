"""What a request shows to come in: a token in its header, or the page's cookie."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import SimpleCookie
from typing import Any

CHALLENGE = 'Bearer realm="tune-jobs"'
WRONG_TOKEN = f'{CHALLENGE}, error="invalid_token"'


@dataclass(frozen=True)
class Shown:
    """What was shown.

    Args:
        secret: The token; empty: something that can't be one.
        by_cookie: Whether a browser has added it by itself, so that the page of another site may have caused it.
    """

    secret: str
    by_cookie: bool


def cookie_name(port: int, *, is_tls: bool) -> str:
    """Return the name of the page's cookie: browsers keep one jar for all ports of a host.

    With TLS, the prefix keeps sites under the same domain from setting it.
    """
    return f"__Host-tune-jobs-{port}" if is_tls else f"tune-jobs-{port}"


def shown_by(headers: Mapping[bytes, list[bytes]], cookie: str) -> Shown | None:
    """Return what a request shows; None: nothing.

    Args:
        headers: The request's headers.
        cookie: Name of the page's cookie.
    """
    given = headers.get(b"authorization", [])
    if given:
        scheme, _, secret = given[0].decode("latin-1").partition(" ")
        return Shown(secret.strip() if scheme.lower() == "bearer" and len(given) == 1 else "", by_cookie=False)
    for line in headers.get(b"cookie", []):
        for part in line.decode("latin-1").split(";"):
            name, _, value = part.strip().partition("=")
            if name == cookie:
                return Shown(value, by_cookie=True)
    return None


def set_cookie(name: str, secret: str, max_age_s: int, *, is_tls: bool) -> str:
    """Return the header Set-Cookie that gives the page a token; with an age of 0, the one that takes it."""
    made = SimpleCookie()
    made[name] = secret
    attributes: dict[str, Any] = {
        "path": "/", "max-age": str(max_age_s), "httponly": True, "samesite": "Strict", "secure": is_tls,
    }  # fmt: skip
    for attribute, value in attributes.items():
        made[name][attribute] = value
    return made[name].OutputString()
