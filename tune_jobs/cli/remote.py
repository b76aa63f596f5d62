"""The verbs of the command line as a service does them: with the arguments and results of `tune_jobs.sweeps.verbs`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from policies.errors import NotFoundError, SpecError
from policies.files import is_output_folder
from tune_jobs.client import Client, ConflictError
from tune_jobs.sweeps.outcome import Film

if TYPE_CHECKING:
    from analysis.best_records import BestRecord
    from analysis.comparison.compare import Comparison
    from analysis.importance.answer import WhatMattered
    from analysis.records import Objective, TrialRecord
    from tune_jobs.plan.sweep_plan import SweepPlan
    from tune_jobs.spec.sweep_spec import SweepSpec
    from tune_jobs.sweeps.status import SweepStatus

_FILMS, _ONE_FILE = "films/", ".tunejobs"


class RemoteVerbs:
    """What commands do, done by a service; `storage` is its own.

    Args:
        client: The service.
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def status(self, sweep: str, *, storage: None = None) -> SweepStatus:  # noqa: ARG002
        """Return the status of a sweep."""
        return self._client.status(sweep)

    def list_sweeps(self, storage: None = None) -> list[SweepStatus]:  # noqa: ARG002
        """Return the status of every sweep, by name."""
        return self._client.list_sweeps()

    def trials(self, sweep: str, *, storage: None = None) -> list[TrialRecord]:  # noqa: ARG002
        """Return the records of a sweep's trials, by index."""
        return self._client.records(sweep)

    def stop(self, sweep: str, *, storage: None = None) -> bool:  # noqa: ARG002
        """Ask a sweep to stop; return whether it ran or waited."""
        try:
            self._client.stop(sweep)
        except ConflictError:
            return False
        return True

    def best(self, sweep: str, *, num_episodes: int = 0, **_: Any) -> BestRecord:  # noqa: ARG002
        """Return the policy that was chosen when the sweep ended."""
        return self._client.best(sweep)

    def importance(self, sweep: str, *, storage: None = None) -> WhatMattered:  # noqa: ARG002
        """Say which hyperparameters a sweep's scores depend on."""
        return self._client.importance(sweep)

    def compare(
        self, sources: Sequence[str], *, objective: Objective | None = None, top: int = 3, **_: Any
    ) -> Comparison:
        """Compare sweeps or settings."""
        return self._client.compare(sources, objective=objective, top=top)

    def report(self, sweep: str, *, output: str | None = None, **_: Any) -> Path:
        """Download the page of a sweep's report, and return its path."""
        default = f"{sweep}-report.html"
        to = _target(output, default)
        return self._client.download(sweep, "report/", to)

    def video(self, source: str, *, output: str | None = None, **_: Any) -> dict[str, Path]:
        """Download the films of a sweep's best policy, and return their paths.

        Args:
            source: The sweep.
            output: A folder for all of them; or a file for that of the trained policy, as .mp4 and .gif.

        Raises:
            NotFoundError: It has none.
        """
        if "/" in source or source in ("random", "constant"):
            raise SpecError(
                f"A service has films of sweeps' best policies; {source!r} is no sweep.", "Name a sweep, by its name."
            )
        target = _target(output, "")
        there = {file.path for file in self._client.files(source)}
        # Only names that are known here: others might lead out of the folder.
        known = [film for film in get_args(Film) if _FILMS + film in there]
        if output is None or _is_folder(output):
            wanted = {film: target / f"{source}-{'.'.join(film.rsplit('_', 1))}" for film in known}
            names = {film: film for film in known}
        else:
            names = {film: film.removeprefix("after_") for film in ("after_mp4", "after_gif") if film in known}
            # Another suffix, such as that of `cartpole-v0.5`, is kept, as it is where the folder is.
            stem = target.stem if target.suffix.lower() in (".mp4", ".gif") else target.name
            wanted = {film: target.with_name(f"{stem}.{suffix}") for film, suffix in names.items()}
        if not wanted:
            raise NotFoundError(
                f"Sweep {source} has no film of its best policy.", "They are made when the sweep has ended."
            )
        return {names[film]: self._client.download(source, _FILMS + film, to) for film, to in wanted.items()}

    def export(
        self, sweeps: Sequence[str], kind: str | None, *, output: str | None = None, top: int | None = None, **_: Any
    ) -> dict[str, Path]:
        """Download a sweep as one file, and return its path.

        Raises:
            SpecError: Several sweeps or another form are asked for, which are made where the folder is.
        """
        wanted = kind or ("sweep" if output is not None and output.lower().endswith(_ONE_FILE) else "csv")
        if wanted != "sweep" or len(sweeps) != 1 or top is not None:
            raise SpecError(
                "A service exports one sweep as one file; other forms are made on the machine of its folder.",
                "Write `export SWEEP --format sweep`.",
            )
        default = f"{sweeps[0]}{_ONE_FILE}"
        to = _target(output, default)
        if to.suffix.lower() != _ONE_FILE:
            to = to.with_name(f"{to.name}{_ONE_FILE}")
        return {"sweep": self._client.download(sweeps[0], "file", to)}

    def planned(self, source: str, overrides: Sequence[str], *, name: str | None = None) -> tuple[SweepSpec, SweepPlan]:
        """Return the sweep and the plan that the service would run.

        Raises:
            SpecError: The sweep is wrong, or not allowed there.
            CannotRunError: It cannot run there, or the service is of another version.
        """
        from tune_jobs.plan.machine import Machine
        from tune_jobs.plan.sweep_plan import SweepPlan
        from tune_jobs.spec.problems import WrongSpecError
        from tune_jobs.spec.sweep_spec import SweepSpec

        try:
            found = self._client.plan(source, overrides=overrides, name=name)
        except SpecError as error:
            raise told_here(error, source, overrides) from error
        try:
            spec, plan = SweepSpec.model_validate(found.spec), SweepPlan.from_json(found.plan)
        except WrongSpecError as error:
            # The service has taken the sweep: nothing is wrong with the user's file.
            path, text = error.problems[0]
            raise self._client.unknown(f"{path}: {text.removesuffix('.')}") from error
        if plan.machine.source == Machine(1).source:
            plan = dataclasses.replace(plan, machine=dataclasses.replace(plan.machine, source="the service's machine"))
        return spec if name is None else spec.model_copy(update={"name": name}), plan


def told_here(error: SpecError, source: str, overrides: Sequence[str]) -> SpecError:
    """Return a service's error about a sweep in the words of this machine, which knows the file's name, if it can."""
    from tune_jobs.spec.file import load_spec

    try:
        load_spec(source, overrides)
    except SpecError as here:
        return here
    # It is about more than the file, such as its environment, or what is allowed there.
    return error


def _is_folder(output: str) -> bool:
    from tune_jobs.sweeps.storage import local_path

    return output.endswith("/") or is_output_folder(local_path(output))


def _target(output: str | None, default: str) -> Path:
    """Return the file to write on this machine: `output`, or the default name in that folder."""
    from tune_jobs.sweeps.storage import local_path

    if output is None:
        return Path(default)
    path = local_path(output)
    return path / default if _is_folder(output) else path
