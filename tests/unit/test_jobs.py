"""Ray's Jobs API is asked as Ray asks it, and whatever else answers is told in one sentence."""

import socket
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from fake_jobs import Head, head

from analysis.records import JobRecord
from policies.errors import CannotRunError, SpecError, TuneJobsError
from tune_jobs.ray_tune.jobs import JobsApi, check_jobs_address, token_of
from tune_jobs.sweeps.detached import job_now

__all__ = ["head"]


def test_a_job_is_begun_told_of_and_stopped(head: Head) -> None:
    with JobsApi(f"{head.address}/") as api:
        assert api.ray_version() == "2.60.0"
        uri = api.upload(b"zip")
        assert uri == api.upload(b"zip")
        api.submit("a-1", "true", {"working_dir": uri}, {"sweep": "a"})
        found = api.job("a-1")
        assert found is not None
        assert (found.status, found.has_ended) == ("RUNNING", False)
        assert api.job("nobody") is None
        assert api.stop("a-1")
    assert list(head.packages) == [uri.removeprefix("gcs://")]
    assert head.submitted == [{
        "submission_id": "a-1", "entrypoint": "true", "runtime_env": {"working_dir": uri}, "metadata": {"sweep": "a"},
    }]  # fmt: skip
    assert head.stopped == ["a-1"]


def test_a_token_is_shown_as_ray_does(head: Head, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    head.token = "right"
    with JobsApi(head.address) as api, pytest.raises(CannotRunError, match="wants a token"):
        api.ray_version()
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", "wrong")
    with JobsApi(head.address) as api, pytest.raises(CannotRunError, match="does not accept this machine's token"):
        api.ray_version()
    (tmp_path / "token").write_text("right\n")
    monkeypatch.delenv("RAY_AUTH_TOKEN")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    with JobsApi(head.address) as api:
        assert api.ray_version() == "2.60.0"


def test_without_the_mode_there_is_no_token_and_with_it_there_must_be_one(tmp_path: Path) -> None:
    assert token_of({"RAY_AUTH_TOKEN": "x"}) is None
    with pytest.raises(SpecError, match="RAY_AUTH_TOKEN_PATH cannot be read"):
        token_of({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(tmp_path / "none")})
    (tmp_path / "empty").touch()
    with pytest.raises(SpecError, match="no token in RAY_AUTH_TOKEN_PATH"):
        token_of({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(tmp_path / "empty")})


@pytest.mark.parametrize(
    ("address", "said"),
    [
        (None, "no --address is given"),
        ("auto", "--address is 'auto'"),
        ("ray://head:10001", "--address is 'ray://head:10001'"),
        ("http://", "is not the address"),
        ("http://head:x", "is not the address"),
        ("http://head:8265/?a=1", "is not the address"),
    ],
)
def test_an_address_of_another_form_is_told(address: str | None, said: str) -> None:
    with pytest.raises(SpecError, match=said):
        check_jobs_address(address)


def test_a_password_in_an_address_is_neither_taken_nor_repeated() -> None:
    with pytest.raises(SpecError) as caught:
        check_jobs_address("http://me:secret@head:8265")
    assert "secret" not in str(caught.value)


def test_who_else_answers_is_told() -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), _Quiet) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        with (
            JobsApi(f"http://127.0.0.1:{server.server_address[1]}") as api,
            pytest.raises(CannotRunError, match="not Ray's Jobs API: it answers 404"),
        ):
            api.ray_version()
        server.shutdown()


def test_what_speaks_no_http_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def speak() -> None:
            with listening.accept()[0] as connection:
                # The first frame of gRPC, which ports 6379 and 10001 answer with.
                connection.recv(1000)
                connection.sendall(b"\x00\x00\x06\x04\x00\x00\x00\x00\x00\x00\x05\x00\x00\x40\x00\r\n\r\n")

        thread = threading.Thread(target=speak)
        thread.start()
        with (
            JobsApi(f"http://127.0.0.1:{listening.getsockname()[1]}") as api,
            pytest.raises(CannotRunError, match="not Ray's Jobs API") as caught,
        ):
            api.ray_version()
        thread.join()
    assert "6379" in caught.value.hint


def test_what_never_answers_is_given_up_and_a_closed_port_names_the_dashboard() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with JobsApi(address, timeout_s=0.1) as api, pytest.raises(CannotRunError, match="does not answer in time"):
            api.ray_version()
    with JobsApi(address) as api, pytest.raises(CannotRunError, match="Nothing answers") as caught:
        api.ray_version()
    assert "--include-dashboard=true" in caught.value.hint


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 (the name that is overridden)
        pass


LONG = "a" * 70


@pytest.mark.parametrize(
    ("address", "name", "value", "words"),
    [
        ("http://a..b:8265", None, "", "http://a..b:8265"),
        (f"http://{LONG}.invalid:8265", None, "", f"http://{LONG}.invalid:8265"),
        ("http://head.invalid:8265", "SSL_CERT_FILE", "/nonexistent.pem", "SSL_CERT_FILE"),
        ("http://head.invalid:8265", "HTTP_PROXY", "foo://x:1", "HTTP_PROXY names has the scheme foo"),
        ("http://head.invalid:8265", "HTTP_PROXY", "http://u:sec/ret@p:1", "HTTP_PROXY names has no address"),
        ("http://head.invalid:8265", "HTTP_PROXY", "http://u:secret@a..b:1", "HTTP_PROXY names has no address"),
        ("http://head.invalid:8265", "HTTP_PROXY", "http://:8080", "HTTP_PROXY names has no address"),
        ("http://a..b:8265", "HTTPS_PROXY", "http://x..y:1", "http://a..b:8265"),
        ("https://head.invalid:8265", "ALL_PROXY", "socks5://u:secret@x:1", "needs socksio"),
    ],
)
def test_odd_hosts_proxies_and_certificates_are_told_and_make_no_sweep_unreadable(
    monkeypatch: pytest.MonkeyPatch, address: str, name: str | None, value: str, words: str
) -> None:
    for variable in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY"):
        monkeypatch.delenv(variable, raising=False)
        monkeypatch.delenv(variable.lower(), raising=False)
    monkeypatch.setitem(sys.modules, "socksio", None)
    if name is not None:
        monkeypatch.setenv(name, value)

    def ask() -> None:
        with JobsApi(address) as api:
            api.ray_version()

    with pytest.raises(TuneJobsError) as caught:
        ask()
    assert words in str(caught.value)
    assert "sec" not in str(caught.value)
    assert job_now(JobRecord(id="mine-1", address=address, place="")) is None
