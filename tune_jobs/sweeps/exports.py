"""A sweep in other forms: tables, a LaTeX table, an Optuna study, a figure for a paper, one file to send on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from analysis.exports.frames import ROWS, Rows, SweepData
from policies.arguments import Inches, PositiveInt, checked
from policies.errors import CannotRunError, SpecError
from policies.files import is_output_folder
from tune_jobs.sweeps.gathered import spec_of, sweep_data
from tune_jobs.sweeps.storage import local_path

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from matplotlib.figure import Figure

    from analysis.exports.paper import Returns
    from tune_jobs.store.contract import Sweep

Format = Literal["csv", "parquet", "latex", "optuna", "pdf", "svg", "png", "sweep"]
"""What `export` writes: a folder of tables, a LaTeX file, a SQLite file, a figure, or one file of the whole sweep."""
FORMATS: tuple[Format, ...] = get_args(Format)
FIGURES = ("pdf", "svg", "png")
_SUFFIXES: dict[Format, str] = {
    "latex": ".tex", "optuna": ".db", "pdf": ".pdf", "svg": ".svg", "png": ".png", "sweep": ".tunejobs",
}  # fmt: skip
_FORMATS_BY_SUFFIX: dict[str, Format] = {suffix: kind for kind, suffix in _SUFFIXES.items()}
_FORMATS_BY_SUFFIX |= {".csv": "csv", ".parquet": "parquet"}


@checked
def dataframe(
    sweep: str | Path,
    rows: Literal["trials", "iterations", "evaluations", "settings"] = "trials",
    *,
    storage: str | Path | None = None,
) -> pd.DataFrame:
    """Return a table of a sweep as a pandas DataFrame.

    The guide on exports says what the columns are.

    Args:
        sweep: Name or folder.
        rows: What a row is: a trial, as in `trials.csv` of the report; an iteration of a trial; a greedy evaluation of
            one; or a setting, judged over its training seeds, the one to train with first.
        storage: Folder for sweeps.

    Raises:
        NotFoundError: There is no such sweep.
    """
    from analysis.exports.frames import make_frame
    from tune_jobs.sweeps.sources import find_sweep

    return make_frame(sweep_data(find_sweep(sweep, storage)), rows)


@checked
def study(sweep: str | Path, *, storage: str | Path | None = None) -> optuna.Study:
    """Return the ended trials of a sweep as an Optuna study in memory; `export` writes one to a file.

    A trial's value is what settings are judged by (`objective` in the sweep file), higher is better; its evaluations
    are intermediate values; one that a scheduler ended is pruned.

    Raises:
        NotFoundError: There is no such sweep.
        CannotRunError: Optuna is not installed.
        SpecError: It is a sweep of population based training, whose trials have no one value of a hyperparameter.
    """
    from tune_jobs.search.study import make_study
    from tune_jobs.sweeps.sources import find_sweep

    store = find_sweep(sweep, storage)
    return make_study(spec_of(store), sweep_data(store), store.name)


@checked
def figure(
    sweeps: str | Path | Sequence[str | Path],
    *,
    top: PositiveInt = 3,
    returns: Literal["evaluation", "training"] = "evaluation",
    width: Inches = 3.4,
    height: Inches = 2.5,
    storage: str | Path | None = None,
) -> Figure:
    """Draw how the leading settings learn, with bands over training seeds, as a matplotlib Figure for a paper.

    A curve is the mean over the seeds of a setting, its band the 95 % interval of that mean; with one seed a setting
    there is no band. Curves are dashed from where the first of their seeds has ended: it is held at its last value.

    Args:
        sweeps: One sweep, or several of one environment.
        top: How many settings of each.
        returns: Greedy evaluations, or the mean of the last 100 training episodes.
        width: Inches.
        height: Inches.
        storage: Folder for sweeps.

    Raises:
        NotFoundError: There is no such sweep, or nothing of it to draw.
        SpecError: The sweeps are of different environments, whose returns have no common axis.
    """
    names = [sweeps] if isinstance(sweeps, str | Path) else list(sweeps)
    return _figure(names, storage, top=top, returns=returns, size=(width, height))


@checked
def export(
    sweeps: str | Path | Sequence[str | Path],
    format: Literal["csv", "parquet", "latex", "optuna", "pdf", "svg", "png", "sweep"] | None = None,  # noqa: A002
    *,
    output: str | Path | None = None,
    top: PositiveInt | None = None,
    storage: str | Path | None = None,
) -> dict[str, Path]:
    """Write a sweep in another form.

    Args:
        sweeps: One sweep; for a figure also several.
        format: `csv` and `parquet` write a folder with a table each of trials, iterations, evaluations and settings;
            `latex` a table of the leading settings (booktabs); `optuna` a study in a SQLite file; `pdf`, `svg` and
            `png` the learning curves of the leading settings; `sweep` one file that the service's page shows whoever
            opens it there. None: what the suffix of `output` says, such as `.pdf` or `.parquet`; else `csv`.
        output: The folder (csv, parquet) or file to write; a folder that is there gets a file of the usual name. None:
            `NAME-csv`, `NAME-parquet`, `NAME.tex`, `NAME.db`, `NAME.tunejobs`, `NAME.pdf`, ... in the current folder.
        top: How many settings the LaTeX table (10) or the figure (3 of each sweep) shows.
        storage: Folder for sweeps.

    Returns:
        The files, by what they are.

    Raises:
        NotFoundError: There is no such sweep, or nothing of it to draw.
        SpecError: Several sweeps are given for a table, the sweep has no form of this kind, or the output is a URL.
        CannotRunError: A file cannot be written, or a package is not installed.
    """
    from tune_jobs.sweeps.sources import find_sweep

    names = [sweeps] if isinstance(sweeps, str | Path) else list(sweeps)
    kind = format or _format_of(output)
    if not names or (len(names) > 1 and kind not in FIGURES):
        raise SpecError(
            f"{len(names)} sweeps were given; {kind} is of one.",
            f"Export them one by one; several go into one figure ({', '.join(FIGURES)}).",
        )
    if top is not None and kind not in (*FIGURES, "latex"):
        raise SpecError(
            f"--top {top} (top) is of tables in LaTeX and of figures; {kind} has all of a sweep.",
            f"Leave it out, or name another form: latex, {', '.join(FIGURES)}.",
        )
    store = find_sweep(names[0], storage)
    suffix = _SUFFIXES.get(kind, f"-{kind}")
    path = Path(f"{store.name}{suffix}") if output is None else local_path(output)
    if kind in _SUFFIXES and is_output_folder(path):
        path /= f"{store.name}{suffix}"
    elif kind in _SUFFIXES and path.suffix.lower() != suffix:
        path = path.with_name(f"{path.name}{suffix}")
    if kind in FIGURES:
        from analysis.exports.paper import COLUMN_WIDTH, save_figure

        drawn = _figure(names, storage, top=top or 3, returns="evaluation", size=COLUMN_WIDTH)
        return {"figure": save_figure(drawn, path)}
    if kind == "optuna":
        from tune_jobs.search.study import make_study

        make_study(spec_of(store), sweep_data(store), store.name, path)
        return {"study": path}
    if kind == "latex":
        return {"table": _write_latex(store, path, top)}
    if kind == "sweep":
        return {"sweep": _write_whole(store, path)}
    return _write_tables(sweep_data(store), path, kind)


def _format_of(output: str | Path | None) -> Format:
    suffix = "" if output is None else Path(output).suffix.lower()
    return _FORMATS_BY_SUFFIX.get(suffix, "csv")


def trials_csv(store: Sweep) -> str:
    """Return the table of a sweep's trials as CSV, as `export` writes it.

    Raises:
        CheckpointError: The record of the sweep or of a trial is damaged.
    """
    from analysis.exports.frames import make_frame
    from analysis.tables import csv_text

    return csv_text(make_frame(sweep_data(store), "trials"))


def _figure(
    names: Sequence[str | Path],
    storage: str | Path | None,
    *,
    top: int,
    returns: Returns,
    size: tuple[float, float],
) -> Figure:
    from analysis.exports.paper import learning_figure
    from analysis.report_data import are_one_env, env_arguments_of, env_of
    from tune_jobs.sweeps.sources import find_sweep

    if not names:
        raise SpecError("No sweep was given to draw.", "Give one sweep, or several of one environment.")
    stores = [find_sweep(name, storage) for name in names]
    labels = _labels(stores)
    records = [store.read_record() for store in stores]
    first_id, first_arguments = env_of(records[0]), env_arguments_of(records[0])
    for label, record in zip(labels, records, strict=True):
        env_id = env_of(record)
        is_one_env = are_one_env(env_id, first_id)
        if not is_one_env or env_arguments_of(record) != first_arguments:
            raise SpecError(
                f"Sweep {labels[0]} is on {first_id}, {label} on {env_id}"
                f"{' with other arguments' if is_one_env else ''}: their returns have no common axis.",
                "Draw them one by one.",
            )
    data = [sweep_data(store) for store in stores]
    return learning_figure(list(zip(labels, data, strict=True)), top=top, returns=returns, size=size)


def _labels(stores: Sequence[Sweep]) -> list[str]:
    """Return what sweeps are called beside each other: by their names, or by their places where names are the same."""
    from analysis.wording import shown_path

    given = Counter(store.name for store in stores)
    return [store.name if given[store.name] == 1 else shown_path(store.place) for store in stores]


def _write_latex(store: Sweep, path: Path, top: int | None) -> Path:
    from analysis.exports.latex import NUM_LISTED, latex_table
    from policies.files import write_atomic

    data = sweep_data(store)
    if not data.has_settings:
        raise SpecError(
            f"Sweep {store.name} is one of population based training, whose trials have no settings to list.",
            "Export it as csv or parquet.",
        )
    text = latex_table(data, name=store.name, env_id=spec_of(store).env.id, top=top or NUM_LISTED)
    write_atomic(path, text)
    return path


def _write_whole(store: Sweep, path: Path) -> Path:
    from policies.files import write_atomic
    from tune_jobs.sweeps.sweep_file import sweep_file

    write_atomic(path, sweep_file(store))
    return path


def _write_tables(data: SweepData, folder: Path, kind: str) -> dict[str, Path]:
    from analysis.exports.frames import flat, make_frame
    from analysis.iterations_csv import write_iterations
    from analysis.tables import write_csv
    from policies.files import write_atomic

    if not is_output_folder(folder) and folder.exists():
        raise CannotRunError(f"{folder} is a file; {kind} writes a folder of tables.", "Give a folder.")
    written: dict[str, Path] = {}
    for rows in ROWS:
        path = folder / f"{rows}.{kind}"
        if kind != "csv":
            write_atomic(path, flat(make_frame(data, rows)).to_parquet(index=False))
        elif rows == "iterations":
            write_iterations(path, data.results)
        else:
            write_csv(path, make_frame(data, rows))
        written[rows] = path
    return written


__all__ = ["FIGURES", "FORMATS", "Rows", "dataframe", "export", "figure", "study", "sweep_data"]
