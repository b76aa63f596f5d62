"""Figures look as they are meant, whatever style the caller of matplotlib has set for others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib import style
from matplotlib.colors import to_hex
from synthetic_sweep import make_sweep

from analysis.exports.frames import SweepData
from analysis.exports.paper import learning_figure, save_figure
from analysis.page import charts
from analysis.page.figures import draw_figures
from analysis.page.source import Source

OTHER = {
    "font.family": "serif", "lines.dashed_pattern": [9.0, 9.0], "savefig.bbox": "tight", "text.usetex": True,
    "text.latex.preamble": r"\usepackage{of_nobody}", "axes.spines.bottom": False,
}  # fmt: skip


def report_in(folder: Path) -> None:
    made = make_sweep()
    source = Source("mine", made.sweep, made.trials, made.results, made.best, goal=195.0)
    draw_figures(source, folder)
    charts.make(source, folder)


def paper_in(folder: Path) -> None:
    made = make_sweep()
    data = SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=195.0)
    for kind in ("pdf", "png", "svg"):
        save_figure(learning_figure([("mine", data)]), folder / f"figure.{kind}")


@pytest.mark.parametrize(("draw", "ours"), [(report_in, OTHER), (paper_in, {"savefig.bbox": "tight"})])
def test_files_are_the_same_in_another_style(
    draw: Callable[[Path], None], ours: dict[str, object], tmp_path: Path
) -> None:
    draw(tmp_path / "usual")
    with style.context(["dark_background", ours]):
        before = mpl.rcParams.copy()
        draw(tmp_path / "other")
        assert dict.items(mpl.rcParams) == dict.items(before)
    names = sorted(path.name for path in (tmp_path / "usual").iterdir())
    assert len(names) >= 3
    assert [(tmp_path / "other" / name).read_bytes() == (tmp_path / "usual" / name).read_bytes() for name in names] == [
        True
    ] * len(names)


def test_a_papers_figure_has_the_papers_fonts() -> None:
    made = make_sweep()
    data = SweepData(made.trials, made.results, "final", num_env_steps=50_000, threshold=195.0)
    with style.context(["dark_background", {"font.family": "serif", "text.usetex": True}]):
        (axes,) = learning_figure([("mine", data)]).axes
    assert to_hex(axes.get_facecolor()) == "#ffffff"
    assert axes.xaxis.label.get_fontfamily() == ["serif"]
    assert axes.xaxis.label.get_usetex()
