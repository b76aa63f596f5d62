"""The site of the documentation: it builds without a warning, its links lead somewhere, and it needs no network."""

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from analysis.best_records import EvaluationRecord
from analysis.records import TrialRecord
from policies.hyperparams import HYPERPARAMS_BY_ALGORITHM
from tests.narrowing import present
from tune_jobs.spec.domains import DOMAIN_KINDS
from tune_jobs.spec.file import list_presets
from tune_jobs.spec.sweep_spec import SweepSpec

pytest.importorskip("mkdocs")

ROOT = Path(__file__).parents[2]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MOST_WORDS = 1_300


class Page(HTMLParser):
    """What a page links to and loads, its anchors, its text, and that of its paragraphs and of its tables' rows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.anchors: set[str] = set()
        self.text = ""
        self.paragraphs: list[str] = []
        self.rows: list[list[str]] = []
        self._inside: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self._inside.add(tag)
        if tag == "p":
            self.paragraphs.append("")
        elif tag == "tr":
            self.rows.append([])
        elif tag == "td":
            self.rows[-1].append("")
        self.anchors |= {present(found["id"])} if "id" in found else set()
        if tag == "a" and found.get("href"):
            self.links.append(present(found["href"]))
        elif tag == "link" and found.get("rel") not in ("prev", "next", "canonical"):
            self.loads.append(present(found["href"]))
        elif found.get("src"):
            self.loads.append(present(found["src"]))

    def handle_endtag(self, tag: str) -> None:
        self._inside.discard(tag)

    def handle_data(self, data: str) -> None:
        self.text += data
        if "p" in self._inside:
            self.paragraphs[-1] += data
        if "td" in self._inside:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder)]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr  # of warnings, too
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path.read_text()) for path in sorted(site.rglob("*.html"))}


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= MOST_WORDS


def test_every_link_leads_to_a_page_and_a_place_on_it(site: Path, pages: dict[Path, Page]) -> None:
    lost = set()
    for path, page in pages.items():
        if path.name == "404.html":  # its links are of a server's root
            continue
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file() or (parts.fragment and parts.fragment not in pages[target].anchors):
                lost.add(f"{path.relative_to(site)}: {link}")
    assert lost == set()


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    loaded = {(path.relative_to(site), load) for path, page in pages.items() for load in page.loads}
    assert {(path, load) for path, load in loaded if urlsplit(load).scheme not in ("", "data")} == set()
    styles = "".join(path.read_text() for path in site.rglob("*.css"))
    assert re.findall(r"url\(\s*['\"]?(?:https?:)?//|@import", styles) == []
    # The theme fetches a library where there are diagrams.
    assert not any('class="mermaid"' in path.read_text() for path in pages)


def test_what_the_code_knows_is_on_the_pages_that_are_drawn_from_it(site: Path, pages: dict[Path, Page]) -> None:
    def text(name: str) -> str:
        return pages[site / name].text

    fields = {name for model in HYPERPARAMS_BY_ALGORITHM.values() for name in model.model_fields}
    assert {name for name in fields if name not in text("reference/hyperparameters.html")} == set()
    known = [*SweepSpec.model_fields, *DOMAIN_KINDS]
    assert {name for name in known if name not in text("reference/sweep-file.html")} == set()
    assert {preset.name for preset in list_presets() if preset.expected not in text("presets.html")} == set()
    examples = [path for ending in ("py", "yaml") for path in (ROOT / "docs" / "examples").rglob(f"*.{ending}")]
    assert {path.name for path in examples if path.read_text().strip() not in text("examples/index.html")} == set()
    assert not any(mark in path.read_text() for path in pages for mark in ("<!-- table", "<!-- file"))


def test_the_python_api_says_where_names_are_from_and_what_fields_are(site: Path, pages: dict[Path, Page]) -> None:
    text = pages[site / "reference" / "python-api.html"].text
    entries = re.findall(r"^::: ([\w.]+)$", (ROOT / "docs" / "reference" / "python-api.md").read_text(), re.MULTILINE)
    assert len(entries) > 60
    assert {path for path in entries if not re.search(rf"(?<![\w.]){re.escape(path)}(?![\w.])", text)} == set()
    # TrialRecord's are inherited.
    fields = [*EvaluationRecord.model_fields.values(), *TrialRecord.model_fields.values()]
    described = [field.description for field in fields if field.description]
    assert len(described) > 15
    assert {told for told in described if told not in text} == set()
    assert re.findall(r"\b[Ff]ield\(.*", text) == []
    assert "model_config" not in text


def test_no_list_table_or_code_has_run_into_a_paragraph(site: Path, pages: dict[Path, Page]) -> None:
    """Python-Markdown wants an empty line before each, and four spaces before what belongs to an item of a list."""
    begins = re.compile(r"^ *([-*] |\d+\. |\||```)", re.MULTILINE)
    assert sum(len(page.paragraphs) for page in pages.values()) > 1_000
    run_in = {
        f"{path.relative_to(site)}: {text[max(0, found.start() - 60) : found.start() + 20]!r}"
        for path, page in pages.items()
        for text in page.paragraphs
        if (found := begins.search(text)) is not None
    }
    assert run_in == set()


def test_the_fields_of_a_sweep_file_have_their_values_and_defaults(site: Path, pages: dict[Path, Page]) -> None:
    rows = [row for row in pages[site / "reference" / "sweep-file.html"].rows if row]
    fields = {row[0]: row[1:3] for row in rows}
    assert fields["confirm"][0] == "none or true or false or mapping, below"
    assert fields["cost"] == ["env_steps or null", "null"]
    assert fields["source"] == ["text", "empty"]  # of `about`


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_search_works_in_files_that_no_server_serves(site: Path, tmp_path: Path) -> None:
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-sync"
    page = f"{(site / 'index.html').as_uri()}?q=vf_clip_param"
    done = subprocess.run(
        [present(CHROMIUM), *flags.split(), "--host-resolver-rules=MAP * ~NOTFOUND",
         f"--user-data-dir={tmp_path}/profile", "--virtual-time-budget=20000", "--dump-dom", page],
        capture_output=True, text=True, check=True, timeout=600,
    )  # fmt: skip
    found = re.findall(r'href="([^"#?]*)[^"]*" class="md-search-result__link"', done.stdout)
    assert (site / "reference" / "hyperparameters.html").as_uri() in found
