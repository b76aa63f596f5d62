"""Sweeps side by side."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query

from tune_jobs.service.http.caller import TheService
from tune_jobs.service.http.waiting import waits_aside
from tune_jobs.sweeps.plain import to_json

router = APIRouter(prefix="/api/v1", tags=["comparisons"])


@router.get("/comparisons")
@waits_aside
def comparisons(
    service: TheService,
    sweeps: Annotated[str, Query(max_length=2_000, description="From 2 to 6 sweeps, separated by commas.")],
) -> dict[str, Any]:
    """Compare sweeps by their leading settings, as `tune-jobs compare`; of running ones as of a while ago.

    Besides what that says there are: how the best return of each rose with the env steps spent, how the leading
    setting of each learns, and what their sweep files say differently.
    """
    names = [name for text in sweeps.split(",") if (name := text.strip())]
    found: dict[str, Any] = to_json(service.derived.comparison(names))
    return found
