"""The ASGI application of a service."""

from __future__ import annotations

from importlib.metadata import version

from fastapi import FastAPI

from tune_jobs.service.http import action_routes, event_routes, meta_routes, play_routes, sweep_routes
from tune_jobs.service.http.problems import add_handlers
from tune_jobs.service.service import Service


def make_app(service: Service) -> FastAPI:
    """Return the application, with all routes."""
    app = FastAPI(
        title="tune-jobs",
        version=version("tune-jobs"),
        summary="Hyperparameter search for reinforcement learning.",
        openapi_url="/api/v1/openapi.json",
        # The pages of FastAPI load their scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    app.state.service = service
    add_handlers(app)
    for module in (meta_routes, sweep_routes, action_routes, event_routes, play_routes):
        app.include_router(module.router)
    return app
