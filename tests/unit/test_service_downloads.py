"""Downloads over real HTTP: found by what they are, whole and in parts."""

import csv
import io
import json
import os
import socket
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from fake_sweeps import run  # noqa: F401 (a fixture)
from live_service import Live, live, serving, wait_until  # noqa: F401 (a fixture)
from policy_factory import make_portable
from store_parts import make_best
from sweep_folders import chosen, extend_by_leaders, make_sweep_folder

from policies.portable.file import read_policy
from tune_jobs.service import derived
from tune_jobs.store.sweep_store import SweepStore
from tune_jobs.sweeps.results import importance_of

# ruff: noqa: F811 - fixtures are named as arguments

PAGE = "<!DOCTYPE html><title>mine</title><script>document.title = 'ran'</script>"
FILM = bytes(range(256)) * 4_000


def make_finished(folder: Path, **spec: Any) -> SweepStore:
    """A sweep that has ended, with a winner, films and a report."""
    made = make_sweep_folder(folder, **spec)
    made.write_best(make_best(**chosen(made)), make_portable("CartPole-v1"))
    with made.writing_films() as films:
        for path in films.values():
            path.write_bytes(FILM)
    with made.writing_report() as report:
        (report / "figures").mkdir(parents=True)
        (report / "index.html").write_text(PAGE)
        (report / "iterations.csv").write_text("trial_id\nt0000\n")
        (report / "figures" / "curves.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    return made


@pytest.fixture
def store(live: Live) -> SweepStore:
    return make_finished(live.storage / "mine")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Live]:
    """A service with such a sweep, for tests that only look."""
    with serving(tmp_path_factory.mktemp("site") / "sweeps") as made:
        folder = make_finished(made.storage / "mine", num_samples=8).report_folder
        (folder / ".hidden.html").write_text("being written")
        yield made


def store_of(live: Live) -> SweepStore:
    return SweepStore(live.storage / "mine")


def get(live: Live, path: str, **headers: str) -> httpx2.Response:
    return live.get(f"/sweeps/mine{path}", headers=headers)


def problem(answer: httpx2.Response, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


# -- what there is


def test_what_can_be_downloaded_is_listed_and_can_be(site: Live) -> None:
    found = get(site, "/files").json()
    assert {item["path"] for item in found} == {
        "report/index.html", "report/iterations.csv", "report/figures/curves.svg", "films/before_mp4",
        "films/after_mp4", "films/after_gif", "films/before_after_mp4", "policy/policy.json",
        "policy/policy.safetensors",
    }  # fmt: skip
    for item in found:
        answer = get(site, f"/{item['path']}")
        assert answer.status_code == 200
        assert len(answer.content) == item["num_bytes"] == int(answer.headers["content-length"])
        assert answer.headers["content-type"].split(";")[0] == item["media_type"].split(";")[0]


def test_a_sweep_that_has_made_nothing_says_so(live: Live) -> None:
    store = make_sweep_folder(live.storage / "mine")
    store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))
    assert get(live, "/files").json() == []
    assert "written when the sweep has ended" in get(live, "/report/index.html").json()["hint"]
    assert "has no report yet" in get(live, "/report/").json()["detail"]
    for path in ("/best", "/policy"):
        assert get(live, path).json()["hint"] == "It is chosen when the sweep has ended."
    for path in ("/report/", "/films/after_mp4", "/policy", "/policy/policy.json", "/best"):
        problem(get(live, path), 404)


def test_of_a_sweep_that_has_ended_no_policy_is_promised(live: Live) -> None:
    store = make_sweep_folder(live.storage / "mine")
    for path in ("/best", "/policy", "/policy/policy.json", "/play"):
        assert "has ended, and has no best policy" in problem(get(live, path), 404)
        assert get(live, path).json()["hint"] == "Resume it: then one is chosen, or it is said why not."
    with store.lock():
        # Its trials have ended, and one is being chosen.
        assert get(live, "/best").json()["hint"] == "It is chosen when the sweep has ended."


