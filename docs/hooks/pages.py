"""What MkDocs calls while it builds the site: pages of files outside of docs/, tables in the place of their marks.

A page has a mark such as `<!-- table: hyperparameters -->` where a table is drawn from the code, and one such as
`<!-- file: from_python.py -->` where a file beside it is shown. The README is the home of the
site. Links are written so that they hold where the files lie, and are led to the site's pages here.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File

# MkDocs loads a hook by its file alone.
sys.path.insert(0, str(Path(__file__).parent))
import site_tables

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "docker/README.md": "docker.md",
}
"""Files outside of docs/ that are pages, and the pages' names."""
_SOURCES = {page: source for source, page in OUTSIDE.items()}
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s:#]+)(#[^)\s]*)?\)")
_FILE = re.compile(r"<!-- file: ([\w./-]+)\.(\w+) -->")
_LANGUAGES = {"py": "python", "yaml": "yaml"}
_MARK = re.compile(r"<!-- table: ([\w-]+) -->")
_CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages of files outside of docs/."""
    for source, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Draw the page's tables, and lead its links to pages of the site."""
    text = _MARK.sub(lambda mark: site_tables.TABLES[mark[1]](), markdown)
    here = page.file.src_uri
    text = _FILE.sub(lambda mark: _shown(mark, here), text)
    # Code is left as it is.
    parts = _CODE.split(text)
    parts[::2] = [_LINK.sub(lambda link: _led(link, here), part) for part in parts[::2]]
    return "".join(parts)


def _shown(mark: re.Match[str], here: str) -> str:
    """A file beside the page, as code with its name."""
    name = f"{mark[1]}.{mark[2]}"
    text = (ROOT / "docs" / posixpath.dirname(here) / name).read_text(encoding="utf-8")
    return f'```{_LANGUAGES[mark[2]]} title="{name}"\n{text}```'


def _led(link: re.Match[str], here: str) -> str:
    """A link of a page, to another page; to a file that is on no page: its text alone."""
    picture, text, target, anchor = link.groups()
    folder = posixpath.dirname(_SOURCES.get(here, f"docs/{here}"))
    file = posixpath.normpath(posixpath.join(folder, target))
    if (ROOT / file).is_dir():
        file = f"{file}/README.md"
    page = OUTSIDE.get(file, file.removeprefix("docs/") if file.startswith("docs/") else None)
    if page is None and (ROOT / file).exists():
        return text
    # What is not there is left to MkDocs, which refuses it.
    target = target if page is None else posixpath.relpath(page, posixpath.dirname(here) or ".")
    return f"{picture}[{text}]({target}{anchor or ''})"
