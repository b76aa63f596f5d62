"""An answer of unknown length whose token ends on the way: a download is cut, so that its part is not taken for all."""

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx2
import pytest
from live_service import Live, serving_a_viewer
from service_access import bearer
from sqlalchemy.exc import OperationalError
from test_service_downloads import make_finished

from policies.errors import CannotRunError
from tune_jobs.client import Client
from tune_jobs.client import downloads as client_downloads
from tune_jobs.service.access import middleware
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.access.tokens import Token
from tune_jobs.service.http import downloads

Site = tuple[Live, str]
EARLIER = b"an earlier one"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """A service with a policy whose archive has several parts, each as if it had taken seconds; a viewer's token."""
    monkeypatch.setattr(middleware, "FRESH_S", 0.0)
    monkeypatch.setattr(downloads, "_CHUNK_BYTES", 256)
    monkeypatch.setattr(client_downloads, "_WAIT_S", 0.0)
    with serving_a_viewer(tmp_path / "sweeps", "vera") as (live, secret):
        make_finished(live.storage / "mine")
        yield live, secret


def at_look(live: Live, monkeypatch: pytest.MonkeyPatch, number: int, do: Callable[[], object]) -> list[int]:
    """Do something once the token is looked up for the so manieth time; returns the list of look-ups."""
    tokens, real = live.service.gate.tokens, live.service.gate.tokens.find
    looks: list[int] = []

    def find(secret: str) -> Token | None:
        looks.append(len(looks) + 1)
        if looks[-1] == number:
            do()
        return real(secret)

    monkeypatch.setattr(tokens, "find", find)
    return looks


def revoke(live: Live) -> None:
    (token,) = live.service.gate.tokens.all()
    live.service.gate.tokens.revoke(token.id)


def test_a_download_whose_token_is_revoked_is_cut(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live, secret = site
    looks = at_look(live, monkeypatch, 3, lambda: revoke(live))
    with pytest.raises(httpx2.RemoteProtocolError, match="incomplete"):
        live.get("/sweeps/mine/policy", headers=bearer(secret))
    assert len(looks) == 3


def test_an_earlier_file_stays_where_a_download_is_cut(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, secret = site
    file = tmp_path / "mine.zip"
    file.write_bytes(EARLIER)
    at_look(live, monkeypatch, 3, lambda: revoke(live))
    # It is asked for once more, as a lost connection may come back; the token opens nothing then.
    with Client(live.url, token=secret) as client, pytest.raises(CannotRunError, match="without a valid token"):
        client.download("mine", "policy", file)
    assert file.read_bytes() == EARLIER


def away() -> None:
    raise OperationalError("SELECT", {}, Exception("database is locked"))


def refused() -> None:
    raise RefusedError(429, "Too many wrong tokens have come from this address.", "Try again in 60 s.")


@pytest.mark.parametrize("fail", [away, refused])
def test_a_download_goes_on_while_it_is_not_known_whether_its_token_is_valid(
    site: Site,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    fail: Callable[[], None],
) -> None:
    live, secret = site
    looks = at_look(live, monkeypatch, 3, fail)
    with Client(live.url, token=secret) as client:
        assert zipfile.ZipFile(client.download("mine", "policy", tmp_path / "mine.zip")).testzip() is None
    assert len(looks) > 3
    told = [record.getMessage() for record in caplog.records if record.name.endswith("outages")]
    away_told = ["The service's database can't be used: database is locked. It is tried again."]
    assert told == (away_told if fail is away else [])


def test_a_token_that_was_revoked_while_nobody_could_say_it_ends_its_download_then(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, secret = site

    def revoked_and_away() -> None:
        revoke(live)
        away()

    looks = at_look(live, monkeypatch, 3, revoked_and_away)
    with pytest.raises(httpx2.RemoteProtocolError, match="incomplete"):
        live.get("/sweeps/mine/policy", headers=bearer(secret))
    assert len(looks) == 4


def test_a_stream_of_events_whose_token_is_revoked_has_a_proper_end(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, secret = site
    at_look(live, monkeypatch, 2, lambda: revoke(live))
    # It is read to its end, which does not come by itself.
    answer = live.get("/sweeps/mine/events", headers=bearer(secret))
    assert (answer.status_code, answer.headers["content-type"].split(";")[0]) == (200, "text/event-stream")
