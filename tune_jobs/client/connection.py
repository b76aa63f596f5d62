"""Requests to one service: with its token, again where the connection was lost and asking twice does no harm."""

from __future__ import annotations

import contextlib
import json
import logging
import ssl
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policies.errors import CannotRunError, SpecError, said_by
from tune_jobs.client.problems import (
    LostConnectionError,
    NoServiceError,
    media_type_of,
    not_a_service,
    refusal,
    unreachable,
)
from tune_jobs.process.http_client import http_client, is_this_machine, wrong_proxy

if TYPE_CHECKING:
    import httpx2

_log = logging.getLogger(__name__)

CONNECT_S = 10.0
_WAITS_S = (0.2, 0.5, 1.0, 2.0)
"""How long is waited before each further attempt."""
JSON = "application/json"
Query = Mapping[str, str | int | float | bool | Sequence[str] | None]


class Connection:
    """A service that is asked; threads may share one.

    Args:
        url: Its address, as from `service_url`.
        token: The token, None: none.
        ca_file: The certificates of authorities that are trusted, PEM; None: those that this machine trusts.
        timeout_s: How long an answer may take to begin, and to go on.

    Raises:
        SpecError: The certificates can't be read, or a proxy of the environment is none.
        CannotRunError: What a proxy of the environment needs is not installed.
    """

    def __init__(self, url: str, token: str | None, *, ca_file: str | Path | None, timeout_s: float) -> None:
        import httpx2

        self.url = url
        self._timeout_s, self._ca_file = timeout_s, ca_file
        # What was never reached has a wrong address, more likely than it is away for a moment.
        self.has_answered = False
        headers = {"User-Agent": "tune-jobs", "Accept": f"{JSON}, */*;q=0.1"}
        if token is not None:
            headers["Authorization"] = f"Bearer {token}"
            if url.startswith("http:") and not is_this_machine(url):
                _log.warning("The token is sent to %s without TLS: whoever listens on the network reads it.", url)
        trusted = _trusted(url, ca_file)
        self._http = http_client(
            url,
            headers=headers,
            timeout=httpx2.Timeout(timeout_s, connect=min(CONNECT_S, timeout_s)),
            verify=trusted,
            ca_hint="name a file of them by --ca-file (in Python ca_file=)",
        )

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def json(self, method: str, path: str, *, repeat: bool | None = None, **request: Any) -> Any:
        """Ask, and return the answer's JSON.

        Args:
            method: Of HTTP.
            path: Behind the service's address.
            repeat: Whether it may be asked twice; None: if it only looks.
            request: The same as for `request`.

        Raises:
            TuneJobsError: The service refused; which error it is, is what would be raised on this machine.
            LostConnectionError: No answer came, at the last attempt neither.
            NoServiceError: Nothing answers there, or what does is no service.
        """
        answer = self.request(method, path, repeat=method == "GET" if repeat is None else repeat, **request)
        if media_type_of(answer) != JSON:
            raise not_a_service(self.url, answer)
        try:
            return json.loads(answer.content)
        except ValueError as error:
            raise not_a_service(self.url, answer) from error

    def request(
        self,
        method: str,
        path: str,
        *,
        repeat: bool = False,
        query: Query | None = None,
        body: Any = None,
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
    ) -> httpx2.Response:
        """Ask, and return the whole answer, which is no refusal.

        Args:
            method: Of HTTP.
            path: Behind the service's address.
            repeat: Whether it may be asked twice.
            query: Parameters; those that are None are left out, those with several values come several times.
            body: What is sent, as JSON; None: nothing.
            headers: Further headers.
            timeout_s: How long the answer may take; None: as the connection's.

        Raises:
            TuneJobsError: The same as of `json`.
        """
        waits = _WAITS_S if repeat else ()
        for number in range(len(waits) + 1):
            if number:
                time.sleep(waits[number - 1])
            try:
                with self.stream(
                    method, path, query=query, body=body, headers=headers, timeout_s=timeout_s, may_repeat=repeat
                ) as answer:
                    with self._losing(method, path, may_repeat=repeat):
                        answer.read()
                    return answer
            except LostConnectionError:
                if number == len(waits):
                    raise
            except NoServiceError:
                if number == len(waits) or not self.has_answered:
                    raise
        raise AssertionError("the last attempt returns or raises")

    @contextlib.contextmanager
    def stream(
        self,
        method: str,
        path: str,
        *,
        query: Query | None = None,
        body: Any = None,
        headers: Mapping[str, str] | None = None,
        timeout_s: float | None = None,
        may_repeat: bool = True,
    ) -> Iterator[httpx2.Response]:
        """Ask once, and give the answer, whose body is still to be read; errors of reading are the block's own.

        Raises:
            TuneJobsError: The same as of `json`.
        """
        import httpx2

        wait = self._timeout_s if timeout_s is None else timeout_s
        with self._losing(method, path, may_repeat=may_repeat):
            # That its host can have a name like this is known here alone.
            address = httpx2.URL(f"{self.url}{path}")
        request = self._http.build_request(
            method,
            address,
            params={name: value for name, value in (query or {}).items() if value is not None},
            content=None if body is None else json.dumps(body, allow_nan=False).encode(),
            headers={**({} if body is None else {"Content-Type": JSON}), **(headers or {})},
            timeout=httpx2.Timeout(wait, connect=min(CONNECT_S, wait)),
        )
        if self._http.is_closed:
            raise CannotRunError(f"The client of {self.url} was closed.", "Make another one.")
        with self._losing(method, path, may_repeat=may_repeat):
            answer = self._http.send(request, stream=True)
        try:
            self.has_answered = True
            if not answer.is_success:
                with self._losing(method, path, may_repeat=may_repeat):
                    answer.read()
                raise refusal(self.url, f"{method} {path}", answer)
            yield answer
        finally:
            answer.close()

    @contextlib.contextmanager
    def reading(self, path: str) -> Iterator[None]:
        """Say in the block's errors that a connection was lost while an answer was read."""
        with self._losing("GET", path, may_repeat=True):
            yield

    @contextlib.contextmanager
    def _losing(self, method: str, path: str, *, may_repeat: bool) -> Iterator[None]:
        """Turn errors of the connection into ours."""
        import httpx2

        try:
            yield
        except (
            httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.UnsupportedProtocol, httpx2.ProxyError,
            httpx2.InvalidURL, UnicodeError,
        ) as error:  # fmt: skip
            # That of Unicode is of a host's name that the DNS can't hold, such as a..b, be it that of a proxy.
            if wrong := wrong_proxy(self.url):
                raise wrong from None
            raise unreachable(self.url, error, self._ca_file) from error
        except httpx2.HTTPError as error:
            known = (
                "Try again."
                if may_repeat
                else "It is not known whether it was done: look with `tune-jobs status` before you try again."
            )
            if not self.has_answered and self.url.startswith("http:"):
                # What listens with TLS closes a connection that begins without it.
                known += f" If the service speaks TLS, write https://{self.url.partition('://')[2]}."
            why = said_by(error) or type(error).__name__
            raise LostConnectionError(
                f"The connection to {self.url} was lost before {method} {path} was answered: {why}.", known
            ) from error


def _trusted(url: str, ca_file: str | Path | None) -> ssl.SSLContext | bool:
    if ca_file is not None:
        try:
            return ssl.create_default_context(cafile=Path(ca_file).expanduser())
        except (OSError, RuntimeError) as error:
            why = getattr(error, "strerror", None) or error
            raise SpecError(
                f"The certificates in {ca_file} can't be read: {why}.", "Name a file of certificates, PEM."
            ) from error
    if url.startswith("http:"):
        # Nothing of TLS is used; to read the certificates that are trusted takes longer than most requests.
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    return True
