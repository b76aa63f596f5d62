"""Nothing is downloaded through links, or from what is no file."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_service import Live, live  # noqa: F401 (a fixture)
from test_service_downloads import get, problem, store  # noqa: F401 (a fixture)

from policies.errors import CheckpointError, NotFoundError
from tune_jobs.service.http.downloads import Download
from tune_jobs.store.sweep_store import SweepStore

# ruff: noqa: F811 - fixtures are named as arguments


@pytest.fixture
def secret(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "secret.txt"
    path.write_text("thesis")
    yield path
    assert path.read_text() == "thesis"


@pytest.mark.parametrize(
    ("link", "path"),
    [
        ("report/index.html", "/report/index.html"),
        ("report/figures/curves.svg", "/report/figures/curves.svg"),
        ("report", "/report/index.html"),
        ("best/after.mp4", "/films/after_mp4"),
        ("best/policy.safetensors", "/policy"),
        ("best/policy.json", "/policy/policy.json"),
        ("best/evaluation.json", "/best"),
        ("trials/t0003/checkpoints/000006/policy.json", "/trials/t0003/checkpoints/6"),
        ("trials/t0003/checkpoints/000006/manifest.json", "/trials/t0003/checkpoints/6"),
        ("trials/t0003/checkpoints/000006", "/trials/t0003/checkpoints/6"),
    ],
)
def test_links_are_not_followed(live: Live, store: SweepStore, secret: Path, link: str, path: str) -> None:
    assert get(live, path).status_code == 200
    place = store.folder / link
    target = secret
    if place.is_dir():
        # The same content, but elsewhere.
        target = secret.with_name("elsewhere")
        place.rename(target)
    else:
        place.unlink()
    place.symlink_to(target)
    assert "symbolic link" in problem(get(live, path), 500)
    assert get(live, "/files").status_code == (200 if link.startswith("trials") else 500)


def test_what_is_no_file_is_not_opened(live: Live, store: SweepStore) -> None:
    path = store.films()["after_mp4"]
    path.unlink()
    os.mkfifo(path)
    # Opening it would wait for ever.
    problem(get(live, "/films/after_mp4"), 404)
    os.mkfifo(store.report_folder / "pipe.csv")
    problem(get(live, "/report/pipe.csv"), 404)
    # Nor is one that takes a file's place after it was found.
    for name, kind in (("pipe.csv", CheckpointError), ("nothing.csv", NotFoundError)):
        with pytest.raises(kind):
            Download(store.report_folder / name, "text/csv")
    (store.report_folder / "link.csv").symlink_to(store.report_folder / "index.html")
    with pytest.raises(CheckpointError):
        Download(store.report_folder / "link.csv", "text/csv")
