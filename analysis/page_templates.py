"""The templates of the pages, templates/*, and the files that stand in a page as they are."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import jinja2

_FOLDER = "templates"


def make_environment() -> jinja2.Environment:
    """Return Jinja's environment for the templates: what they fill in is escaped, and what is missing is an error."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("analysis", _FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def template_file(name: str) -> str:
    """Return a file that is no template, such as a style sheet: "vendor/echarts/echarts.min.js"."""
    return files("analysis").joinpath(_FOLDER, name).read_bytes().decode("utf-8")
