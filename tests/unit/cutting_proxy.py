"""A proxy on a port of 127.0.0.1 that cuts connections, for the tests of what asks a service."""

import contextlib
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from urllib.parse import urlsplit


@dataclass
class Proxy:
    """Where it is, and what it does.

    Attributes:
        url: Its address.
        cuts: For each connection to come, after how many bytes of the answers it is cut; when there are none left,
            connections are left alone. 0: once the request has arrived at the service.
        requests: The beginnings of what was asked, one a connection.
        is_away: Whether connections are closed at once.
    """

    url: str
    cuts: list[int] = field(default_factory=list)
    requests: list[bytes] = field(default_factory=list)
    is_away: bool = False
    connections: list[socket.socket] = field(default_factory=list)

    def cut_all(self) -> None:
        """Cut the connections that there are."""
        while self.connections:
            _shut(self.connections.pop())


@contextlib.contextmanager
def cutting_proxy(url: str) -> Iterator[Proxy]:
    """Pass connections on to a service, which is asked by its own name."""
    service = (urlsplit(url).hostname or "", urlsplit(url).port or 80)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        proxy = Proxy(f"http://127.0.0.1:{listening.getsockname()[1]}")
        names = (urlsplit(proxy.url).netloc.encode(), urlsplit(url).netloc.encode())

        def accept() -> None:
            while True:
                try:
                    client, _ = listening.accept()
                except OSError:
                    return
                threading.Thread(target=_serve, args=(proxy, client, service, names), daemon=True).start()

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        try:
            yield proxy
        finally:
            # Closing alone does not end a wait for connections.
            _shut(listening)
            proxy.cut_all()
            thread.join(30)


def _serve(proxy: Proxy, client: socket.socket, service: tuple[str, int], names: tuple[bytes, bytes]) -> None:
    with client, contextlib.suppress(OSError):
        if proxy.is_away:
            return
        left = proxy.cuts.pop(0) if proxy.cuts else None
        request = client.recv(65_536)
        proxy.requests.append(request)
        with socket.create_connection(service) as server:
            proxy.connections += [client, server]
            server.sendall(request.replace(*names, 1))
            threading.Thread(target=_pass_on, args=(client, server, names), daemon=True).start()
            try:
                _pass_back(client, server, left)
            finally:
                # Closing alone ends no connection that another thread reads from.
                _shut(client)
                _shut(server)


def _pass_back(client: socket.socket, server: socket.socket, left: int | None) -> None:
    while chunk := server.recv(65_536):
        client.sendall(chunk[:left])
        if left is not None:
            left -= len(chunk)
            if left <= 0:
                return


def _pass_on(client: socket.socket, server: socket.socket, names: tuple[bytes, bytes]) -> None:
    with contextlib.suppress(OSError):
        while chunk := client.recv(65_536):
            server.sendall(chunk.replace(*names, 1))
        _shut(server)


def _shut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
