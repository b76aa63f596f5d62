"""The OpenAPI document: what FastAPI knows of the routes, and what it can't: access, errors, the names in paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tune_jobs.service.access.middleware import PUBLIC_PATHS
from tune_jobs.service.problem_documents import Problem, problems

_SECURITY_SCHEMES = {
    "token": {
        "type": "http",
        "scheme": "bearer",
        "description": "Made by `tune-jobs token make`. On the service's own machine none is needed by default.",
    },
    "cookie": {
        "type": "apiKey",
        "in": "cookie",
        "name": "tune-jobs-PORT",
        "description": "The page's, given by `/api/v1/login`; with TLS its name begins with `__Host-`. Changes need "
        "the header Origin or Sec-Fetch-Site, too.",
    },
}
_ANYWHERE = {
    400: "The request can't be read, or its header Host names another service.",
    403: "It comes from the page of another site, or whoever asks may not do this.",
    413: "Its body is too large.",
    500: "Something that the service did not expect, such as a damaged file; `detail` says what.",
    503: "The database, or the storage folder, can't be used just now; try again.",
}
_WITH_TOKEN = {
    401: "A token is needed, or the one that was shown is wrong, has expired or was revoked.",
    429: "Too many wrong tokens have come from this address; the header Retry-After says when to come again.",
}
_WITH_INPUT = {422: "A parameter or the body is wrong; `problems` says where."}
_WITH_BODY = {408: "The body did not arrive in time."}
_CHANGING = {507: "The disk is full; nothing was changed."}
_OF_A_SWEEP = {404: "There is no such sweep, or it has no such part."}
_PATH_PARAMETERS = {
    "name": "Name of the sweep.",
    "trial_id": "Id of the trial, such as t0003.",
    "iteration": "The iteration whose checkpoint it is.",
    "film": "Which film, as `files` lists them.",
    "file": "One of the policy's two files, as `files` lists them.",
    "path": "A file of the report, as `files` lists them; empty: its page.",
}
_METHODS = frozenset({"get", "put", "post", "delete", "options", "head", "patch", "trace"})


def complete(document: dict[str, Any]) -> dict[str, Any]:
    """Add to FastAPI's document what the access layer asks for and answers, and the errors of all routes.

    Args:
        document: It, which is changed.
    """
    document["security"] = [{"token": []}, {"cookie": []}]
    components = document.setdefault("components", {})
    components["securitySchemes"] = _SECURITY_SCHEMES
    schemas = components.setdefault("schemas", {})
    schemas["Problem"] = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas |= schemas["Problem"].pop("$defs", {})
    # FastAPI's own errors are never answered.
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    for path, methods in document["paths"].items():
        for method in _METHODS & methods.keys():
            operation = methods[method]
            if path in PUBLIC_PATHS:
                operation["security"] = []
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "path":
                    parameter.setdefault("description", _PATH_PARAMETERS.get(parameter["name"], ""))
            _add_problems(operation["responses"], _problems_of(path, method, operation))
    return document


def _problems_of(path: str, method: str, operation: Mapping[str, Any]) -> dict[int, str]:
    """Return what may go wrong with an operation, besides what its route says."""
    found = dict(_ANYWHERE)
    if path not in PUBLIC_PATHS:
        found |= _WITH_TOKEN
    if operation.get("parameters") or "requestBody" in operation:
        found |= _WITH_INPUT
    if method != "get":
        # Whatever the route reads, the layer before it waits for the body.
        found |= _WITH_BODY | _CHANGING
    if "{name}" in path or any(parameter["name"] == "sweeps" for parameter in operation.get("parameters", ())):
        found |= _OF_A_SWEEP
    return found


def _add_problems(responses: dict[str, Any], found: Mapping[int, str]) -> None:
    # What FastAPI says of 422 is its own form of errors.
    responses.pop("422", None)
    for status, response in problems(found).items():
        responses.setdefault(str(status), response)
