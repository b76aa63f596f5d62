"""Pack the folder of a sweep's own modules, which travels to the cluster that runs the sweep as a job."""

from __future__ import annotations

import io
import os
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from policies.errors import CannotRunError, SpecError
from tune_jobs.store.opening import open_sweep

MAX_BYTES = 100 * 2**20
_MAX_NAMED = 5
_LEFT_OUT = ("__pycache__", "node_modules")
_EPOCH = (1980, 1, 1, 0, 0, 0)


def folder_to_send(modules: Sequence[str], folder: Path) -> Path | None:
    """Return the folder if one of the modules lies in it; None: they are installed, on the cluster too.

    Args:
        modules: Names of modules of the user's own that a sweep needs.
        folder: That of the sweep file, or the current one.
    """
    tops = {name.partition(".")[0] for name in modules}
    is_there = any((folder / top).is_dir() or (folder / f"{top}.py").is_file() for top in tops)
    return folder if is_there else None


def packed(folder: Path) -> bytes:
    """Return a folder as a zip file, the same for the same files.

    Left out is what no module is, and what may be secret or large: hidden files and folders (.git, .env, .venv),
    virtual environments, folders of sweeps, caches, links to any of these and to what lies outside of the folder, and
    names that are not UTF-8. Other links travel as what they lead to.

    Raises:
        SpecError: It holds more than 100 MiB.
        CannotRunError: It cannot be read.
    """
    try:
        files = sorted(_files(folder))
        sizes = {path: path.stat().st_size for path in files}
        if sum(sizes.values()) > MAX_BYTES:
            raise _too_large(folder, sizes)
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in files:
                info = zipfile.ZipInfo(path.relative_to(folder).as_posix(), _EPOCH)
                info.external_attr = (0o755 if os.access(path, os.X_OK) else 0o644) << 16
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, path.read_bytes())
    except OSError as error:
        raise CannotRunError(
            f"The folder of the sweep's modules, {folder}, cannot be read: {error}.", "Check its permissions."
        ) from error
    return content.getvalue()


def _files(folder: Path) -> Iterator[Path]:
    inside = folder.resolve()
    for root, folders, names in os.walk(folder, onerror=_raise, followlinks=True):
        here = Path(root)
        way = {path.resolve() for path in (here, *here.parents) if path.is_relative_to(folder)}
        # A link to where the walk came through would be followed for ever.
        folders[:] = [
            name for name in folders if _leads_to_own(here / name, inside)
            and not _stays_here(here / name) and (here / name).resolve() not in way
        ]  # fmt: skip
        for name in names:
            path = here / name
            if not _is_unfit(name) and path.is_file() and _leads_to_own(path, inside):
                yield path


def _raise(error: OSError) -> None:
    raise error


def _leads_to_own(path: Path, inside: Path) -> bool:
    """Whether a path is no link, or leads to what lies in the folder and does not stay here under its own name."""
    if not path.is_symlink():
        return True
    real = path.resolve()
    if not real.is_relative_to(inside) or _is_unfit(real.name):
        return False
    return not any(_stays_here(one) for one in (real, *real.parents) if one.is_dir() and inside in one.parents)


def _is_unfit(name: str) -> bool:
    """Whether a name is hidden, or not UTF-8, as a zip file's have to be; no module has such a one."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return True
    return name.startswith(".")


def _stays_here(folder: Path) -> bool:
    if _is_unfit(folder.name) or folder.name in _LEFT_OUT or (folder / "pyvenv.cfg").exists():
        return True
    # A sweep, or a storage folder of sweeps.
    return open_sweep(folder).exists() or any(
        open_sweep(path).exists() for path in folder.iterdir() if path.is_dir() and not path.is_symlink()
    )


def _too_large(folder: Path, sizes: dict[Path, int]) -> SpecError:
    by_top: Counter[str] = Counter()
    for path, size in sizes.items():
        by_top[path.relative_to(folder).parts[0]] += size
    largest = ", ".join(f"{name} ({_mib(size)})" for name, size in by_top.most_common(_MAX_NAMED))
    return SpecError(
        f"The folder of the sweep's modules, {folder}, holds {_mib(sum(sizes.values()))}, and at most "
        f"{_mib(MAX_BYTES)} travel to the cluster. Largest in it: {largest}.",
        "Keep the sweep file and its modules in a folder of their own, or install the modules on every node.",
    )


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f} MiB"
