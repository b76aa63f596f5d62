"""The page's files: what is served, with which headers, and that nothing in them needs more than the policy allows."""

import hashlib
import re
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from analysis.plot_style import CSS_DARK, CSS_LIGHT
from tune_jobs.service.http.problems import add_handlers
from tune_jobs.service.page.routes import CONTENT_SECURITY_POLICY, router

STATIC = Path(str(files("tune_jobs.service.page"))) / "static"
OURS = [path for path in sorted(STATIC.rglob("*.*")) if "vendor" not in path.parts]


@pytest.fixture
def client() -> Iterator[TestClient]:
    app = FastAPI()
    add_handlers(app)
    app.include_router(router)
    with TestClient(app) as found:
        yield found


def test_the_page_may_load_from_its_own_service_alone(client: TestClient) -> None:
    answer = client.get("/")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["content-security-policy"] == CONTENT_SECURITY_POLICY
    assert "unsafe" not in CONTENT_SECURITY_POLICY


def test_all_that_the_page_names_is_served(client: TestClient) -> None:
    named = re.findall(r'(?:src|href)="(static/[^"]+)"', client.get("/").text)
    assert len(named) > 6
    for path in named:
        assert client.get(path).status_code == 200
    for path in STATIC.rglob("*.js"):
        for wanted in re.findall(r'from "\./([\w.]+)"', path.read_text()):
            assert client.get(f"/static/js/{wanted}").headers["content-type"].startswith("text/javascript"), wanted


def test_a_file_that_is_known_is_not_sent_again(client: TestClient) -> None:
    etag = client.get("/static/js/main.js").headers["etag"]
    again = client.get("/static/js/main.js", headers={"If-None-Match": f'W/"other", {etag}'})
    assert again.status_code == 304
    assert again.content == b""
    assert client.get("/static/js/main.js", headers={"If-None-Match": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "../routes.py",
        "..%2froutes.py",
        "js/../../routes.py",
        "/etc/passwd",
        "js",
        "",
        "js/main.js/",
        "C:\\boot.ini",
        "%00",
    ],
)
def test_nothing_else_is_served(client: TestClient, path: str) -> None:
    answer = client.get(f"/static/{path}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("path", OURS, ids=lambda path: path.name)
def test_files_of_the_page_have_nothing_inline_and_load_nothing_from_elsewhere(path: Path) -> None:
    text = path.read_text()
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", text)
    assert not re.search(r"\sstyle=|<style|javascript:|\son\w+=\"", text)
    foreign = set(re.findall(r"https?://[^\s\"')]+", text)) - {"http://www.w3.org/2000/svg"}
    assert not foreign
    assert not re.search(r"<script(?![^>]*\ssrc=)", text)
    assert len(text.splitlines()) <= 400


def test_colours_are_those_of_the_report() -> None:
    light, dark = (STATIC / "css" / "colours.css").read_text().split("@media")
    assert dict(re.findall(r"(--[\w-]+): (#\w+);", light)) == CSS_LIGHT
    differing = {name: value for name, value in CSS_DARK.items() if CSS_LIGHT.get(name) != value}
    assert dict(re.findall(r"(--[\w-]+): (#\w+);", dark)) == differing


def test_vendored_files_are_as_they_were_published() -> None:
    folder = STATIC / "vendor" / "uplot"
    lines = [line.split() for line in (folder / "SHA256SUMS").read_text().splitlines()]
    listed = {name: digest for digest, name in lines}
    assert set(listed) == {path.name for path in folder.iterdir()} - {"SHA256SUMS", "README.md"}
    for name, digest in listed.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    version = re.search(r"v(\d+\.\d+\.\d+)", (folder / "uPlot.iife.min.js").read_text()[:200])
    assert version is not None
    assert f"uPlot {version[1]}," in (folder / "README.md").read_text()
