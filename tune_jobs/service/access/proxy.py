"""Who really asks, where a proxy stands before the service."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping, MutableMapping
from typing import Any

from tune_jobs.service.config import LOOPBACK, is_loopback

_FORWARDING = (b"forwarded", b"x-forwarded-for", b"x-forwarded-host", b"x-forwarded-proto", b"x-real-ip", b"via")


class Proxy:
    """What is believed of headers that a proxy writes.

    Args:
        address: The proxy's address; `loopback`: any of this machine; None: there is no proxy.
    """

    def __init__(self, address: str | None) -> None:
        self._address = address

    def resolve(self, scope: MutableMapping[str, Any], headers: Mapping[bytes, list[bytes]]) -> None:
        """Put the client's address and the scheme that it used into a scope, if the proxy asks."""
        client = scope.get("client")
        if client is None or not self._is_proxy(client[0]):
            return
        # Of a list, the proxy itself has written the last; those before it may be the client's invention.
        address = _plain_address(_last(headers.get(b"x-forwarded-for", [])))
        if address is not None:
            scope["client"] = (address, 0)
        scheme = _last(headers.get(b"x-forwarded-proto", [])).lower()
        if scheme in ("http", "https"):
            scope["scheme"] = {"http": "ws", "https": "wss"}[scheme] if scope["type"] == "websocket" else scheme

    def _is_proxy(self, address: str) -> bool:
        if self._address is None:
            return False
        if self._address == LOOPBACK:
            return is_loopback(_plain_address(address) or address)
        return _plain_address(address) == _plain_address(self._address)


def is_forwarded(headers: Mapping[bytes, list[bytes]]) -> bool:
    """Whether a proxy has passed a request on, by what proxies usually write."""
    return any(name in headers for name in _FORWARDING)


def _last(values: list[bytes]) -> str:
    return values[-1].decode("latin-1").rpartition(",")[2].strip() if values else ""


def _plain_address(text: str) -> str | None:
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)
