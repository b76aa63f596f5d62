"""What a sweep has made, as files: each is found by what it is, never by a path."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from fastapi import APIRouter, Response
from fastapi import Path as PathParameter

from analysis.front_view import FrontView
from policies.errors import NotFoundError
from policies.portable.file import policy_files
from tune_jobs.service.http.best_policy import has_best, no_best
from tune_jobs.service.http.caller import TheService
from tune_jobs.service.http.downloads import NO_SCRIPTS, SANDBOX, Archive, Download, attachment
from tune_jobs.service.http.models import FileOfSweep
from tune_jobs.service.http.waiting import waits_aside
from tune_jobs.service.service import Service
from tune_jobs.store.contract import Sweep
from tune_jobs.sweeps.outcome import Film
from tune_jobs.sweeps.plain import to_json

router = APIRouter(prefix="/api/v1/sweeps/{name}", tags=["downloads"])
_PAGE_SUFFIX = ".html"
_MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8", ".csv": "text/csv; charset=utf-8", ".svg": "image/svg+xml",
    ".pdf": "application/pdf", ".png": "image/png", ".json": "application/json", ".mp4": "video/mp4",
    ".gif": "image/gif",
}  # fmt: skip
_SHOWN = (".html", ".svg", ".png", ".pdf")
"""What a browser shows; it keeps others as files."""

Iteration = Annotated[int, PathParameter(ge=0, le=10**12)]


def _archive_of(what: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {"application/zip": {}}, "description": what}}


@router.get("/files")
def files(name: str, service: TheService) -> list[FileOfSweep]:
    """List what can be downloaded of a sweep: its report, films and policy."""
    sweep = _sweep(service, name)
    known = {f"report/{path}": file for path, file in sweep.report_files().items()}
    if has_best(service, sweep):
        known |= {f"films/{film}": file for film, file in sweep.films().items()}
        known |= {f"policy/{path}": file for path, file in policy_files(sweep.best_folder).items()}
    return [item for path, file in known.items() if (item := _described(path, file)) is not None]


def _described(path: str, file: Path) -> FileOfSweep | None:
    try:
        found = file.lstat()
    except OSError:
        # It is being replaced.
        return None
    return FileOfSweep(path=path, num_bytes=found.st_size, modified_at=found.st_mtime, media_type=_media_type(file))


@router.head("/report/{path:path}", include_in_schema=False)
@router.get("/report/{path:path}", response_class=Download, status_code=200)
def report(name: str, path: str, service: TheService) -> Download:
    """Download a file of the report, its page if none is named; that runs in a sandbox, without a network."""
    known = _sweep(service, name).report_files()
    path = path or next((file for file in known if file.endswith(_PAGE_SUFFIX)), "")
    if path not in known:
        if not known:
            raise NotFoundError(f"Sweep {name} has no report yet.", "It is written when the sweep has ended.")
        raise NotFoundError(
            f"The report of sweep {name} has no file {path[:80]!r}.", "It has those that `files` lists."
        )
    suffix = PurePosixPath(path).suffix
    headers = {"Content-Security-Policy": SANDBOX if suffix == _PAGE_SUFFIX else NO_SCRIPTS}
    filename = None if suffix in _SHOWN else f"{name}-{PurePosixPath(path).name}"
    return Download(known[path], _media_type(known[path]), filename=filename, headers=headers)


@router.head("/films/{film}", include_in_schema=False)
@router.get("/films/{film}", response_class=Download, status_code=200)
def films(name: str, film: Film, service: TheService) -> Download:
    """Download a film of the best policy, or of a random one before training."""
    known = _sweep(service, name).films()
    if film not in known:
        has = f"it has {', '.join(known)}" if known else "it has none"
        raise NotFoundError(f"Sweep {name} has no film {film} of its best policy: {has}.", "See `files`.")
    return Download(known[film], _media_type(known[film]))


@router.get("/policy", responses=_archive_of("The best policy."), response_class=Archive, status_code=200)
def policy(name: str, service: TheService) -> Archive:
    """Download the best policy, as an archive of its two files."""
    return Archive(_policy_files(service, name), f"{name}-policy.zip")


@router.head("/policy/{file}", include_in_schema=False)
@router.get("/policy/{file}", response_class=Download, status_code=200)
def policy_file(name: str, file: str, service: TheService) -> Download:
    """Download one of the two files of the best policy."""
    known = _policy_files(service, name)
    if file not in known:
        raise NotFoundError(f"The policy of sweep {name} has no file {file[:80]!r}.", f"It has {' and '.join(known)}.")
    path = known[file]
    return Download(path, _media_type(path), filename=f"{name}-{file}")


def _policy_files(service: Service, name: str) -> Mapping[str, Path]:
    sweep = _sweep(service, name)
    found = policy_files(sweep.best_folder) if has_best(service, sweep) else {}
    if not found:
        raise no_best(sweep)
    return found


@router.get(
    "/trials/{trial_id}/checkpoints/{iteration}",
    responses=_archive_of("The checkpoint."),
    response_class=Archive,
    status_code=200,
)
def checkpoint(name: str, trial_id: str, iteration: Iteration, service: TheService) -> Archive:
    """Download a checkpoint of a trial, as an archive of its files, each of which was checked before."""
    trial = _sweep(service, name).trial(trial_id)
    return Archive(trial.checkpoint_files(iteration), f"{name}-{trial.trial_id}-{iteration:06d}.zip")


@router.get("/trials.csv", responses={200: {"content": {"text/csv": {}}}}, response_class=Response)
@waits_aside
def trials_csv(name: str, service: TheService) -> Response:
    """Download the table of trials, as `tune-jobs export` writes it; of a running sweep as of a while ago."""
    headers = {"Content-Disposition": attachment(f"{name}-trials.csv")}
    return Response(service.derived.trials_csv(name), media_type="text/csv; charset=utf-8", headers=headers)


@router.get("/file", responses={200: {"content": {"application/gzip": {}}}}, response_class=Response)
@waits_aside
def sweep_file(name: str, service: TheService) -> Response:
    """Download the sweep as one file, which the page of any service shows; of a running sweep as of a while ago."""
    headers = {"Content-Disposition": attachment(f"{name}.tunejobs")}
    return Response(service.derived.sweep_file(name), media_type="application/gzip", headers=headers)


@router.get("/best")
def best(name: str, service: TheService) -> dict[str, Any]:
    """Return the policy to deploy and the setting to train with, as `tune-jobs best --json` prints them."""
    sweep = _sweep(service, name)
    # The store's message names the command that chooses it, which is the one that a client was given.
    if not has_best(service, sweep):
        raise no_best(sweep)
    found: dict[str, Any] = to_json(sweep.read_best())
    return found


@router.get("/importance")
@waits_aside
def importance(name: str, service: TheService) -> dict[str, Any]:
    """Say which hyperparameters scores depend on, as `tune-jobs importance --json`; of a running sweep a while ago."""
    found: dict[str, Any] = to_json(service.derived.importance(name))
    return found


@router.get("/front")
@waits_aside
def front(name: str, service: TheService) -> FrontView:
    """Set scores against env steps: the Pareto front of a sweep that asks for it; of a running one a while ago."""
    return service.derived.front(name)


def _sweep(service: Service, name: str) -> Sweep:
    service.statuses.see(name)
    return service.storage.sweep(name)


def _media_type(path: Path) -> str:
    return _MEDIA_TYPES.get(path.suffix, "application/octet-stream")
