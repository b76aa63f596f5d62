"""What a shell completes: presets and sweep files, the names of sweeps, a sweep's trials.

Click prints the shell's part, for which docs/reference/commands.md has a line. Nothing here may fail or print: a folder
that cannot be read has nothing to complete.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from tune_jobs.store.contract import Sweep

_SUFFIXES = (".yaml", ".yml")
_BASELINES = ("random", "constant")


def complete_specs(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the presets and the sweep files; where there is neither, the shell completes files and folders itself."""
    folder = incomplete.rpartition("/")[0]
    found = complete_presets(ctx, parameter, incomplete)
    with contextlib.suppress(OSError, ValueError):
        files = sorted(path.name for path in Path(folder or ".").iterdir() if path.name.endswith(_SUFFIXES))
        found += _items((f"{incomplete[: incomplete.rfind('/') + 1]}{name}" for name in files), incomplete)
    return [*_by_shell("file", incomplete), *found]


def complete_presets(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the names of the presets."""
    from tune_jobs.spec.file import preset_names

    return _items(preset_names(), incomplete)


def complete_sweeps(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the names of the sweeps in the storage folder, that of --storage if it stands before them."""
    return [*_by_shell("dir", incomplete), *_items(_sweep_names(ctx), incomplete)]


def complete_sources(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the baselines and the names of the sweeps; behind a sweep's name and a slash, its trials."""
    sweep, slash, _trial = incomplete.rpartition("/")
    if slash and (trials := _trial_names(ctx, sweep)):
        return _items((f"{sweep}/{trial}" for trial in trials), incomplete)
    return [*_by_shell("file", incomplete), *_items([*_BASELINES, *_sweep_names(ctx)], incomplete)]


def complete_searched(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the sweep's searched hyperparameters that have no value yet, each with an equals sign behind it."""
    given = {text.partition("=")[0] for text in ctx.params.get("values") or ()}
    names = _searched_names(ctx, str(ctx.params.get("sweep") or ""))
    return _items((f"{name}=" for name in names if name not in given), incomplete)


def complete_algorithms(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the algorithms."""
    from policies.hyperparams import Algorithm

    return _items(get_args(Algorithm), incomplete)


def complete_folders(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Let the shell complete a folder."""
    return _by_shell("dir", incomplete)


def _by_shell(kind: str, incomplete: str) -> list[CompletionItem]:
    """Let the shell complete files or folders where nothing else fits; bash forgets what stands before this."""
    return [CompletionItem(incomplete, type=kind)]


def _items(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def _sweep_names(ctx: click.Context) -> list[str]:
    from policies.errors import TuneJobsError
    from tune_jobs.store.local_storage import open_storage
    from tune_jobs.sweeps.storage import storage_folder

    with contextlib.suppress(TuneJobsError, OSError, ValueError):
        return [sweep.name for sweep in open_storage(storage_folder(ctx.params.get("storage"))).sweeps()]
    return []


def _trial_names(ctx: click.Context, sweep: str) -> list[str]:
    return _of_sweep(ctx, sweep, lambda store: [trial.trial_id for trial in store.read_trials()])


def _searched_names(ctx: click.Context, sweep: str) -> list[str]:
    return _of_sweep(ctx, sweep, lambda store: list(store.read_record().section("space")))


def _of_sweep(ctx: click.Context, sweep: str, names: Callable[[Sweep], list[str]]) -> list[str]:
    from policies.errors import TuneJobsError
    from tune_jobs.store.local_storage import open_storage
    from tune_jobs.sweeps.storage import storage_folder

    with contextlib.suppress(TuneJobsError, OSError, ValueError):
        store = open_storage(storage_folder(ctx.params.get("storage"))).sweep(sweep)
        return names(store) if store.exists() else []
    return []
