"""A client whose connections are cut: what is asked again, what is not, downloads that go on."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from client_fixtures import alone, soon  # noqa: F401 (fixtures)
from cutting_proxy import cutting_proxy
from live_service import Live, live, serving  # noqa: F401 (a fixture)
from services import FAKE
from sweep_folders import make_sweep_folder
from test_service_downloads import FILM, make_finished

from tune_jobs.client import Client, LostConnectionError
from tune_jobs.client import connection as connection_module

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service with a sweep that has ended, for tests that only look."""
    with serving(tmp_path_factory.mktemp("cut") / "sweeps") as made:
        make_finished(made.storage / "mine")
        yield made


def test_what_only_looks_is_asked_again(site: Live) -> None:
    with cutting_proxy(site.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [0, 20, 500]
        assert client.status("mine").sweep.name == "mine"
        assert len(proxy.requests) == 4


def test_a_submission_whose_answer_is_lost_makes_one_sweep(live: Live) -> None:
    with cutting_proxy(live.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [0, 10]
        assert client.submit(FAKE, name="mine").sweep == "mine"
        keys = {request.partition(b"Idempotency-Key: ")[2].partition(b"\r\n")[0].lower() for request in proxy.requests}
        assert (len(keys), len(proxy.requests)) == (1, 3)
    assert [job.sweep for job in live.service.queue.jobs()] == ["mine"]


def test_what_changes_something_is_not_asked_twice(live: Live) -> None:
    make_sweep_folder(live.storage / "done")
    with cutting_proxy(live.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [0]
        with pytest.raises(LostConnectionError, match="POST /api/v1/sweeps/done/extend") as caught:
            client.extend("done", 1)
        assert "not known whether it was done" in caught.value.hint
        assert len(proxy.requests) == 1


def test_a_connection_that_is_lost_again_and_again_is_told(site: Live) -> None:
    with cutting_proxy(site.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [0] * 20
        with pytest.raises(LostConnectionError, match=proxy.url):
            client.me()


# -- downloads


def test_a_download_goes_on_where_the_connection_was_lost(site: Live, tmp_path: Path) -> None:
    with cutting_proxy(site.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [300_000, 0, 200_000]
        assert client.download("mine", "films/after_mp4", tmp_path / "film").read_bytes() == FILM
        parts = [request.partition(b"Range: bytes=")[2].partition(b"-")[0] for request in proxy.requests]
        assert parts[0] == b""
        assert 0 < int(parts[1]) == int(parts[2]) < int(parts[3]) < len(FILM)


def test_a_download_that_changes_meanwhile_begins_anew(live: Live, tmp_path: Path) -> None:
    film = make_finished(live.storage / "mine").films()["after_mp4"]
    with cutting_proxy(live.url) as proxy, Client(proxy.url) as client:
        proxy.cuts = [300_000]
        real = connection_module.Connection.stream

        def stream(*args: Any, **options: Any) -> Any:
            if len(proxy.requests) == 1:
                film.write_bytes(b"b" * len(FILM))
            return real(*args, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(connection_module.Connection, "stream", stream)
            assert client.download("mine", "films/after_mp4", tmp_path / "film").read_bytes() == b"b" * len(FILM)
