"""The part of a client that only looks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from tune_jobs.client.answers import Curves, FileOfSweep, Job, Me, Summary, Trial
from tune_jobs.client.asking import Asking, sweep_path, trial_path

if TYPE_CHECKING:
    from analysis.best_records import BestRecord
    from analysis.comparison.compare import Comparison
    from analysis.importance.answer import WhatMattered
    from analysis.records import IterationRecord, Objective, TrialRecord
    from tune_jobs.sweeps.status import SweepStatus


class Looking(Asking):
    """Looks at sweeps; see `Client`."""

    def sweeps(
        self,
        *,
        state: str | None = None,
        owner: str | None = None,
        tag: str | None = None,
        search: str | None = None,
        sort: str = "created_at",
        order: str = "desc",
    ) -> Iterator[Summary]:
        """Give the sweeps, page after page.

        Args:
            state: Only those in this state.
            owner: Only this person's.
            tag: Only those with this tag.
            search: Only those with this in name, env or note.
            sort: name, created_at, state, num_env_steps or best.
            order: asc or desc.
        """
        query = {"state": state, "owner": owner, "tag": tag, "search": search, "sort": sort, "order": order}
        for item in self._pages("/sweeps", "sweeps", query):
            yield self._read(Summary, item)

    def sweep(self, name: str) -> Summary:
        """Return one sweep.

        Raises:
            NotFoundError: There is no such sweep.
        """
        return self._read(Summary, self._ask("GET", sweep_path(name)))

    def spec(self, name: str) -> dict[str, Any]:
        """Return the content of a sweep's file, with defaults."""
        found: dict[str, Any] = self._ask("GET", f"{sweep_path(name)}/spec")
        return found

    def status(self, name: str) -> SweepStatus:
        """Return the status of a sweep, as `tune_jobs.status` does there.

        Raises:
            NotFoundError: There is no such sweep.
        """
        return self._statuses([self._ask("GET", f"{sweep_path(name)}/status")])[0]

    def list_sweeps(self) -> list[SweepStatus]:
        """Return the status of every sweep, by name, as `tune_jobs.list_sweeps` does there."""
        return self._statuses(list(self._pages("/statuses", "statuses", {})))

    def records(self, name: str) -> list[TrialRecord]:
        """Return the records of a sweep's trials, by index, as `tune_jobs.trials` does there.

        Raises:
            NotFoundError: There is no such sweep.
        """
        from analysis.records import TrialRecord

        return self._read(list[TrialRecord], self._ask("GET", f"{sweep_path(name)}/records"))

    def trials(
        self, name: str, *, status: str | None = None, sort: str = "score", order: str = "desc"
    ) -> Iterator[Trial]:
        """Give the trials of a sweep with their scores, page after page.

        Args:
            name: The sweep.
            status: Only those with this status.
            sort: score, a field of the records, or a searched hyperparameter.
            order: asc or desc.

        Raises:
            NotFoundError: There is no such sweep.
        """
        for item in self._pages(
            f"{sweep_path(name)}/trials", "trials", {"status": status, "sort": sort, "order": order}
        ):
            yield self._read(Trial, item)

    def trial(self, name: str, trial_id: str) -> Trial:
        """Return one trial.

        Raises:
            NotFoundError: There is no such sweep or trial.
        """
        return self._read(Trial, self._ask("GET", trial_path(name, trial_id)))

    def iterations(self, name: str, trial_id: str, *, after: int = 0) -> list[IterationRecord]:
        """Return what the iterations of a trial showed, those after one, without their single episodes."""
        from analysis.records import IterationRecord

        found = self._ask("GET", f"{trial_path(name, trial_id)}/iterations", query={"after": after})
        return self._read(list[IterationRecord], found)

    def log(self, name: str, trial_id: str, *, lines: int = 200) -> str:
        """Return the last lines that a trial printed."""
        found = self._ask("GET", f"{trial_path(name, trial_id)}/log", query={"lines": lines})
        return str(found["text"])

    def curves(self, name: str, *, points: int = 200) -> Curves:
        """Return the learning curves of all trials, of each at most so many points."""
        return self._read(Curves, self._ask("GET", f"{sweep_path(name)}/curves", query={"points": points}))

    def best(self, name: str) -> BestRecord:
        """Return the policy to deploy and the setting to train with.

        Raises:
            NotFoundError: There is no such sweep, or it has no best policy yet.
        """
        from analysis.best_records import BestRecord

        return self._read(BestRecord, self._ask("GET", f"{sweep_path(name)}/best"))

    def importance(self, name: str) -> WhatMattered:
        """Say which hyperparameters a sweep's scores depend on, as `tune_jobs.importance` does there.

        Raises:
            NotFoundError: There is no such sweep.
        """
        from analysis.importance.answer import WhatMattered

        return self._read(WhatMattered, self._ask("GET", f"{sweep_path(name)}/what-mattered"))

    def compare(self, sources: str | Sequence[str], *, objective: Objective | None = None, top: int = 3) -> Comparison:
        """Compare sweeps by their leading settings, or settings with each other, as `tune_jobs.compare` does there.

        Args:
            sources: Each a sweep, or a setting by one of its trials: `SWEEP/t0003`. Of one sweep alone the leading
                settings are compared.
            objective: What all are judged by; None: what their sweep files say, or `final` where these differ.
            top: How many settings are compared of a sweep that is named alone.

        Raises:
            NotFoundError: There is no such sweep or trial.
            SpecError: Fewer than two different things, or too many, are to be compared.
        """
        from analysis.comparison.compare import Comparison

        named = [sources] if isinstance(sources, str) else list(sources)
        for source in named:
            sweep, _, trial_id = source.rstrip("/").partition("/")
            # Neither is part of a path here, but what can be none is told in the same words.
            _ = trial_path(sweep, trial_id) if trial_id else sweep_path(sweep)
        query = {"source": named, "objective": objective, "top": top}
        return self._read(Comparison, self._ask("GET", "/comparison", query=query))

    def files(self, name: str) -> list[FileOfSweep]:
        """Return which files can be downloaded of a sweep: its report, films and policy."""
        return self._read(list[FileOfSweep], self._ask("GET", f"{sweep_path(name)}/files"))

    def jobs(self, *states: str) -> list[Job]:
        """Return jobs in the order in which they came, of some states or all."""
        return self._read(list[Job], self._ask("GET", "/jobs", query={"state": states}))

    def job(self, number: int) -> Job:
        """Return one job.

        Raises:
            NotFoundError: There is no such job.
        """
        return self._read(Job, self._ask("GET", f"/jobs/{number}"))

    def me(self) -> Me:
        """Return who asks, and what service it is."""
        return self._read(Me, self._ask("GET", "/me"))

    def _statuses(self, found: list[Any]) -> list[SweepStatus]:
        from tune_jobs.sweeps.status import Sweeps, SweepStatus

        return Sweeps(self._read(list[SweepStatus], found))
