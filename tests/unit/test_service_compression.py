"""Large answers in JSON come compressed to those who take them so; files and streams come as they are."""

import gzip
import http.client
import json
from collections.abc import Iterator

import pytest
from live_service import Live, serving
from sweep_folders import make_sweep_folder

from tune_jobs.service.http.compression import MIN_BYTES

MANY = "/api/v1/sweeps/mine/trials"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service of a sweep of 40 trials."""
    folder = tmp_path_factory.mktemp("site") / "sweeps"
    store = make_sweep_folder(folder / "mine", num_samples=20)
    with store.writing_report() as report:
        report.mkdir()
        (report / "large.json").write_text(json.dumps(["a"] * MIN_BYTES))
    with serving(folder) as made:
        yield made


def ask(live: Live, path: str, accepted: str | None, method: str = "GET") -> tuple[http.client.HTTPResponse, bytes]:
    """An answer as it came, and its body."""
    connection = http.client.HTTPConnection(live.url.removeprefix("http://"), timeout=30)
    # Without this, the client would say that it takes everything as it is.
    connection.putrequest(method, path, skip_accept_encoding=True)
    if accepted is not None:
        connection.putheader("Accept-Encoding", accepted)
    connection.endheaders()
    answer = connection.getresponse()
    try:
        return answer, answer.read()
    finally:
        connection.close()


@pytest.mark.parametrize("accepted", ["gzip", "gzip, deflate, br", "br;q=1.0, GZIP;q=0.5", "*"])
def test_a_large_answer_is_a_fraction_of_its_size(site: Live, accepted: str) -> None:
    plain, whole = ask(site, MANY, None)
    answer, body = ask(site, MANY, accepted)
    assert answer.status == 200
    assert (answer.headers["Content-Encoding"], answer.headers["Vary"]) == ("gzip", "Accept-Encoding")
    assert int(answer.headers["Content-Length"]) == len(body) < len(whole) / 4
    assert gzip.decompress(body) == whole
    for name in ("Content-Type", "Cache-Control", "Content-Security-Policy"):
        assert answer.headers[name] == plain.headers[name]


@pytest.mark.parametrize("accepted", [None, "", "identity", "br", "gzip;q=0", "gzip; q=0.0, br"])
def test_who_takes_none_gets_it_as_it_is(site: Live, accepted: str | None) -> None:
    answer, body = ask(site, MANY, accepted)
    assert "Content-Encoding" not in answer.headers
    assert int(answer.headers["Content-Length"]) == len(body) > MIN_BYTES
    assert len(json.loads(body)["trials"]) == 40


@pytest.mark.parametrize(
    "path", ["/api/v1/me", "/api/v1/sweeps/mine/report/large.json", "/metrics", "/static/js/main.js", "/api/v1/nothing"]
)
def test_small_answers_files_and_what_is_no_json_come_as_they_are(site: Live, path: str) -> None:
    plain, body = ask(site, path, "gzip")
    assert "Content-Encoding" not in plain.headers
    assert int(plain.headers["Content-Length"]) == len(body) > 0


def test_the_clients_of_this_package_understand_it(site: Live) -> None:
    assert len(site.get("/sweeps/mine/trials").json()["trials"]) == 40


def test_a_stream_comes_as_it_happens(site: Live) -> None:
    with site.events("/sweeps/mine/events") as reader:
        reader.wait_for(lambda: reader.of("status"))
        assert "content-encoding" not in (reader._answer.headers if reader._answer is not None else {})
