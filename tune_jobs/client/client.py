"""A service as an object: a method for each of its routes."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from policies.errors import CannotRunError, NotFoundError, SpecError
from tune_jobs.client.answers import Job, Planned, Submitted, Summary
from tune_jobs.client.asking import API, sweep_path
from tune_jobs.client.downloads import download
from tune_jobs.client.event_stream import Event, follow
from tune_jobs.client.looking import Looking
from tune_jobs.client.problems import LostConnectionError, NoServiceError
from tune_jobs.client.sources import Source, listed, plain_values, request_of

_PLAN_S = 600.0
"""How long a plan may take: environments are made and stepped for it."""
_POLL_S, _MOST_POLL_S = 0.2, 3.0


class Client(Looking):
    """A service of `tune-jobs serve`.

    What only looks, and `submit`, is asked again where a connection was lost. Errors are those that the same call
    raises on this machine; besides, all methods raise `CannotRunError` where the service can't be reached, does not
    let one in, or is none. Threads may share a client.

    Args:
        url: Its address, such as http://127.0.0.1:8470. It holds no secret.
        token: A token of `tune-jobs token make`; None: none.
        token_file: A file that holds it.
        ca_file: The certificates, PEM, of authorities that are trusted in the place of those that this machine trusts.
        timeout_s: How long an answer may take to begin, and to go on, in seconds.
        patience_s: How long the service may be away while it is followed or waited for, in seconds.

    Raises:
        SpecError: The address, the token or the certificates are none, or a variable of the environment names a proxy
            or certificates that are none.
        CannotRunError: A variable of the environment names a SOCKS proxy, and what that needs is not installed.
    """

    # -- new sweeps

    def plan(self, source: Source, *, overrides: Sequence[str] = (), name: str | None = None) -> Planned:
        """Validate a sweep and say what would run; nothing is written.

        Args:
            source: Path of a sweep file, name of a preset, or the content of a sweep file as a mapping.
            overrides: `a.b=value` assignments, as given to `--set`.
            name: The sweep's name.

        Raises:
            SpecError: The sweep is wrong, or not allowed there.
            CannotRunError: It cannot run there.
        """
        body = request_of(source, overrides, name)
        return self._read(Planned, self._ask("POST", "/plans", body=body, repeat=True, timeout_s=_PLAN_S))

    def submit(
        self,
        source: Source,
        *,
        overrides: Sequence[str] = (),
        name: str | None = None,
        priority: int = 0,
        note: str = "",
        tags: Sequence[str] = (),
        key: str | None = None,
        wait_for_nodes: float | None = None,
    ) -> Submitted:
        """Have the service write a sweep and run it when its turn comes.

        Args:
            source: The same as for `plan`.
            overrides: The same as for `plan`.
            name: The sweep's name; None: that in the sweep file, else one after the file or preset that is free.
            priority: Higher ones go first, from -100 to 100.
            note: A text for people.
            tags: Words to find it by.
            key: An idempotency key: with the same one the same request makes one sweep, however often it is sent.
                None: a new one, which is the same at each attempt of this call.
            wait_for_nodes: The most seconds to wait until the nodes of the service's cluster can hold one trial, 0: not
                at all; None: as the service's operator has said.

        Raises:
            SpecError: The sweep is wrong or not allowed there, its name is taken, the key was used for another, or the
                service has no cluster whose nodes could be waited for.
            CannotRunError: It cannot run there.
        """
        told = plain_values(priority=priority, note=note, tags=listed("tags", tags))
        body = request_of(source, overrides, name) | told
        if wait_for_nodes is not None:
            body |= plain_values(wait_for_nodes=wait_for_nodes)
        if key and not (key.isascii() and key.isprintable()):
            raise SpecError(f"key: {key[:200]!r} has characters that no header of HTTP can hold.", "Use plain letters.")
        headers = {"Idempotency-Key": key or uuid.uuid4().hex}
        found = self._ask("POST", "/sweeps", body=body, repeat=True, headers=headers, timeout_s=_PLAN_S)
        return self._read(Submitted, found)

    # -- changing

    def stop(self, name: str) -> list[Job]:
        """Ask a sweep to stop: its trials save first, what waits is cancelled. Return the jobs that this is about.

        Raises:
            ConflictError: It neither waits nor runs.
        """
        return self._read(list[Job], self._ask("POST", f"{sweep_path(name)}/stop"))

    def resume(self, name: str, *, wait_for_nodes: float | None = None) -> Job:
        """Have what is missing of a sweep run; `wait_for_nodes` is the same as for `submit`."""
        return self._change(name, "resume", wait_for_nodes)

    def retry(self, name: str, *, wait_for_nodes: float | None = None) -> Job:
        """Have failed trials run again, and whatever else is missing; `wait_for_nodes` is the same as for `submit`.

        Raises:
            ConflictError: It has no failed trial.
        """
        return self._change(name, "retry", wait_for_nodes)

    def extend(self, name: str, num_samples: int, *, wait_for_nodes: float | None = None) -> Job:
        """Have more samples of a sweep's space run; `wait_for_nodes` is the same as for `submit`.

        Raises:
            SpecError: The space has nothing random to draw, or there would be too many trials.
        """
        return self._change(name, "extend", wait_for_nodes, plain_values(num_samples=num_samples))

    def inject(self, name: str, point: Mapping[str, Any], *, wait_for_nodes: float | None = None) -> Job:
        """Have a point of one's own trained, with all seeds of a point.

        Args:
            name: The sweep.
            point: A value for each searched hyperparameter; it may lie outside of the space.
            wait_for_nodes: The same as for `submit`.

        Raises:
            SpecError: A value is missing or wrong, or there would be too many trials.
        """
        return self._change(name, "trials", wait_for_nodes, plain_values(point=point))

    def replicate(self, name: str, *, top: int = 5, seeds: int = 5, wait_for_nodes: float | None = None) -> Job:
        """Have the leading settings trained again with fresh seeds, at most so many each; the wait as for `submit`."""
        return self._change(name, "replicate", wait_for_nodes, plain_values(top=top, seeds=seeds))

    def _change(self, name: str, verb: str, wait_for_nodes: float | None, body: Any = None) -> Job:
        query = {"wait_for_nodes": wait_for_nodes}
        return self._read(Job, self._ask("POST", f"{sweep_path(name)}/{verb}", body=body, query=query))

    def change(
        self,
        name: str,
        *,
        priority: int | None = None,
        note: str | None = None,
        tags: Sequence[str] | None = None,
    ) -> Summary:
        """Change a sweep's priority, note or tags; what is None stays.

        Raises:
            ConflictError: A priority is given, and no job of the sweep waits.
        """
        given = {"priority": priority, "note": note, "tags": None if tags is None else listed("tags", tags)}
        body = plain_values(**{key: value for key, value in given.items() if value is not None})
        return self._read(Summary, self._ask("PATCH", sweep_path(name), body=body, repeat=True))

    def delete(self, name: str, *, force: bool = False) -> None:
        """Delete a sweep with all that it has made.

        Args:
            name: The sweep.
            force: Also one that has not finished, or is damaged.

        Raises:
            ConflictError: It waits or runs, or has not finished.
        """
        self._connection.request("DELETE", f"{API}{sweep_path(name)}", query={"force": "true" if force else None})

    # -- files

    def download(self, name: str, path: str, to: str | Path) -> Path:
        """Download a file of a sweep; where the connection is lost, it goes on from there.

        Args:
            name: The sweep.
            path: As in `files`, such as `report/index.html`; or `policy` (a ZIP archive), `trials.csv`, or
                `trials/t0003/checkpoints/12` (a ZIP archive).
            to: The file to write; a ~ at the beginning is a home folder. One that is there is replaced, once the new
                one is whole.

        Returns:
            The path of the file.

        Raises:
            NotFoundError: There is no such sweep or file.
            SpecError: `to` is a URL: it is written on this machine.
        """
        from tune_jobs.sweeps.storage import local_path

        return download(self._connection, f"{API}{sweep_path(name)}/{quote(path)}", local_path(to))

    # -- as it happens

    def events(self, name: str | None = None, *, last_id: str | None = None) -> Iterator[Event]:
        """Give what changes of a sweep, or in the list of sweeps, as it happens, until it is deleted.

        After a lost connection it goes on where it was; if that is known no more, there is an event `reset`.

        Args:
            name: The sweep; None: the list.
            last_id: The id of an event, after which it goes on; None: from now on, beginning with `status` and `job`.

        Raises:
            NotFoundError: There is no such sweep.
        """
        path = f"{API}/events" if name is None else f"{API}{sweep_path(name)}/events"
        return follow(self._connection, path, last_id=last_id, patience_s=self._patience_s)

    def job_events(self, job: Job) -> Iterator[tuple[Event, Job]]:
        """Give the events of a job's sweep, each with the job as it is then; the last one is the first of its end.

        Raises:
            NotFoundError: The sweep was deleted.
        """
        is_first = True
        for event in self.events(job.sweep):
            if event.kind == "deleted":
                raise NotFoundError(f"Sweep {job.sweep} was deleted.", "List the sweeps with `tune-jobs list`.")
            if is_first or event.kind == "reset":
                # It may have changed before anybody watched.
                job, is_first = self.job(job.id), False
            elif event.kind == "job" and event.data["id"] == job.id:
                job = self._read(Job, event.data)
            yield event, job
            if job.state == "ended":
                return

    def wait(self, name: str, *, job: Job | None = None, timeout_s: float | None = None) -> Summary:
        """Wait until a sweep neither waits nor runs, or until one of its jobs has ended; return the sweep.

        Args:
            name: The sweep.
            job: The job; None: all of them, and whoever runs the sweep from a terminal.
            timeout_s: How long at most, in seconds; None: as long as it takes.

        Raises:
            NotFoundError: There is no such sweep, or no more.
            CannotRunError: It took longer than that.
        """
        began = answered = time.monotonic()
        wait_s = _POLL_S
        while True:
            now = time.monotonic()
            try:
                if self._is_over(name, job):
                    return self.sweep(name)
                answered = time.monotonic()
            except (LostConnectionError, NoServiceError):
                if not self._connection.has_answered or now - answered > self._patience_s:
                    raise
            if timeout_s is not None and now - began > timeout_s:
                raise CannotRunError(
                    f"Sweep {name} has not ended after {timeout_s:g} s.", "It goes on: wait for longer, or stop it."
                )
            time.sleep(wait_s if timeout_s is None else min(wait_s, max(0.0, began + timeout_s - now)))
            wait_s = min(_MOST_POLL_S, 1.5 * wait_s)

    def _is_over(self, name: str, job: Job | None) -> bool:
        if job is not None:
            return self.job(job.id).state == "ended"
        last = self.sweep(name).job
        return (last is None or last.state == "ended") and not self.status(name).alive
