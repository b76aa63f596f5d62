"""What a client says of addresses at which no service is, and of tokens: those that let in, and those that don't."""

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from fake_sweeps import RunCommand
from live_service import serving
from services import FAKE
from sweep_folders import make_sweep_folder

from policies.errors import CannotRunError, SpecError
from tune_jobs.client import Client, NoServiceError

# -- what is no service, or lets nobody in


@contextlib.contextmanager
def answering(status: int, body: str, media_type: str, **headers: str) -> Iterator[str]:
    """The address of a server that answers everything alike."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            for name, value in {"Content-Type": media_type, "Content-Length": str(len(body)), **headers}.items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body.encode())

        do_POST = do_GET  # noqa: N815

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join(30)


JSON, PROBLEM = "application/json", "application/problem+json"


@pytest.mark.parametrize(
    ("status", "body", "media_type", "words"),
    [
        (200, "<!DOCTYPE html><title>Jenkins</title>", "text/html; charset=x", ("no service", "Jenkins", "text/html")),
        (404, "<html>nothing here</html>", "text/html", ("no service", "status 404")),
        (404, '{"detail":"Not Found"}', JSON, ("no service", "Not Found")),
        (200, "{]", JSON, ("no service",)),
        (200, "[1]", JSON, ("does not know",)),
        (200, '{"name": 3}', JSON, ("does not know", "name")),
        (502, "<h1>Bad Gateway</h1>", "text/html", ("proxy", "502")),
        (401, '{"detail": "A token is needed."}', PROBLEM, ("token", "A token is needed.")),
        (404, '{"detail": "Not Found"}', PROBLEM, ("does not know GET /api/v1/me",)),
        (404, '{"detail": "There is nothing at this path."}', PROBLEM, ("does not know GET /api/v1/me",)),
        (405, '{"detail": "This path takes no GET."}', PROBLEM, ("does not know GET /api/v1/me",)),
        (507, '{"detail": "The disk is full."}', PROBLEM, ("The disk is full.",)),
        (429, '{"detail": "Too many."}', PROBLEM, ("Too many.",)),
        (200, "", "", ("no service",)),
    ],
)  # fmt: skip
def test_what_answers_and_is_no_service_is_told(status: int, body: str, media_type: str, words: Any) -> None:
    with answering(status, body, media_type) as url, Client(url) as client:
        with pytest.raises(CannotRunError) as caught:
            client.me()
        for word in words:
            assert word in caught.value.message
        assert url in caught.value.message or status in (429, 507)
        assert caught.value.hint or status == 507


def test_a_token_is_not_carried_to_another_address() -> None:
    to = "http://user:pass@elsewhere.example/x?token=1"
    with (
        answering(302, "", "", Location=to) as url,
        Client(url, "abc") as client,
        pytest.raises(NoServiceError) as caught,
    ):
        client.me()
    assert "http://elsewhere.example " in caught.value.message
    assert "pass" not in str(caught.value)


def test_an_address_at_which_nobody_answers_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda _: pytest.fail("it waited"))
    with Client("http://127.0.0.1:1") as client:
        with pytest.raises(NoServiceError, match=r"http://127\.0\.0\.1:1 can't be reached"):
            client.me()
        with pytest.raises(NoServiceError):
            next(client.events("mine"))


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("127.0.0.1:8470", "http://"), ("ftp://x", "http://"), ("", "http://"), ("http://", "http://"),
        ("http://me:s3cret@x:1", "password"), ("https://s3cret@x", "password"), ("http://x:99999", "port"),
        ("http://x?token=s3cret", "query"), ("http://x/#s3cret", "query"), ("http://a b", "http://"),
    ],
)  # fmt: skip
def test_addresses_that_are_none_are_refused_and_show_no_secret(url: str, words: str) -> None:
    with pytest.raises(SpecError) as caught:
        Client(url)
    assert words in caught.value.message
    assert "s3cret" not in str(caught.value)


# -- tokens


def test_a_token_lets_in_and_a_wrong_one_is_told(tmp_path: Path, run: RunCommand) -> None:
    make = ("token", "make", "--json", "--storage", tmp_path / "sweeps")
    viewer, ann = (
        json.loads(run(*make, name, "--role", role).stdout)["token"]
        for name, role in (("eve", "viewer"), ("ann", "submitter"))
    )
    with serving(tmp_path / "sweeps", require_token=True) as made:
        make_sweep_folder(made.storage / "done")
        file = tmp_path / "token"
        file.write_text(f"{ann}\n")
        with Client(made.url, token_file=file) as client:
            assert client.me().name == "ann"
            assert client.submit(FAKE, name="mine").job.owner == "ann"
            with pytest.raises(CannotRunError, match="belongs to nobody"):
                client.delete("done")
        with Client(made.url, f" {viewer}\n") as client:
            assert client.me().role == "viewer"
            with pytest.raises(CannotRunError, match="viewer"):
                client.submit(FAKE)
            assert next(client.events("done")).kind == "status"
        wrong = "tune-jobs_00000000_" + "A" * 43
        for token in (None, wrong):
            with Client(made.url, token) as client:
                with pytest.raises(CannotRunError, match="valid token") as caught:
                    client.status("done")
                assert wrong not in str(caught.value)
                assert "TUNE_JOBS_TOKEN" in caught.value.hint
                assert wrong not in repr(client)


def test_tokens_that_are_none_are_refused_and_not_shown(tmp_path: Path) -> None:
    file = tmp_path / "token"
    for content in ("", "two s3crets", "s3cret\ns3cret", "s3crét"):
        file.write_text(content)
        with pytest.raises(SpecError) as caught:
            Client("http://x", token_file=file)
        assert "s3cr" not in str(caught.value)
    with pytest.raises(SpecError, match="can't be read"):
        Client("http://x", token_file=tmp_path / "none")
    with pytest.raises(SpecError, match="one of them"):
        Client("http://x", "abc", token_file=file)
    with pytest.raises(SpecError, match="certificates in"):
        Client("https://x", ca_file=tmp_path / "none")
