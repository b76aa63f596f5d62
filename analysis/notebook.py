"""What results look like in a notebook, and how much of them is printed: small tables, films, short reprs.

A notebook asks an object for `_repr_html_`; all text is escaped here, and bounded, because a notebook's file keeps it.
"""

from __future__ import annotations

import base64
import reprlib
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

_MAX_CHARS = 300
_MAX_ROWS = 20
_MAX_FACTS = 30
_MAX_FILM_BYTES = 4_000_000
_MAX_SHOWN = 10
_MAX_ITEM_CHARS = 1_500

_Item = TypeVar("_Item")

_BRIEF = reprlib.Repr()
_BRIEF.maxlevel = 3
_BRIEF.maxdict = 12
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxset = 6
_BRIEF.maxstring = 100
_BRIEF.maxother = 300
_BRIEF.maxlong = 40


class Brief:
    """A value whose repr is short, whatever it holds."""

    def __init__(self, value: Any) -> None:
        self._value = value

    def __repr__(self) -> str:
        return _BRIEF.repr(self._value)


class BriefList(list[_Item]):
    """A list that prints its first items only."""

    def __repr__(self) -> str:
        shown = ", ".join(_cut(repr(item), _MAX_ITEM_CHARS) for item in self[:_MAX_SHOWN])
        more = f", ... and {len(self) - _MAX_SHOWN:,} more" if len(self) > _MAX_SHOWN else ""
        return f"[{shown}{more}]"


def brief_repr(name: str, /, **values: Any) -> str:
    """Return the repr of an object of a class called `name`, with short values."""
    return f"{name}({', '.join(f'{key}={Brief(value)!r}' for key, value in values.items())})"


def facts_html(title: str, facts: Mapping[str, str | Path]) -> str:
    """Return a title and facts, one name with its text per line; paths become links."""
    rows = "".join(
        f'<tr><th style="text-align:left;vertical-align:top">{_escaped(name)}</th>'
        f'<td style="text-align:left">{_link(text) if isinstance(text, Path) else _escaped(text)}</td></tr>'
        for name, text in list(facts.items())[:_MAX_FACTS]
    )
    return f"<div><strong>{_escaped(title)}</strong><table>{rows}</table></div>"


def rows_html(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of the first rows; below it stands how many there are more."""
    head = "".join(f'<th style="text-align:left">{_escaped(title)}</th>' for title in titles[:_MAX_ROWS])
    body = "".join(
        "<tr>" + "".join(f'<td style="text-align:left">{_escaped(cell, 60)}</td>' for cell in row[:_MAX_ROWS]) + "</tr>"
        for row in rows[:_MAX_ROWS]
    )
    more = f"<p>and {len(rows) - _MAX_ROWS:,} more</p>" if len(rows) > _MAX_ROWS else ""
    return f"<div><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}</div>"


def film_html(films: Sequence[Path]) -> str:
    """Return the first film that can be read and is not too large, within the page; and links to all of them."""
    for path in films:
        try:
            if path.stat().st_size > _MAX_FILM_BYTES:
                continue
            data = base64.b64encode(path.read_bytes()).decode()
        except OSError:
            continue
        if path.suffix == ".mp4":
            seen = f'<video controls loop muted style="max-width:100%" src="data:video/mp4;base64,{data}"></video>'
        else:
            seen = f'<img alt="{_escaped(path.name)}" style="max-width:100%" src="data:image/gif;base64,{data}">'
        return f"<div>{seen}<p>{_links(films)}</p></div>"
    return f"<div><p>{_links(films)}</p></div>"


def page_html(path: Path) -> str:
    """Return a link to a page that is too large to be held within a notebook, and the page itself, folded."""
    if not path.is_file():
        return f"<div>{_escaped(str(path))} is gone.</div>"
    frame = ""
    if _from_here(path) is not None:
        frame = (
            "<details><summary>show it here</summary>"
            f'<iframe loading="lazy" style="width:100%;height:600px" src="{_address(path)}"></iframe></details>'
        )
    return f"<div>{_link(path)}{frame}</div>"


def _links(paths: Sequence[Path]) -> str:
    return ", ".join(map(_link, paths[:_MAX_FACTS]))


def _link(path: Path) -> str:
    return f'<a href="{_address(path)}" target="_blank">{_escaped(str(path))}</a>'


def _address(path: Path) -> str:
    # A notebook's page opens what lies below its folder, which is mostly the working directory.
    here = _from_here(path)
    return escape(quote(str(here)) if here is not None else path.absolute().as_uri())


def _from_here(path: Path) -> Path | None:
    try:
        return path.absolute().relative_to(Path.cwd())
    except (ValueError, OSError):
        return None


def _escaped(text: str, most: int = _MAX_CHARS) -> str:
    return escape(_cut(text, most))


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}\u2026"
