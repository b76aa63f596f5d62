"""What routes depend on: the service, and who asks for what they may do."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import Annotated, cast

from fastapi import Depends, HTTPException, Request

from policies.errors import CheckpointError
from tune_jobs.service.access.callers import RANK, Caller
from tune_jobs.service.access.credentials import CHALLENGE
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.service import Service
from tune_jobs.service.statuses import Seen
from tune_jobs.service.turns import Turn

_AGAIN_S = 10
"""Seconds after which somebody may ask again who has had no turn."""


def service_of(request: Request) -> Service:
    """Return the service that a request came to."""
    return cast("Service", request.app.state.service)


def caller_of(request: Request) -> Caller:
    """Return who asks, as the layer around the application found; it finds nobody where no token is needed."""
    caller: Caller | None = getattr(request.state, "caller", None)
    if caller is None:
        raise HTTPException(401, "A token is needed here.", {"WWW-Authenticate": CHALLENGE})
    return caller


def submitter_of(request: Request) -> Caller:
    """Return who asks, who may submit."""
    caller = caller_of(request)
    if RANK[caller.role] < RANK["submitter"]:
        raise HTTPException(403, f"The token {caller.name!r} is a viewer's: it may look, and change nothing.")
    return caller


def changer_of(request: Request, name: str) -> Caller:
    """Return who asks, who may change the sweep in the path."""
    caller, service = submitter_of(request), service_of(request)
    # Whose the name is not is told so, whatever is the matter with the sweep.
    check_changer(service, caller, name)
    if caller.role != "admin":
        check_changer(service, caller, name, service.statuses.see(name))
    return caller


def deleter_of(request: Request, name: str) -> Caller:
    """Return who asks, who may delete the sweep in the path, unless it turns out to be another one's.

    A damaged sweep doesn't say when it was created, and is still to be deleted by whose its name is. Where it can be
    read after all, the route has to check again.
    """
    caller = submitter_of(request)
    check_changer(service_of(request), caller, name)
    with contextlib.suppress(CheckpointError):
        return changer_of(request, name)
    return caller


def check_changer(service: Service, caller: Caller, name: str, seen: Seen | None = None) -> None:
    """Check that somebody may change a sweep.

    Args:
        service: The service.
        caller: Who asks.
        name: The sweep.
        seen: The sweep as it is; None: whose the name is counts, which may be that of another sweep by now.

    Raises:
        HTTPException: They may not.
    """
    # What can be no name at all is nothing to ask a database for.
    label = service.labels.of(service.storage.sweep(name).name)
    if seen is not None:
        label = label.of(seen.status.sweep.created_at)
    if not caller.may_change(label):
        raise HTTPException(403, f"Sweep {name} belongs to {label.owner or 'nobody'}; only they and admins change it.")


def admin_of(request: Request) -> Caller:
    """Return who asks, who is an admin."""
    caller = caller_of(request)
    if caller.role != "admin":
        raise HTTPException(403, f"The token {caller.name!r} is a {caller.role}'s; only admins may do this.")
    return caller


def set_audit_target(request: Request, sweep: str) -> None:
    """Say which sweep a request is about, for the audit log, where the path does not."""
    request.state.audit_target = sweep


async def planning_turn(request: Request) -> AsyncIterator[Turn]:
    """Wait for a turn at planning, and give it: those who plan much leave threads for others.

    Raises:
        RefusedError: None came in time, whoever asked has left meanwhile, or the service ends.
    """
    turns = service_of(request).planning
    async with turns.turn(submitter_of(request).name) as turn:
        if not turn.has_come and turns.is_closed:
            again = {"Retry-After": str(_AGAIN_S)}
            raise RefusedError(
                503, "The service is ending, and plans no more.", "Send it again once it is back.", again
            )
        if not turn.has_come:
            raise RefusedError(
                429,
                f"Too many sweeps are being planned: at most {turns.of_one} of one person at once, and {turns.at_once} "
                f"of all. No turn came within {turns.wait_s:g} s.",
                f"Send it again in {_AGAIN_S} s.",
                {"Retry-After": str(_AGAIN_S)},
            )
        if await request.is_disconnected():
            # Nobody reads this: the page asks anew with each change of a sweep file, and leaves what it asked before.
            raise RefusedError(408, "Whoever asked has left before the turn came.", "Send it again.")
        yield turn


TheService = Annotated[Service, Depends(service_of)]
TheCaller = Annotated[Caller, Depends(caller_of)]
ASubmitter = Annotated[Caller, Depends(submitter_of)]
AnAdmin = Annotated[Caller, Depends(admin_of)]
AChanger = Annotated[Caller, Depends(changer_of)]
ADeleter = Annotated[Caller, Depends(deleter_of)]
ATurn = Annotated[Turn, Depends(planning_turn)]
