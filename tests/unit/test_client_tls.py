"""A client of a service with TLS: whose certificates it trusts, and what it says where it does not."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from certificates import make_authority, make_certificate, openssl
from fake_sweeps import RunCommand, run  # noqa: F401 (a fixture)
from live_service import Live, serving
from test_service_downloads import FILM, make_finished

from policies.errors import SpecError
from tune_jobs.client import Client, LostConnectionError, NoServiceError

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two authorities, and a certificate of the first for this machine."""
    made = tmp_path_factory.mktemp("tls")
    for name in ("ours", "theirs"):
        make_authority(made, name)
    make_certificate(made, "ours", "server", "IP:127.0.0.1,DNS:localhost")
    make_certificate(made, "ours", "elsewhere", "DNS:tune.example.org")
    return made


@pytest.fixture(scope="module")
def site(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    storage = tmp_path_factory.mktemp("served") / "sweeps"
    with serving(storage, certificate=(folder / "server.pem", folder / "server-key.pem")) as made:
        make_finished(made.storage / "mine")
        yield made


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TUNE_JOBS_SERVER", "TUNE_JOBS_TOKEN", "TUNE_JOBS_CA_FILE", "SSL_CERT_FILE", "SSL_CERT_DIR"):
        monkeypatch.delenv(name, raising=False)


def test_an_authority_of_ones_own_is_trusted_for_all_that_is_asked(site: Live, folder: Path, tmp_path: Path) -> None:
    for url in (site.url, site.url.replace("127.0.0.1", "localhost")):
        with Client(url, ca_file=folder / "ours.pem") as client:
            assert client.status("mine").sweep.name == "mine"
            assert next(client.events("mine")).kind == "status"
            assert client.download("mine", "films/after_mp4", tmp_path / "film").read_bytes() == FILM


def test_the_command_takes_it_as_an_option_and_from_the_environment(
    run: RunCommand, site: Live, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_option = run("--server", site.url, "--ca-file", folder / "ours.pem", "status", "mine")
    assert by_option.exit_code == 0, by_option.output
    monkeypatch.setenv("TUNE_JOBS_CA_FILE", str(folder / "ours.pem"))
    assert run("--server", site.url, "status", "mine").stdout == by_option.stdout
    refused = run("--server", site.url, "--ca-file", folder / "theirs.pem", "status", "mine")
    assert refused.exit_code == 5
    assert "can't be trusted" in refused.stderr
    assert "theirs.pem" in refused.stderr


def test_without_it_and_with_another_the_service_is_not_trusted_and_hears_no_token(site: Live, folder: Path) -> None:
    for ca_file in (None, folder / "theirs.pem"):
        with (
            Client(site.url, "tune-jobs_00000000_" + "A" * 43, ca_file=ca_file) as client,
            pytest.raises(NoServiceError, match=f"{site.url} can't be trusted") as caught,
        ):
            client.me()
        # What to do is another thing where a file was given: it is the wrong one.
        assert ("--ca-file" in caught.value.hint) == (ca_file is None)
        assert ("theirs.pem" in caught.value.hint) == (ca_file is not None)


def test_a_certificate_of_another_host_is_told_as_such(folder: Path, tmp_path: Path) -> None:
    certificate = (folder / "elsewhere.pem", folder / "elsewhere-key.pem")
    with (
        serving(tmp_path / "sweeps", certificate=certificate) as made,
        Client(made.url, ca_file=folder / "ours.pem") as client,
        pytest.raises(NoServiceError, match=r"127\.0\.0\.1") as caught,
    ):
        client.me()
    assert "mismatch" in caught.value.message
    assert "--ca-file" not in caught.value.hint
    assert "name" in caught.value.hint


def test_what_speaks_no_tls_is_told(site: Live, folder: Path, tmp_path: Path) -> None:
    with serving(tmp_path / "sweeps") as plain:
        url = plain.url.replace("http:", "https:")
        with (
            Client(url, ca_file=folder / "ours.pem") as client,
            pytest.raises(NoServiceError, match="can't be reached") as caught,
        ):
            client.me()
        assert f"write {plain.url}" in caught.value.hint
    with Client(site.url.replace("https:", "http:")) as client, pytest.raises(LostConnectionError) as lost:
        client.me()
    assert f"write {site.url}" in lost.value.hint


def test_files_that_hold_no_certificate_are_refused(folder: Path) -> None:
    (folder / "text.pem").write_text("none\n")
    openssl(folder, "ec", "-in", "server-key.pem", "-out", "key-alone.pem")
    for name in ("none.pem", "text.pem", "key-alone.pem", "."):
        with pytest.raises(SpecError, match="can't be read"):
            Client("https://127.0.0.1:1", ca_file=folder / name)
