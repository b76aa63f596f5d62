"""Which names the service has, and whether a request is meant for it and comes from its own page.

A page of another site can make its own name mean this machine's address (DNS rebinding), and would then be of the
same origin as the service; the header Host still says the name. So a name that the service was not told is refused.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from policies.errors import SpecError
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.config import is_loopback

LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
EVERYWHERE = ("0.0.0.0", "::")  # noqa: S104 - nothing is bound here
_HOST = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(?::(?P<port>[0-9]{1,5}))?", re.IGNORECASE | re.ASCII)
_PORTS = {"http": 80, "https": 443}
_NOT_SAFE = "The request comes from a page of another site"


@dataclass(frozen=True)
class Host:
    """A name and a port, as in the header Host; port None: any."""

    name: str
    port: int | None

    @property
    def is_loopback(self) -> bool:
        """Whether it names the machine that uses it."""
        return is_loopback(self.name.strip("[]"))


def public_host(text: str) -> Host:
    """Return the host of `NAME` or `NAME:PORT`.

    Raises:
        SpecError: It is neither.
    """
    host = _host(text, None)
    if host is None:
        raise SpecError(
            f"{text[:200]!r} is no name of a host.",
            "Give --public-name as in a browser's address bar, without https:// and path: tune.example.org or "
            "tune.example.org:8443; an address of version 6 in [brackets].",
        )
    return host


class ServedNames:
    """The names under which the service is asked for.

    Args:
        address: The address it listens on.
        public: Further names than its own; those without a port count with any.
    """

    def __init__(self, address: str, public: Iterable[Host] = ()) -> None:
        self._is_everywhere = address in EVERYWHERE
        own = None if self._is_everywhere else _host(f"[{address}]" if ":" in address else address, None)
        self._own = {*LOOPBACK_NAMES, *([] if own is None else [own.name])}
        self._public = frozenset(public)

    def check_host(
        self, headers: Mapping[bytes, list[bytes]], scheme: str, server: tuple[str, int | None] | None
    ) -> Host:
        """Return the host that a request is for.

        Args:
            headers: The request's headers.
            scheme: http or https.
            server: The address and the port of this machine that the request came to.

        Raises:
            RefusedError: It is none of the service's.
        """
        given = headers.get(b"host", [])
        host = _host(given[0].decode("latin-1"), _PORTS[scheme]) if len(given) == 1 else None
        if host is None:
            raise RefusedError(400, "The request has no header Host that names one host.")
        address, port = server or ("", None)
        is_own = (host.name in self._own or self._is_address(host, address)) and port in (None, host.port)
        if is_own or host in self._public or Host(host.name, None) in self._public:
            return host
        told = given[0].decode("latin-1")
        raise RefusedError(
            400,
            f"This service is not known as {told[:200]!r}.",
            f"If it should be, start it with --public-name {told[:200]}.",
        )

    def _is_address(self, host: Host, address: str) -> bool:
        # Who listens on all addresses has not told which. A rebound name is a name, never an address.
        if not self._is_everywhere:
            return False
        try:
            return _address(host.name.strip("[]")) == _address(address.partition("%")[0])
        except ValueError:
            return False


def check_origin(headers: Mapping[bytes, list[bytes]], scheme: str, host: Host) -> bool:
    """Check that a request does not come from a page of another site; return whether it surely comes from an own one.

    Raises:
        RefusedError: It comes from one.
    """
    origins = headers.get(b"origin", [])
    if origins:
        told = origins[0].decode("latin-1")
        if len(origins) > 1 or _origin(told) != (scheme, host):
            own = f"{scheme}://{host.name}" + ("" if host.port == _PORTS[scheme] else f":{host.port}")
            raise RefusedError(
                403,
                f"{_NOT_SAFE}: its origin is {told[:200]!r}, and not {own}.",
                "Use the service's own page. Behind a proxy, start the service with --behind-proxy and let the proxy "
                "pass on the headers Host and X-Forwarded-Proto.",
            )
        return True
    return False


def check_fetch_site(headers: Mapping[bytes, list[bytes]], method: str) -> bool:
    """Check what a browser says of who asks; return whether it says that it is the service's own page.

    Another site's page may lead here by a link, and load nothing from here.

    Raises:
        RefusedError: Another site's page asks for more than to be left for this one.
    """
    site = _only(headers, b"sec-fetch-site")
    if site in ("cross-site", "same-site"):
        is_link = _only(headers, b"sec-fetch-mode") == "navigate" and _only(headers, b"sec-fetch-dest") == "document"
        if not (is_link and method == "GET"):
            raise RefusedError(403, f"{_NOT_SAFE}, as the browser says.", "Use the service's own page.")
    return site == "same-origin"


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    address = ipaddress.ip_address(text)
    # So a socket of version 6 says those of version 4: ::ffff:192.168.0.5.
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return mapped or address


def _only(headers: Mapping[bytes, list[bytes]], name: bytes) -> str | None:
    values = headers.get(name, [])
    return values[0].decode("latin-1").lower() if len(values) == 1 else None


def _host(text: str, default_port: int | None) -> Host | None:
    found = _HOST.fullmatch(text)
    if found is None:
        return None
    name, port = found["name"].lower(), found["port"]
    if name.startswith("["):
        try:
            name = f"[{ipaddress.IPv6Address(name[1:-1]).compressed}]"
        except ValueError:
            return None
    if port is not None and not 1 <= int(port) <= 65_535:
        return None
    return Host(name, default_port if port is None else int(port))


def _origin(text: str) -> tuple[str, Host] | None:
    try:
        parts = urlsplit(text)
    except ValueError:
        return None
    if parts.scheme not in _PORTS or parts.path or parts.query or parts.fragment:
        return None
    host = _host(parts.netloc, _PORTS[parts.scheme])
    return None if host is None else (parts.scheme, host)
