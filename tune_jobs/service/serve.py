"""Run a service until a signal ends it."""

from __future__ import annotations

import contextlib
import logging
import socket
from collections.abc import Callable
from typing import Any

import uvicorn

from policies.errors import CannotRunError
from tune_jobs.service.config import ServiceConfig
from tune_jobs.service.http.app import make_app
from tune_jobs.service.service import Service, opened

_log = logging.getLogger(__name__)


def serve(config: ServiceConfig, on_start: Callable[[str], None] = lambda _: None) -> None:
    """Serve until SIGTERM or SIGINT; then running sweeps save, and go on at the next start.

    Args:
        config: The service's settings.
        on_start: Called with the URL, once requests are taken.

    Raises:
        CannotRunError: It can't listen there, another service has the storage, or the database can't be used.
    """
    listening = _listening(config)
    with listening, opened(config) as service:
        app = make_app(service)
        port = listening.getsockname()[1]
        host = f"[{config.host}]" if ":" in config.host else config.host
        server = _Server(service, config, app, lambda: on_start(f"http://{host}:{port}"))
        # The server raises the signal that ended it once more; it has done what the signal asked for.
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listening])


class _Server(uvicorn.Server):
    def __init__(self, service: Service, config: ServiceConfig, app: Any, on_start: Callable[[], None]) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                lifespan="off",
                server_header=False,
                timeout_graceful_shutdown=5,
                timeout_keep_alive=30,
                h11_max_incomplete_event_size=64 * 1024,
            )
        )
        self._service, self._drain_s, self._on_start = service, config.drain_s, on_start

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._on_start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        import anyio

        await super().shutdown(sockets)
        _log.info("Running sweeps save, for at most %g s.", self._drain_s)
        if not await anyio.to_thread.run_sync(self._service.supervisor.drain, self._drain_s):
            _log.warning("Some sweeps did not save in time; they run on, and the next start finds them.")


def _listening(config: ServiceConfig) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        made = socket.socket(family, socket.SOCK_STREAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((config.host, config.port))
        made.listen(1_024)
    except OSError as error:
        raise CannotRunError(
            f"The service can't listen on {config.host}:{config.port}: {error.strerror}.",
            "Give another --port, or end what listens there.",
        ) from error
    return made
