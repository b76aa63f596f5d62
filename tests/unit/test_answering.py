"""What is said of an address where something else than the wanted part of Ray answers; Ray's answers are made here."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import grpc
import pytest

from policies.errors import CannotRunError
from tune_jobs.ray_tune import answering
from tune_jobs.ray_tune.answering import check_is_ray

GCS, PROXY = "/ray.rpc.NodeInfoGcsService/CheckAlive", "/ray.rpc.RayletDriver/ClusterInfo"


@contextlib.contextmanager
def grpc_server(status: dict[str, grpc.StatusCode]) -> Iterator[int]:
    """A server that ends the calls of some methods with a status, and does not know any other."""

    class Handler(grpc.GenericRpcHandler):  # type: ignore[misc]
        def service(self, details: Any) -> Any:
            code = status.get(details.method)
            if code is None:
                return None

            def answer(request: bytes, context: Any) -> bytes:
                if code is not grpc.StatusCode.OK:
                    context.abort(code, "as Ray says it")
                return request

            return grpc.unary_unary_rpc_method_handler(answer)

    server = grpc.server(ThreadPoolExecutor(2), handlers=[Handler()])
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield port
    finally:
        server.stop(None).wait()


def refusal(address: str) -> str:
    began = time.monotonic()
    with pytest.raises(CannotRunError) as caught:
        check_is_ray(address)
    assert time.monotonic() - began < 20
    return caught.value.message


def test_ray_itself_passes() -> None:
    # The proxy of clients answers so before its first client: what matters is that it has taken the token.
    with grpc_server({GCS: grpc.StatusCode.OK}) as port:
        check_is_ray(f"127.0.0.1:{port}")
    with grpc_server({PROXY: grpc.StatusCode.NOT_FOUND}) as port:
        check_is_ray(f"ray://127.0.0.1:{port}")


def test_auto_is_asked_at_the_port_that_ray_address_names(monkeypatch: pytest.MonkeyPatch) -> None:
    with grpc_server({PROXY: grpc.StatusCode.NOT_FOUND}) as port:
        monkeypatch.setenv("RAY_ADDRESS", f"ray://127.0.0.1:{port}")
        check_is_ray("auto")
    with grpc_server({GCS: grpc.StatusCode.OK}) as port:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
        check_is_ray("auto")


def test_another_token_is_told_at_once() -> None:
    with grpc_server(dict.fromkeys((GCS, PROXY), grpc.StatusCode.UNAUTHENTICATED)) as port:
        for address in (f"127.0.0.1:{port}", f"ray://127.0.0.1:{port}"):
            assert refusal(address) == f"The Ray cluster at {address} does not accept this machine's token."


def test_the_ports_of_ray_are_told_apart() -> None:
    with grpc_server({GCS: grpc.StatusCode.OK}) as port:
        assert "does not speak with Ray clients" in refusal(f"ray://127.0.0.1:{port}")
    with grpc_server({PROXY: grpc.StatusCode.UNAUTHENTICATED}) as port:
        assert "is the port for Ray clients" in refusal(f"127.0.0.1:{port}")
    with grpc_server({}) as port:
        assert "is not Ray's control process, but another service" in refusal(f"127.0.0.1:{port}")


def test_a_web_server_is_no_cluster() -> None:
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        assert "is a web server or another program" in refusal(f"127.0.0.1:{server.server_port}")
        server.shutdown()
        thread.join()


def test_what_never_answers_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answering, "_TIMEOUT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        assert f"What listens at 127.0.0.1:{port} did not answer" in refusal(f"127.0.0.1:{port}")
