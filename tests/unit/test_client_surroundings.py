"""A client where the environment names proxies or certificates that can't be used, and addresses that are none."""

import sys
from pathlib import Path

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from fake_sweeps import RunCommand, run  # noqa: F401 (a fixture)

from policies.errors import CannotRunError, SpecError, TuneJobsError
from tune_jobs.client import Client, NoServiceError

# ruff: noqa: F811 - fixtures are named as arguments

URL = "https://tune.invalid"
LONG = "a" * 70


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY"):
        for variable in (name, name.lower()):
            monkeypatch.delenv(variable, raising=False)
    for name in ("SSL_CERT_FILE", "SSL_CERT_DIR", "TUNE_JOBS_CA_FILE"):
        monkeypatch.delenv(name, raising=False)
    # As where it is not installed, which it need not be.
    monkeypatch.setitem(sys.modules, "socksio", None)


@pytest.mark.parametrize(
    ("name", "value", "kind", "words"),
    [
        ("ALL_PROXY", "socks5://ann:s3cret@127.0.0.1:1080", CannotRunError, "needs socksio, and that is not installed"),
        ("all_proxy", "socks5h://127.0.0.1:1080", CannotRunError, "`pip install socksio`"),
        ("ALL_PROXY", "socks4://ann:s3cret@127.0.0.1:1080", SpecError, "has the scheme socks4; known are http, "),
        ("HTTPS_PROXY", "http://ann:s3cret@proxy:port", SpecError, "no address of a host and port"),
        ("https_proxy", "ann:s3cret", SpecError, "no address of a host and port"),
        ("HTTP_PROXY", "http://ann:s3cret/@proxy:80", SpecError, "no address of a host and port"),
        ("SSL_CERT_FILE", "/nonexistent.pem", SpecError, "in /nonexistent.pem, can't be read: No such file"),
    ],
)
def test_what_the_environment_names_and_cannot_be_used_is_told_by_the_variable(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, kind: type[TuneJobsError], words: str
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(kind) as caught:
        Client(URL)
    told = str(caught.value)
    assert words in told
    assert f"that {name} names" in caught.value.message
    assert f"ave {name} name " in caught.value.hint
    assert "ann" not in told
    assert "s3cret" not in told
    # A traceback shows no other error, which may quote a proxy's password.
    assert name == "SSL_CERT_FILE" or caught.value.__suppress_context__


@pytest.mark.parametrize("proxy", ["http://ann:s3cret@a..b:1", "http://:8080", "http://"])
@pytest.mark.parametrize("url", [URL, "http://tune.invalid"])
def test_a_proxy_that_has_no_host_is_told_when_it_is_asked(
    monkeypatch: pytest.MonkeyPatch, url: str, proxy: str
) -> None:
    name = f"{url.partition(':')[0].upper()}_PROXY"
    monkeypatch.setenv(name, proxy)
    with Client(url) as client, pytest.raises(SpecError, match=f"The proxy that {name} names") as caught:
        client.me()
    assert "s3cret" not in str(caught.value)


@pytest.mark.parametrize("name", ["HTTPS_PROXY", "HTTP_PROXY"])
def test_a_proxy_that_is_not_asked_is_not_blamed(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "http://a..b:1")
    monkeypatch.setenv("NO_PROXY", "x..y" if name == "HTTP_PROXY" else "")
    with Client("http://x..y:8470") as client, pytest.raises(NoServiceError, match=r"at http://x\.\.y:8470 can't be"):
        client.me()


def test_a_service_of_this_machine_needs_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "socks4://proxy")
    monkeypatch.setenv("SSL_CERT_FILE", "/nonexistent.pem")
    for url in ("http://127.0.0.1:1", "https://localhost:1"):
        with Client(url) as client, pytest.raises(NoServiceError, match="can't be reached"):
            client.me()


def test_the_command_line_calls_it_no_bug(run: RunCommand, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "none.pem"))
    result = run("--server", URL, "list")
    assert result.exit_code == SpecError.exit_code
    assert "SSL_CERT_FILE" in result.stderr
    assert "bug" not in result.output
    monkeypatch.delenv("SSL_CERT_FILE")
    result = run("--server", "http://a..b", "list")
    assert result.exit_code == CannotRunError.exit_code
    assert "bug" not in result.output


@pytest.mark.parametrize(
    "url",
    [
        "http://a..b",
        "http://.x",
        f"http://{LONG}",
        "http://\u2603.invalid",
        "http://a/\udcff",
        f"http://a/{LONG * 1_000}",
    ],
)
def test_an_address_that_cannot_be_asked_is_told_as_one_where_nothing_answers(url: str) -> None:
    with Client(url) as client, pytest.raises(NoServiceError, match="can't be reached: ") as caught:
        client.me()
    assert "Check the address" in caught.value.hint
