"""Write figures beside the page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from analysis.plot_style import to_pdf, to_png, to_svg_file
from policies.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figure(figure: Figure, path: Path, *, png: bool = False) -> str:
    """Write a figure as SVG and PDF, and return its SVG.

    Args:
        figure: The figure.
        path: The file without its suffix.
        png: Whether to write it as PNG, too.

    Raises:
        CannotRunError: A file cannot be written.
    """
    svg = to_svg_file(figure)
    write_atomic(path.with_suffix(".svg"), svg)
    write_atomic(path.with_suffix(".pdf"), to_pdf(figure))
    if png:
        write_atomic(path.with_suffix(".png"), to_png(figure))
    return svg
