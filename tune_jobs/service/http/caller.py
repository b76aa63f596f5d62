"""Who asks, and what they may do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, cast

from fastapi import Depends, HTTPException, Request

from tune_jobs.service.labels import Label
from tune_jobs.service.service import Service

Role = Literal["viewer", "submitter", "admin"]
_RANK: dict[Role, int] = {"viewer": 0, "submitter": 1, "admin": 2}


@dataclass(frozen=True)
class Caller:
    """Who asks.

    Args:
        name: The token's name; on this machine, without a token, `local`.
        role: A viewer looks, a submitter submits and changes their own sweeps, an admin changes all.
    """

    name: str
    role: Role

    def may_change(self, label: Label) -> bool:
        """Whether they may change a sweep."""
        return self.role == "admin" or (self.role == "submitter" and label.owner == self.name)


LOCAL = Caller("local", "admin")


def service_of(request: Request) -> Service:
    """Return the service that a request came to."""
    return cast("Service", request.app.state.service)


def caller_of(request: Request) -> Caller:
    """Return who asks, as the access layer found."""
    caller: Caller = getattr(request.state, "caller", LOCAL)
    return caller


def submitter_of(request: Request) -> Caller:
    """Return who asks, who may submit."""
    caller = caller_of(request)
    if _RANK[caller.role] < _RANK["submitter"]:
        raise HTTPException(403, f"The token {caller.name!r} is a viewer's: it may look, and change nothing.")
    return caller


def changer_of(request: Request, name: str) -> Caller:
    """Return who asks, who may change the sweep in the path."""
    caller = submitter_of(request)
    label = service_of(request).labels.of(name)
    if not caller.may_change(label):
        raise HTTPException(403, f"Sweep {name} belongs to {label.owner or 'nobody'}; only they and admins change it.")
    return caller


TheService = Annotated[Service, Depends(service_of)]
TheCaller = Annotated[Caller, Depends(caller_of)]
ASubmitter = Annotated[Caller, Depends(submitter_of)]
AChanger = Annotated[Caller, Depends(changer_of)]
