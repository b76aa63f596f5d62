"""Access where a process serves it: real connections, TLS, bodies that come in part, headers of proxies, options."""

import contextlib
import dataclasses
import gc
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from certificates import make_key, openssl
from fake_sweeps import RunCommand
from service_access import bearer, place, problem, shared  # noqa: F401 (fixture)

from policies.errors import CannotRunError, SpecError
from tune_jobs.service.config import Limits, ServiceConfig
from tune_jobs.service.serve import Server, listening_socket, serve
from tune_jobs.service.service import Service

# ruff: noqa: F811 - fixtures are named as arguments
ME = "/api/v1/me"


@contextlib.contextmanager
def listening(service: Service, **settings: Any) -> Iterator[tuple[Service, int]]:
    """The service with other settings, on a port of this machine."""
    at = place(service, port=0, **settings)
    config = at.service.config
    started = threading.Event()
    with listening_socket(config) as bound:
        # It belongs to other tests, too: nothing is drained.
        server = Server(at.service, dataclasses.replace(config, drain_s=0.0), at.app, started.set)
        thread = threading.Thread(target=server.run, args=([bound],), daemon=True)
        thread.start()
        assert started.wait(30)
        try:
            yield at.service, bound.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join(30)
            assert not thread.is_alive()


def say(port: int, request: bytes) -> socket.socket:
    """A connection on which something was said."""
    made = socket.create_connection(("127.0.0.1", port), timeout=30)
    made.sendall(request)
    return made


