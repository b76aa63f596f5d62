"""Clients of HTTP with the proxies and certificates that the environment names, or what is wrong with these."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Collection, Iterator
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from policies.errors import CannotRunError, SpecError, TuneJobsError, said_by

if TYPE_CHECKING:
    import httpx2

_PROXY_SCHEMES = ("http", "https", "socks5", "socks5h")


def http_client(url: str, *, ca_hint: str = "", **options: Any) -> httpx2.Client:
    """Return a client for one address, which follows no redirects: nobody has named where these lead.

    Args:
        url: The address.
        ca_hint: How else certificates can be named, for the error; empty: not at all.
        options: Further arguments of `httpx2.Client`.

    Raises:
        SpecError: The certificates can't be read, or a proxy of the environment is none.
        CannotRunError: What a proxy of the environment needs is not installed.
    """
    import httpx2

    try:
        # A proxy of the environment can't reach what runs on this machine.
        return httpx2.Client(follow_redirects=False, trust_env=not is_this_machine(url), **options)
    except OSError as error:
        raise _unread_certificates(error, ca_hint) from error
    except (ImportError, ValueError, httpx2.InvalidURL):
        wrong = next(_wrong_proxies(("http", "https", "all")), None)
        if wrong is None:
            raise
        # Not from the error, whose text may have a part of the proxy's password in it.
        raise wrong from None


def is_this_machine(url: str) -> bool:
    """Whether an address is one of this machine alone, by its text."""
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


def wrong_proxy(url: str) -> TuneJobsError | None:
    """Return the error for the proxy by which an address is asked; None: there is none, or it can be used.

    Args:
        url: The address that is asked.
    """
    from urllib.request import proxy_bypass

    parts = urlsplit(url)
    if is_this_machine(url) or proxy_bypass(parts.netloc.rpartition("@")[2]):
        return None
    return next(_wrong_proxies((parts.scheme, "all")), None)


def _wrong_proxies(kinds: Collection[str]) -> Iterator[TuneJobsError]:
    """Yield an error for each proxy of the environment that can't be used.

    Of its address nothing is shown but a scheme that isn't known: the rest may have a password in it.

    Args:
        kinds: Of what they are: http, https, all.
    """
    from urllib.request import getproxies_environment

    for kind, text in getproxies_environment().items():
        if kind not in kinds:
            continue
        name = f"{kind}_proxy" if f"{kind}_proxy" in os.environ else f"{kind.upper()}_PROXY"
        proxy = text if "://" in text else f"http://{text}"
        scheme = proxy.partition("://")[0].lower()
        hint = f"Have {name} name one as http://HOST:PORT, or unset it."
        if scheme.isalnum() and scheme not in _PROXY_SCHEMES:
            yield SpecError(
                f"The proxy that {name} names has the scheme {scheme}; known are {', '.join(_PROXY_SCHEMES)}.", hint
            )
        elif not _has_host(proxy):
            yield SpecError(
                f"The proxy that {name} names has no address of a host and port (not shown: it may hold a password).",
                hint,
            )
        elif scheme.startswith("socks") and find_spec("socksio") is None:
            yield CannotRunError(
                f"The proxy that {name} names speaks SOCKS, which needs socksio, and that is not installed.",
                f"Install it with `pip install socksio`, or: {hint[0].lower()}{hint[1:]}",
            )


def _has_host(proxy: str) -> bool:
    import httpx2

    try:
        host = httpx2.Proxy(proxy).url.host
        # A name that the DNS can't hold, such as a..b, raises.
        return bool(host.encode("idna"))
    except (ValueError, httpx2.InvalidURL):
        return False


def _unread_certificates(error: OSError, ca_hint: str) -> SpecError:
    """Return the error for certificates that this machine trusts and that can't be read."""
    why = error.strerror or said_by(error)
    name = next((name for name in ("SSL_CERT_FILE", "SSL_CERT_DIR") if os.environ.get(name)), None)
    if name is None:
        hint = ca_hint or "install the certificates that this machine is to trust"
        return SpecError(
            f"The certificates that this machine trusts can't be read: {why}.", f"{hint[0].upper()}{hint[1:]}."
        )
    return SpecError(
        f"The certificates that {name} names, in {os.environ[name]}, can't be read: {why}.",
        f"Have {name} name certificates, PEM, or unset it{f'; or {ca_hint}' if ca_hint else ''}.",
    )
