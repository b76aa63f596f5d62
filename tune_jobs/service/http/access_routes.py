"""Logging in and out, and the audit log."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response

from tune_jobs.service.access.credentials import WRONG_TOKEN, set_cookie
from tune_jobs.service.http.caller import AnAdmin, TheCaller, TheService
from tune_jobs.service.http.models import TEXT, AuditPage, LoggedIn, Login
from tune_jobs.service.problem_documents import problems

_LONGEST_S = 30 * 86_400
"""How long a browser keeps a cookie at most."""

router = APIRouter(prefix="/api/v1", tags=["access"])


@router.post(
    "/login",
    responses=problems(
        {
            401: "The token is wrong, has expired or was revoked.",
            429: "Too many wrong ones have come from this address.",
        }
    ),
)
def login(given: Login, service: TheService, request: Request, response: Response) -> LoggedIn:
    """Give the page a cookie in exchange for a token."""
    gate, state = service.gate, request.state
    token = gate.find(given.token, state.client)
    now = gate.tokens.now()
    if token is None or token.state(now) != "valid":
        raise HTTPException(401, "This token is wrong, has expired or was revoked.", {"WWW-Authenticate": WRONG_TOKEN})
    state.caller = token.caller
    left_s = _LONGEST_S if token.expires_at is None else min(_LONGEST_S, int(token.expires_at - now))
    response.headers["Set-Cookie"] = set_cookie(
        state.cookie, given.token, left_s, is_tls=request.scope["scheme"] == "https"
    )
    return LoggedIn(name=token.name, role=token.role)


@router.post("/logout", status_code=204)
def logout(request: Request, response: Response, _: TheCaller) -> None:
    """Take the page's cookie. The token stays valid."""
    response.headers["Set-Cookie"] = set_cookie(request.state.cookie, "", 0, is_tls=request.scope["scheme"] == "https")


@router.get("/audit")
def audit(
    service: TheService,
    _: AnAdmin,
    *,
    who: Annotated[str | None, Query(max_length=100, pattern=TEXT, description="Only what this person did.")] = None,
    target: Annotated[
        str | None, Query(max_length=200, pattern=TEXT, description="Only what was done with this sweep.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=1_000, description="The most entries of a page.")] = 100,
    cursor: Annotated[str | None, Query(max_length=100, description="`next_cursor` of the page before.")] = None,
) -> AuditPage:
    """List who changed what, the newest first."""
    entries, following = service.gate.audit.page(limit=limit, cursor=cursor, who=who, target=target)
    return AuditPage(entries=entries, next_cursor=following)
