"""The ASGI application of a service."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

from fastapi import FastAPI
from starlette.types import ASGIApp
from typing_extensions import override

from tune_jobs.service.access.middleware import AccessMiddleware
from tune_jobs.service.http import (
    access_routes,
    action_routes,
    comparison_routes,
    download_routes,
    event_routes,
    meta_routes,
    metrics_routes,
    play_routes,
    record_routes,
    sweep_routes,
)
from tune_jobs.service.http.compression import CompressionMiddleware
from tune_jobs.service.http.openapi import complete
from tune_jobs.service.http.problems import add_handlers
from tune_jobs.service.http.requests import RequestMiddleware
from tune_jobs.service.page import routes as page_routes
from tune_jobs.service.service import Service


class _App(FastAPI):
    """An application with the access layer outside of everything else, answers to unexpected errors among it."""

    def __init__(self, service: Service, **settings: Any) -> None:
        super().__init__(**settings)
        self._gate, self._metrics = service.gate, service.metrics

    @override
    def build_middleware_stack(self) -> ASGIApp:
        # What is refused is counted, too.
        compressing = CompressionMiddleware(super().build_middleware_stack())
        return RequestMiddleware(AccessMiddleware(compressing, self._gate), self._metrics)

    @override
    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document, with what the routes do not say."""
        is_new = self.openapi_schema is None
        document = super().openapi()
        if is_new:
            complete(document)
        return document


def make_app(service: Service) -> FastAPI:
    """Return the application, with all routes."""
    app = _App(
        service,
        title="tune-jobs",
        version=version("tune-jobs"),
        summary="Hyperparameter search for reinforcement learning.",
        openapi_url="/api/v1/openapi.json",
        # The pages of FastAPI load their scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    service.metrics.ask_for_players(play_routes.num_playing)
    add_handlers(app)
    modules = (
        access_routes,
        meta_routes,
        metrics_routes,
        sweep_routes,
        record_routes,
        action_routes,
        event_routes,
        comparison_routes,
        download_routes,
        play_routes,
        page_routes,
    )
    for module in modules:
        app.include_router(module.router)
    return app
