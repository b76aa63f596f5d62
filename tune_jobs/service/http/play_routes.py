"""Watch a policy play: an episode as server-sent events, played by a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Query
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from policies.envs.ids import module_of
from policies.envs.modules import allow_modules, allowed_again, is_allowed
from policies.errors import NotFoundError, SpecError
from tune_jobs.service.http.best_policy import has_best, no_best
from tune_jobs.service.http.caller import TheService
from tune_jobs.service.http.problems import TooManyError
from tune_jobs.service.player import LEAST_SPEED, MAX_STEPS, MOST_SPEED
from tune_jobs.service.problem_documents import problems
from tune_jobs.service.service import Service
from tune_jobs.spec.file import stored_spec
from tune_jobs.store.contract import Sweep

router = APIRouter(prefix="/api/v1/sweeps/{name}", tags=["watch it play"])

_ROOT = str(Path(__file__).parents[3])
_BEGIN = f"""\
import sys
sys.path.insert(0, {_ROOT!r})
import tune_jobs
del sys.path[0]
from tune_jobs.service.player import main
main()
"""
_MAX_LINE = 8 * 1024**2
_PATIENCE_S = 60.0
"""How long an environment may take for one step before the episode is ended."""
_playing: set[_Play] = set()


def num_playing() -> int:
    """Return how many episodes are being played."""
    return len(_playing)


class _Play(StreamingResponse):
    """An episode, while one more may be played.

    Args:
        request: What is played, see `player.play`.
        sweep: The sweep that its policy is of, which is kept while it is played.
        folder: Where its process begins.
        limit: How many episodes may be played at once.
    """

    media_type = "text/event-stream"

    def __init__(self, request: dict[str, Any], sweep: Sweep, folder: str, limit: int) -> None:
        # An abandoned connection ends the generator, and with it the process.
        super().__init__(
            self._events(request, folder), headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        )
        self._limit, self._sweep = limit, sweep
        self.pid: int | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Play it.

        Raises:
            TooManyError: As many episodes are played as may.
        """
        # Nothing else runs between the look and the taking of the place, and whatever comes then gives it back.
        if len(_playing) >= self._limit:
            raise TooManyError(f"{self._limit} episodes are being played.", "Close one, or wait for its end.")
        _playing.add(self)
        try:
            await super().__call__(scope, receive, send)
        finally:
            _playing.discard(self)

    async def _events(self, request: dict[str, Any], folder: str) -> AsyncIterator[str]:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-P", "-c", _BEGIN,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
            cwd=folder, start_new_session=True, limit=_MAX_LINE,
        )  # fmt: skip
        self.pid = process.pid
        try:
            if process.stdin is None or process.stdout is None:
                raise RuntimeError("the player has no pipes")
            process.stdin.write(json.dumps(request).encode())
            process.stdin.close()
            last = ""
            while True:
                try:
                    line = await asyncio.wait_for(process.stdout.readline(), _PATIENCE_S)
                except TimeoutError:
                    yield _event(
                        "problem", {"detail": f"The environment took over {_PATIENCE_S:g} s for a step.", "hint": ""}
                    )
                    return
                if not line:
                    break
                told = json.loads(line)
                last = told.pop("event")
                yield _event(last, told)
            if last not in ("end", "problem"):
                yield _event("problem", {"detail": "The environment ended the process that played it.", "hint": ""})
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            with anyio.CancelScope(shield=True):
                await process.wait()


@router.get(
    "/play",
    response_class=_Play,
    # FastAPI would look for it in the arguments of the class.
    status_code=200,
    responses=problems({429: "As many episodes are played as may, or too many wrong tokens came from this address."}),
)
async def play(
    name: str,
    service: TheService,
    *,
    trial: Annotated[str | None, Query(max_length=20, description="A trial; without it, the best policy.")] = None,
    iteration: Annotated[int | None, Query(ge=0, description="Of its checkpoint; without it, the latest.")] = None,
    random: Annotated[bool, Query(description="A random policy instead.")] = False,
    seed: Annotated[int, Query(ge=0, le=2**32 - 1, description="Seed of the episode.")] = 0,
    speed: Annotated[float, Query(ge=LEAST_SPEED, le=MOST_SPEED, description="1: the env's own time.")] = 1.0,
    start: Annotated[int, Query(ge=0, le=MAX_STEPS, description="The first env step that is told.")] = 0,
) -> _Play:
    """Play one greedy episode: the events `info`, `step` after step, and `end`, or `problem`."""
    request, sweep = await anyio.to_thread.run_sync(_request, service, name, trial, iteration, random)
    told = {**request, "seed": seed, "speed": speed, "start": start}
    return _Play(told, sweep, str(service.config.working_folder), service.config.limits.players)


def _request(
    service: Service,
    name: str,
    trial: str | None,
    iteration: int | None,
    random: bool,  # noqa: FBT001
) -> tuple[dict[str, Any], Sweep]:
    """Return what is played, and the sweep, with which the policy's files may be removed."""
    record = service.statuses.see(name).status.sweep
    spec = stored_spec(record)
    sweep = service.storage.sweep(name)
    if random:
        policy = "random"
    elif trial is None:
        if not has_best(service, sweep):
            raise no_best(sweep)
        policy = str(sweep.best_folder)
    else:
        kept = sweep.trial(trial).checkpoint_iterations()
        if not kept or (iteration is not None and iteration not in kept):
            has = f"it has those of iterations {', '.join(map(str, kept))}" if kept else "it has none yet"
            raise NotFoundError(f"Trial {trial} of sweep {name} has no such checkpoint: {has}.")
        policy = str(sweep.trial(trial).checkpoint_folder(kept[-1] if iteration is None else iteration))
    _refuse_other_modules(service, name, [spec.env.id] if random else [spec.env.id, spec.rl_module or ""])
    # Not those that the record allows: a viewer's token would import what the operator never allowed.
    modules = list(service.config.modules)
    request = {"policy": policy, "env_id": spec.env.id, "env_args": spec.env.wrapped_args, "modules": modules}
    return request, sweep


def _refuse_other_modules(service: Service, name: str, paths: Sequence[str]) -> None:
    """Refuse what the player would: its answer is about the command line, and its process takes a second to begin.

    Raises:
        SpecError: A path names a module that the service does not allow.
    """
    with allowed_again():
        allow_modules(service.config.modules)
        for path in paths:
            module = module_of(path)
            if module is not None and not is_allowed(module):
                raise SpecError(
                    f"Playing a policy of sweep {name} would import the Python module {module!r}, which this service "
                    "does not allow.",
                    f"If you trust it, have the operator start the service with `serve --allow-module {module}`.",
                )


def _event(kind: str, data: Any) -> str:
    return f"event: {kind}\ndata: {json.dumps(data)}\n\n"
