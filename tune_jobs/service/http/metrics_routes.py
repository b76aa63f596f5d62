"""What Prometheus asks for."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Response

from tune_jobs.service.http.caller import TheCaller, TheService

router = APIRouter(tags=["service"])

_TEXT: dict[int | str, dict[str, Any]] = {
    200: {"content": {"text/plain": {"schema": {"type": "string"}}}, "description": "Prometheus' text format."}
}


@router.get("/metrics", responses=_TEXT, response_class=Response)
def metrics(
    service: TheService,
    _: TheCaller,
    accept: Annotated[str, Header(description="OpenMetrics, if this names it.")] = "",
) -> Response:
    """Tell how many jobs, sweeps and trials there are, how fast requests are answered, and more, for Prometheus."""
    content, media_type = service.metrics.exposition(accept)
    return Response(content, headers={"Content-Type": media_type, "Cache-Control": "no-store"})