def test_a_policy_that_was_chosen_before_its_sweep_was_extended_is_not_its_best(live: Live, store: SweepStore) -> None:
    assert get(live, "/best").json()["checkpoint"]["trial_id"] == "t0003"
    extend_by_leaders(store)
    for path in ("/best", "/policy", "/policy/policy.json", "/play"):
        assert "chosen before the sweep was trained on" in problem(get(live, path), 404)
        assert get(live, path).json()["hint"] == "Resume it: then one is chosen anew."
    assert {item["path"].split("/")[0] for item in get(live, "/files").json()} == {"report"}
    # While it runs, and where it was interrupted, the page tells it as an earlier one.
    with store.lock():
        assert get(live, "/best").json()["checkpoint"]["trial_id"] == "t0003"
        assert get(live, "/policy").status_code == 200
    store.write_record(store.read_record().model_copy(update={"state": "interrupted"}))
    assert get(live, "/best").json()["checkpoint"]["trial_id"] == "t0003"


def test_downloads_are_described(site: Live) -> None:
    paths = site.get("/openapi.json").json()["paths"]
    begin = "/api/v1/sweeps/{name}"
    told = {path.removeprefix(begin): sorted(paths[path]) for path in paths if path.startswith(begin)}
    for path in ("/report/{path}", "/films/{film}", "/policy", "/policy/{file}", "/events", "/curves"):
        assert told[path] == ["get"]
        assert paths[begin + path]["get"]["summary"]
    archive = paths[f"{begin}/trials/{{trial_id}}/checkpoints/{{iteration}}"]["get"]["responses"]["200"]["content"]
    assert list(archive) == ["application/zip"]


