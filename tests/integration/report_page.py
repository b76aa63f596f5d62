"""A page of HTML as the tests of the report look at it."""

from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

from synthetic_sweep import Synthetic

from analysis.report import build_report


class Page(HTMLParser):
    """Text, tags and table rows of a page."""

    VOID = frozenset({"meta", "img", "br", "link", "input", "hr"})

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == [], f"never closed: {self.open}"
        self.words = " ".join(" ".join(self.text).split())

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in {"style", "script"}:
            self.text.append(data)
            if self.rows and ("td" in self.open or "th" in self.open):
                self.rows[-1][-1] += data.strip()


def report(tmp_path: Path, synthetic: Synthetic, videos: dict[str, Path] | None = None) -> tuple[Path, str, Page]:
    """Write the report of a sweep; its path, its HTML and what is on the page."""
    path = build_report(
        str(tmp_path),
        target=tmp_path / "report",
        sweep=synthetic.sweep,
        trials=synthetic.trials,
        results=synthetic.results,
        best=synthetic.best,
        videos=videos or {},
    )
    html = path.read_text(encoding="utf-8")
    return path, html, Page(html)
