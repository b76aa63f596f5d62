"""Run a service until a signal ends it."""

from __future__ import annotations

import contextlib
import gc
import logging
import socket
import ssl
from collections.abc import Callable, Iterator
from typing import Any

import uvicorn

from policies.errors import CannotRunError
from tune_jobs.service.access.hosts import public_host
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.connections import HeadTimeoutProtocol, many_files
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service, opened

_log = logging.getLogger(__name__)

_UNREAD_MS = 60_000


def serve(config: ServiceConfig, on_start: Callable[[str], None] = lambda _: None) -> None:
    """Serve until SIGTERM or SIGINT; then running sweeps save, and go on at the next start.

    Args:
        config: The service's settings.
        on_start: Called with the URL, once requests are taken.

    Raises:
        SpecError: A public name is none.
        CannotRunError: It can't listen there, another service has the storage, the database or the certificate can't
            be used, or a token is needed and there is none.
    """
    for name in config.public_names:
        public_host(name)
    _check_tls(config)
    listening = listening_socket(config)
    with listening, many_files(), opened(config) as service, rare_collections():
        port = listening.getsockname()[1]
        app = make_app(service)
        host = f"[{config.host}]" if ":" in config.host else config.host
        scheme = "http" if config.tls_certificate is None else "https"
        if not config.is_local and scheme == "http" and config.behind_proxy is None:
            _log.warning("Without TLS, who listens on the network reads tokens. Give --tls-certificate and --tls-key.")
        server = Server(service, config, app, lambda: on_start(f"{scheme}://{host}:{port}"))
        # The server raises the signal that ended it once more; it has done what the signal asked for.
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])


@contextlib.contextmanager
def rare_collections() -> Iterator[None]:
    """Look rarely for circles among all objects, in the block.

    The records of 10,000 trials are a million objects that live on: to look through them took a quarter of a second
    every few requests, in which nobody was answered. Young objects are looked through as before, a little later.
    """
    before = gc.get_threshold()
    gc.set_threshold(50_000, 20, 100)
    try:
        yield
    finally:
        gc.set_threshold(*before)


class Server(uvicorn.Server):
    """Serves until a signal comes, or `should_exit` is set; then streams end, and running sweeps save.

    Args:
        service: The service.
        config: Its settings.
        app: What answers.
        on_start: Called once requests are taken.
    """

    def __init__(self, service: Service, config: ServiceConfig, app: Any, on_start: Callable[[], None]) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                lifespan="off",
                server_header=False,
                # The access layer reads these headers, from the one proxy that the operator has named.
                proxy_headers=False,
                ssl_certfile=config.tls_certificate,
                ssl_keyfile=None if config.tls_key is None else str(config.tls_key),
                timeout_graceful_shutdown=5,
                timeout_keep_alive=30,
                http=HeadTimeoutProtocol,
                h11_max_incomplete_event_size=64 * 1024,
            )
        )
        self._service, self._drain_s, self._on_start = service, config.drain_s, on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to take requests."""
        await super().startup(sockets)
        self._on_start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Take no more requests, end what goes on, and let running sweeps save."""
        import anyio

        self._service.planning.close()
        # Those of requests may all be taken, by what takes long.
        own_threads = anyio.CapacityLimiter(1)
        # Streams would go on for ever; what they are about is not over, so clients come back.
        await anyio.to_thread.run_sync(self._service.watching.close, limiter=own_threads)
        await super().shutdown(sockets)
        _log.info("Running sweeps save, for at most %g s.", self._drain_s)
        if not await anyio.to_thread.run_sync(self._service.supervisor.drain, self._drain_s, limiter=own_threads):
            _log.warning("Some sweeps did not save in time; they run on, and the next start finds them.")


def _check_tls(config: ServiceConfig) -> None:
    if config.tls_certificate is None or config.tls_key is None:
        return
    told = f"{config.tls_certificate} and {config.tls_key}"
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        # A key with a password would ask for it, at a terminal that a service has not.
        context.load_cert_chain(config.tls_certificate, config.tls_key, password=lambda: "")
    except ssl.SSLError as error:
        raise CannotRunError(
            f"{told} can't be used as certificate and key: {error.reason or error}.",
            "Give PEM files that belong together, the key without a password.",
        ) from error
    except OSError as error:
        raise CannotRunError(
            f"{told} can't be read: {error.strerror}.", "Check that both are there and may be read by the service."
        ) from error


def listening_socket(config: ServiceConfig) -> socket.socket:
    """Return a socket that listens where a service is to be reached.

    Raises:
        CannotRunError: It can't listen there.
    """
    try:
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        made = socket.socket(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # Connections have it too: one whose client reads nothing for so long is closed, whatever is left to send.
            made.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNREAD_MS)
        made.bind((config.host, config.port))
        made.listen(1_024)
    except OSError as error:
        raise CannotRunError(
            f"The service can't listen on {config.host}:{config.port}: {error.strerror}.",
            "Give another --port, or end what listens there.",
        ) from error
    return made