@pytest.mark.parametrize(
    "path",
    [
        "/files", "/report/index.html", "/films/after_mp4", "/policy", "/trials/t0000/checkpoints/6", "/trials.csv",
        "/best", "/importance", "/front",
    ],
)  # fmt: skip
def test_there_is_nothing_of_an_unknown_sweep(site: Live, path: str) -> None:
    problem(site.get(f"/sweeps/other{path}"), 404)


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/report/nothing.html", 404),
        ("/report/figures", 404),
        ("/report/../sweep.json", 404),
        ("/report/..%2fsweep.json", 404),
        ("/report/%2e%2e/sweep.json", 404),
        ("/report//etc/passwd", 404),
        ("/report/figures/../index.html", 404),
        ("/report/index.html%00.svg", 404),
        ("/report/.hidden.html", 404),
        ("/films/films.json", 422),
        ("/films/..%2fpolicy.json", 404),
        ("/policy/evaluation.json", 404),
        ("/policy/..%2f..%2fsweep.json", 404),
        ("/trials/t9999/checkpoints/6", 404),
        ("/trials/..%2ft0000/checkpoints/6", 404),
        ("/trials/%2e%2e/checkpoints/6", 404),
        ("/trials/t0000/checkpoints/1", 404),
        ("/trials/t0000/checkpoints/-1", 422),
        ("/trials/t0000/checkpoints/99999999999999999999", 422),
        ("/trials/t0000/checkpoints/x", 422),
    ],
)
def test_nothing_is_found_by_another_name(site: Live, path: str, status: int) -> None:
    port = int(site.url.rpartition(":")[2])
    # As it stands: clients take dots out of a path.
    with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
        raw.sendall(
            f"GET /api/v1/sweeps/mine{path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode()
        )
        answer = b"".join(iter(lambda: raw.recv(65536), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(f"HTTP/1.1 {status}".encode()), head
    assert json.loads(body)["detail"]


# -- the report


def test_the_page_of_a_report_runs_apart_and_without_a_network(site: Live) -> None:
    for path in ("/report/index.html", "/report/"):
        answer = get(site, path)
        assert answer.text == PAGE
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        policy = dict(part.strip().partition(" ")[::2] for part in answer.headers["content-security-policy"].split(";"))
        assert policy["sandbox"] == "allow-scripts"
        assert policy["default-src"] == policy["base-uri"] == policy["form-action"] == "'none'"
        assert policy["script-src"] == "'unsafe-inline'"
        assert "http" not in answer.headers["content-security-policy"]
        assert "content-disposition" not in answer.headers
    picture = get(site, "/report/figures/curves.svg").headers
    assert picture["content-type"] == "image/svg+xml"
    assert "allow-scripts" not in picture["content-security-policy"]
    assert "sandbox" in picture["content-security-policy"]
    table = get(site, "/report/iterations.csv").headers
    assert table["content-disposition"] == 'attachment; filename="mine-iterations.csv"'


# -- parts


@pytest.mark.parametrize(
    ("wanted", "begin", "end"),
    [("bytes=0-99", 0, 100), ("bytes=1000-", 1_000, None), ("bytes=-17", -17, None), ("bytes=0-99999999999", 0, None)],
)
def test_a_part_of_a_file_is_that_part(site: Live, wanted: str, begin: int, end: int | None) -> None:
    answer = get(site, "/films/after_mp4", Range=wanted)
    assert answer.status_code == 206
    assert answer.content == FILM[begin:end]
    first = begin % len(FILM)
    assert answer.headers["content-range"] == f"bytes {first}-{first + len(answer.content) - 1}/{len(FILM)}"
    assert answer.headers["content-type"] == "video/mp4"


def test_a_part_that_is_not_there_is_a_problem(site: Live) -> None:
    answer = get(site, "/films/after_mp4", Range=f"bytes={len(FILM)}-")
    assert f"{len(FILM):,} bytes" in problem(answer, 416)
    assert answer.headers["content-range"] == f"bytes */{len(FILM)}"
    for wanted in ("metres=0-5", "bytes", "bytes=", "bytes=x-y", "bytes=9-5"):
        problem(get(site, "/films/after_mp4", Range=wanted), 400)


def test_a_download_that_was_cut_is_continued_if_the_file_is_the_same(live: Live, store: SweepStore) -> None:
    with httpx2.stream("GET", f"{live.url}/api/v1/sweeps/mine/films/after_mp4") as answer:
        begun = next(answer.iter_bytes(1_000))
        tag = answer.headers["etag"]
    rest = {"Range": f"bytes={len(begun)}-", "If-Range": tag}
    answer = get(live, "/films/after_mp4", **rest)
    assert (answer.status_code, begun + answer.content) == (206, FILM)
    path = store.films()["after_mp4"]
    path.with_name("new").write_bytes(FILM[::-1])
    # Within the time that a file system tells apart.
    os.utime(path.with_name("new"), ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    path.with_name("new").replace(path)
    # Another file: all of it comes.
    answer = get(live, "/films/after_mp4", **rest)
    assert (answer.status_code, answer.content) == (200, FILM[::-1])
    assert answer.headers["etag"] != tag


def test_a_file_that_a_client_has_is_not_sent_again(site: Live) -> None:
    first = get(site, "/report/index.html")
    for known in (first.headers["etag"], f'"other", {first.headers["etag"]}', f"W/{first.headers['etag']}", "*"):
        again = get(site, "/report/index.html", **{"If-None-Match": known})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == first.headers["etag"]
    assert get(site, "/report/index.html", **{"If-None-Match": '"other"'}).status_code == 200
    # What is asked for each time may be kept.
    assert first.headers["cache-control"] == "private, no-cache"


@pytest.mark.parametrize("path", ["/report/", "/report/figures/curves.svg", "/films/after_mp4"])
def test_a_file_that_a_client_has_may_do_what_it_might_before(site: Live, path: str) -> None:
    """Of an answer 304, a browser takes each header over into what it has stored, and leaves the others."""
    first = get(site, path).headers
    again = get(site, path, **{"If-None-Match": first["etag"]})
    assert again.status_code == 304
    names = ("content-security-policy", "content-type", "cache-control", "etag", "last-modified")
    assert {name: (first | again.headers)[name] for name in names} == {name: first[name] for name in names}


def test_heads_are_answered_as_downloads_are(site: Live) -> None:
    for path in ("report/index.html", "films/after_mp4", "policy/policy.json"):
        answer = httpx2.head(f"{site.url}/api/v1/sweeps/mine/{path}")
        assert (answer.status_code, answer.content) == (200, b"")
        assert int(answer.headers["content-length"]) > 0


def num_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_half_read_downloads_hold_nothing(live: Live, store: SweepStore) -> None:
    path = store.films()["after_mp4"]
    path.write_bytes(bytes(20_000_000))
    before = num_descriptors()
    for what in ("films/after_mp4", "policy", "trials/t0000/checkpoints/6"):
        for _ in range(5):
            with httpx2.stream("GET", f"{live.url}/api/v1/sweeps/mine/{what}") as answer:
                next(answer.iter_bytes(100))
    wait_until(lambda: num_descriptors() <= before)
    assert get(live, "/films/after_mp4", Range="bytes=-1").status_code == 206


# -- archives


def unpacked(answer: httpx2.Response, folder: Path) -> Path:
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        archive.extractall(folder)
    return folder


def test_the_policy_comes_as_an_archive_that_can_be_loaded(site: Live, tmp_path: Path) -> None:
    answer = get(site, "/policy")
    folder = unpacked(answer, tmp_path / "policy")
    assert answer.headers["content-disposition"] == 'attachment; filename="mine-policy.zip"'
    assert read_policy(folder).env_id == read_policy(store_of(site).best_folder).env_id
    assert {path.name for path in folder.iterdir()} == {"policy.json", "policy.safetensors"}
    # The same files are the same archive.
    assert get(site, "/policy").content == answer.content


def test_a_checkpoint_comes_as_an_archive_that_is_whole(site: Live, tmp_path: Path) -> None:
    answer = get(site, "/trials/t0003/checkpoints/6")
    folder = unpacked(answer, tmp_path / "checkpoint")
    assert answer.headers["content-disposition"] == 'attachment; filename="mine-t0003-000006.zip"'
    original = store_of(site).trial("t0003").checkpoint_folder(6)
    names = {path.relative_to(original).as_posix() for path in original.rglob("*") if path.is_file()}
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} == names
    for name in names:
        assert (folder / name).read_bytes() == (original / name).read_bytes()


def test_a_checkpoint_that_was_changed_is_not_sent(live: Live, store: SweepStore) -> None:
    (store.trial("t0003").checkpoint_folder(6) / "engine.json").write_text('{"iteration": 7}')
    assert "SHA-256 differs" in problem(get(live, "/trials/t0003/checkpoints/6"), 500)


# -- tables and answers


def test_trials_are_a_table(live: Live, store: SweepStore) -> None:
    trial = store.trial("t0001")
    trial.write_record(trial.read_record().model_copy(update={"status": "failed", "error": "=HYPERLINK(1)"}))
    answer = get(live, "/trials.csv")
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    assert answer.headers["content-disposition"] == 'attachment; filename="mine-trials.csv"'
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["trial_id"] for row in rows] == ["t0000", "t0001", "t0002", "t0003"]
    assert rows[3]["score"] == "36.0"
    # A spreadsheet would run it.
    assert rows[1]["error"].startswith("'=")


def test_answers_are_those_of_the_commands(site: Live, run: Any, tmp_path: Path) -> None:
    result = run("importance", "mine", "--storage", site.storage, "--json")
    assert get(site, "/importance").json() == json.loads(result.stdout)
    best = get(site, "/best").json()
    assert best["checkpoint"]["trial_id"] == "t0003"
    assert best["optimism_gap"] == store_of(site).read_best().optimism_gap


def test_importance_is_found_out_once_until_trials_change(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    store, asked = make_finished(live.storage / "mine", num_samples=8), list[str]()

    def count(sweep: Any) -> Any:
        asked.append(sweep.name)
        return importance_of(sweep)

    monkeypatch.setattr("tune_jobs.sweeps.results.importance_of", count)
    for _ in range(3):
        first = get(live, "/importance").json()
    assert len(asked) == 1
    trial = store.trial("t0001")
    with store.lock():
        trial.write_record(trial.read_record().model_copy(update={"status": "failed"}))
        # While it runs, not at each change: that would take all the time.
        monkeypatch.setattr(derived, "_SHARE", 1e-9)
        assert get(live, "/importance").json() == first
        assert len(asked) == 1
    assert get(live, "/importance").json() != first
    assert len(asked) == 2