def heard(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    found = b""
    with connection:
        while more := connection.recv(65_536):
            found += more
    return found


def post(port: int, *headers: str, path: str = "/api/v1/sweeps") -> bytes:
    """The beginning of a request, up to its body."""
    lines = [f"POST {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Content-Type: application/json", *headers, "", ""]
    return "\r\n".join(lines).encode()


# -- bodies

PATIENCE_S = 60.0
"""Longer than httpx2's own 5 s: so long an answer may take on a busy machine."""


def test_a_body_that_ends_half_way_makes_nothing(shared: Service) -> None:
    with listening(shared) as (_, port):
        for _ in range(20):
            say(port, post(port, "Content-Length: 100") + b'{"preset": "cartpole-ppo"}').close()
        assert httpx2.get(f"http://127.0.0.1:{port}{ME}", timeout=PATIENCE_S).status_code == 200
    assert shared.queue.jobs() == []


def test_bodies_that_stay_away_are_given_up_and_hold_nobody_back(shared: Service) -> None:
    with listening(shared, limits=Limits(body_s=1.0)) as (_, port):
        slow = [say(port, post(port, "Content-Length: 100") + b'{"preset"') for _ in range(100)]
        assert httpx2.get(f"http://127.0.0.1:{port}{ME}").status_code == 200
        for connection in slow:
            assert heard(connection).startswith(b"HTTP/1.1 408 ")
    assert shared.queue.jobs() == []


def test_a_body_in_parts_without_a_length_is_limited(shared: Service) -> None:
    with listening(shared, limits=Limits(body_bytes=1_000)) as (_, port):
        connection = say(port, post(port, "Transfer-Encoding: chunked") + b"3e8\r\n" + b" " * 1_000 + b"\r\n")
        connection.sendall(b"1\r\n \r\n")
        answer = heard(connection)
        assert answer.startswith(b"HTTP/1.1 413 ")
        assert b"1,000 bytes" in answer
        told = heard(say(port, post(port, "Content-Length: 1001")))
        assert told.startswith(b"HTTP/1.1 413 ")


@pytest.mark.parametrize(
    "head",
    [
        "GET /api/v1/me HTTP/1.1", "GET /api/v1/me HTTP/1.0", "GET /api/v1/me HTTP/1.1\r\nHost: evil.example",
        "GET /api/v1/me HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nHost: evil.example", "GET /api/v1/me HTTP/1.1\r\nHost:",
        "GET /api/v1/me HTTP/1.1\r\nHost: 127.0.0.1",
        "GET http://127.0.0.1:PORT/api/v1/me HTTP/1.1\r\nHost: evil.example",
        "POST /api/v1/plans HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nContent-Length: -1",
        "POST /api/v1/plans HTTP/1.1\r\nHost: 127.0.0.1:PORT\r\nContent-Length: 1\r\nContent-Length: 2",
    ],
)  # fmt: skip
def test_heads_that_are_none(shared: Service, head: str) -> None:
    with listening(shared) as (_, port):
        request = head.replace("PORT", str(port)) + "\r\nConnection: close\r\n\r\n"
        assert heard(say(port, request.encode())).split()[1] == b"400"
        assert httpx2.get(f"http://127.0.0.1:{port}{ME}", timeout=PATIENCE_S).status_code == 200


# -- proxies


def test_a_server_believes_no_proxy_by_itself(shared: Service) -> None:
    headers = {"X-Forwarded-For": "198.51.100.7", "X-Forwarded-Proto": "https"}
    with listening(shared) as (service, port):
        url = f"http://127.0.0.1:{port}"
        problem(httpx2.get(url + ME, headers=headers), 401)
        httpx2.post(f"{url}/api/v1/login", json={"token": "x"}, headers=headers)
        assert service.gate.audit.page(limit=1)[0][0].client == "127.0.0.1"
        # Were the scheme believed, the own page would be another site's.
        secret = service.gate.tokens.make("ann", "viewer")[1]
        assert httpx2.get(url + ME, headers=headers | bearer(secret) | {"Origin": url}).status_code == 200


def test_the_announced_proxy_is_believed(shared: Service) -> None:
    headers = {"X-Forwarded-For": "198.51.100.7", "X-Forwarded-Proto": "https", "Host": "tune.example.org"}
    with listening(shared, behind_proxy="loopback", public_names=("tune.example.org",)) as (service, port):
        secret = service.gate.tokens.make("ann", "viewer")[1]
        answer = httpx2.post(f"http://127.0.0.1:{port}/api/v1/login", json={"token": secret}, headers=headers)
        assert answer.headers["set-cookie"].startswith("__Host-tune-jobs-443=")
        assert service.gate.audit.page(limit=1)[0][0].client == "198.51.100.7"


# -- TLS


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a certificate and its key, another key, and the key with a password."""
    folder = tmp_path_factory.mktemp("tls")
    for name in ("key", "other"):
        make_key(folder, f"{name}.pem")
    openssl(
        folder, "req", "-x509", "-new", "-key", "key.pem", "-out", "certificate.pem", "-days", "2",
        "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
    )  # fmt: skip
    openssl(folder, "ec", "-in", "key.pem", "-aes256", "-passout", "pass:secret", "-out", "locked.pem")
    (folder / "text.pem").write_text("no certificate\n")
    return folder


def test_a_service_with_a_certificate(shared: Service, certificates: Path) -> None:
    files = {"tls_certificate": certificates / "certificate.pem", "tls_key": certificates / "key.pem"}
    with listening(shared, **files) as (service, port):
        trusting = ssl.create_default_context(cafile=str(files["tls_certificate"]))
        url = f"https://127.0.0.1:{port}"
        with httpx2.Client(verify=trusting, headers={"Origin": url}) as client:
            secret = service.gate.tokens.make("vera", "viewer")[1]
            cookie = client.post(f"{url}/api/v1/login", json={"token": secret}).headers["set-cookie"]
            assert cookie.startswith(f"__Host-tune-jobs-{port}=")
            assert "Secure" in cookie
            assert client.get(url + ME).json()["name"] == "vera"
        with pytest.raises(httpx2.HTTPError):
            httpx2.get(f"http://127.0.0.1:{port}{ME}")


@pytest.mark.parametrize(
    ("certificate", "key", "said"),
    [
        ("none.pem", "key.pem", "none.pem.* can't be read: No such file"), ("certificate.pem", "none.pem", "none.pem"),
        ("certificate.pem", "other.pem", "MISMATCH|can't be used"), ("text.pem", "key.pem", "can't be used"),
        ("certificate.pem", "locked.pem", "can't be used"), (".", "key.pem", "can't be"),
    ],
)  # fmt: skip
def test_certificates_that_are_none(tmp_path: Path, certificates: Path, certificate: str, key: str, said: str) -> None:
    config = ServiceConfig(
        storage=tmp_path, port=0, tls_certificate=certificates / certificate, tls_key=certificates / key
    )
    with pytest.raises(CannotRunError, match=said):
        serve(config)
    assert list(tmp_path.iterdir()) == []


# -- options


def test_the_options_of_serve(run: RunCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[ServiceConfig] = []
    monkeypatch.setattr("tune_jobs.service.serve.serve", lambda config, _: asked.append(config))
    run(
        "serve", "--storage", tmp_path, "--host", "192.0.2.1", "--public-name", "a.example", "--public-name", "b:1",
        "--require-token", "--behind-proxy", "10.0.0.2", "--tls-certificate", "c.pem", "--tls-key", "k.pem",
    )  # fmt: skip
    run("serve", "--storage", tmp_path, "--behind-proxy")
    run("serve", "--storage", tmp_path)
    first, second, third = asked
    assert first.public_names == ("a.example", "b:1")
    assert (first.require_token, first.behind_proxy) == (True, "10.0.0.2")
    assert (first.tls_certificate, first.tls_key) == (Path("c.pem"), Path("k.pem"))
    assert (second.behind_proxy, third.behind_proxy) == ("loopback", None)
    assert [config.needs_token for config in asked] == [True, True, False]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--host 0.0.0.0", "tune-jobs token make NAME --role admin"), ("--behind-proxy", "token make"),
        ("--behind-proxy nginx", "'nginx' is no address"), ("--tls-key k.pem", "--tls-certificate"),
        ("--public-name https://a.example", "no name of a host"),
    ],
)  # fmt: skip
def test_options_that_cannot_be(run: RunCommand, tmp_path: Path, arguments: str, said: str) -> None:
    result = run("serve", "--port", 0, "--storage", tmp_path / "sweeps", *arguments.split())
    assert result.exit_code in (2, 5), result.output
    assert said in result.output


@pytest.mark.parametrize(("command", "said"), [("echo 'hush", "No closing quotation"), ("echo \\", "No escaped char")])
def test_a_command_that_is_none_is_refused(run: RunCommand, tmp_path: Path, command: str, said: str) -> None:
    result = run("serve", "--port", 0, "--storage", tmp_path / "sweeps", "--run-command", command)
    assert result.exit_code == 2, result.output
    assert f"--run-command can't be split into a command and its arguments: {said}" in result.output
    # They may be secrets.
    assert "hush" not in result.output


def test_a_proxy_is_one_address() -> None:
    with pytest.raises(SpecError, match=r"'10\.0\.0\.0/8' is no address"):
        ServiceConfig(storage=Path(), behind_proxy="10.0.0.0/8")


def test_while_a_service_answers_old_objects_are_looked_through_rarely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, during = gc.get_threshold(), []
    monkeypatch.setattr(Server, "run", lambda *_, **__: during.append(gc.get_threshold()))
    serve(ServiceConfig(storage=tmp_path, port=0, spare_idle_s=0))
    assert during[0][2] >= 10 * before[2]
    assert gc.get_threshold() == before
