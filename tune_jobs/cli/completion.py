"""What a shell completes: presets and sweep files, the names of sweeps, a sweep's trials.

Click prints the shell's part, for which docs/reference/commands.md has a line. Nothing here may fail or print: a folder
that cannot be read has nothing to complete, and neither has a service or an object store that does not answer at once.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import click
from click.shell_completion import BashComplete, CompletionItem, add_completion_class

from tune_jobs.cli.server import Server, server_to_complete_from

if TYPE_CHECKING:
    from tune_jobs.client import Client
    from tune_jobs.store.contract import Sweep

_SUFFIXES = (".yaml", ".yml")
_PATIENCE_S = 1.5
"""How long a service or a storage is waited for."""
_MOST_SEARCHED = 100
"""Characters that a service takes to search for."""
_BREAKS = (":", "=")
_BASELINES = ("random", "constant")


@add_completion_class
class _Bash(BashComplete):
    """Puts together again what bash takes apart: it ends words at colons and equals signs, so at those of a URL."""

    def get_completion_args(self) -> tuple[list[str], str]:
        pieces, incomplete = super().get_completion_args()
        words: list[str] = []
        for piece in pieces:
            # No word here begins with either, or is followed by one, so they are parts of what stands around them.
            if words and (piece in _BREAKS or words[-1].endswith(_BREAKS)):
                words[-1] += piece
            else:
                words.append(piece)
        return words, incomplete


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
    """Return the names of the sweeps in the storage folder, that of --storage if it stands before them, or a service's.

    A service knows no folders of this machine, so the shell completes none.
    """
    folders = _by_shell("dir", incomplete) if server_to_complete_from(ctx) is None else []
    return [*folders, *_items(_sweep_names(ctx, incomplete), incomplete)]


def complete_sources(ctx: click.Context, _: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the baselines and the names of the sweeps; behind a sweep's name and a slash, its trials."""
    sweep, slash, _trial = incomplete.rpartition("/")
    if slash and (trials := _trial_names(ctx, sweep)):
        return _items((f"{sweep}/{trial}" for trial in trials), incomplete)
    if server_to_complete_from(ctx) is not None:
        return _items(_sweep_names(ctx, incomplete), incomplete)
    return [*_by_shell("file", incomplete), *_items([*_BASELINES, *_sweep_names(ctx, incomplete)], incomplete)]


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


def _sweep_names(ctx: click.Context, incomplete: str) -> list[str]:
    from policies.errors import TuneJobsError

    server = server_to_complete_from(ctx)
    if server is not None:
        return _asked(server, lambda client: _names_there(client, incomplete))
    from tune_jobs.store.opening import open_storage
    from tune_jobs.sweeps.storage import storage_place

    with contextlib.suppress(TuneJobsError, OSError, ValueError):
        storage = open_storage(storage_place(ctx.params.get("storage")))
        return _within_patience(lambda: [sweep.name for sweep in storage.sweeps()])
    return []


def _names_there(client: Client, incomplete: str) -> list[str]:
    found = client.sweeps(search=incomplete[:_MOST_SEARCHED], sort="name", order="asc")
    return [sweep.name for sweep in found]


def _trial_names(ctx: click.Context, sweep: str) -> list[str]:
    server = server_to_complete_from(ctx)
    if server is not None:
        return _asked(server, lambda client: [trial.trial_id for trial in client.records(sweep)])
    return _of_sweep(ctx, sweep, lambda store: [trial.trial_id for trial in store.read_trials()])


def _searched_names(ctx: click.Context, sweep: str) -> list[str]:
    server = server_to_complete_from(ctx)
    if server is not None:
        return _asked(server, lambda client: list(client.spec(sweep)["space"]))
    return _of_sweep(ctx, sweep, lambda store: list(store.read_record().section("space")))


def _asked(server: Server, names: Callable[[Client], list[str]]) -> list[str]:
    """Return what a service says, if it does at once."""

    def ask(client: Client) -> list[str]:
        with client:
            return names(client)

    was_silent_below = logging.root.manager.disable
    logging.disable()
    try:
        with contextlib.suppress(Exception):
            # Made before, as what it imports takes longer than an answer does.
            client = server.client(timeout_s=_PATIENCE_S)
            return _within_patience(lambda: ask(client))
    finally:
        logging.disable(was_silent_below)
    return []


def _within_patience(names: Callable[[], list[str]]) -> list[str]:
    """Return names, if they come within the time for which somebody waits after pressing Tab."""
    found: list[str] = []

    def ask() -> None:
        # Whatever goes wrong is told by the command itself, once it is run.
        with contextlib.suppress(Exception):
            found.extend(names())

    # A thread, as looking a host's name up, and answers that come drop by drop, have no timeout of their own.
    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(_PATIENCE_S)
    return list(found)


def _of_sweep(ctx: click.Context, sweep: str, names: Callable[[Sweep], list[str]]) -> list[str]:
    from policies.errors import TuneJobsError
    from tune_jobs.store.opening import open_storage
    from tune_jobs.sweeps.storage import storage_place

    with contextlib.suppress(TuneJobsError, OSError, ValueError):
        store = open_storage(storage_place(ctx.params.get("storage"))).sweep(sweep)
        return _within_patience(lambda: names(store) if store.exists() else [])
    return []
