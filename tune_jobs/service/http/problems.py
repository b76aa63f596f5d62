"""Errors as problem documents (RFC 9457), with the messages of the command line."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.routing import compile_path

from policies.errors import CannotRunError, CheckpointError, EnvFailedError, NotFoundError, SpecError, TuneJobsError
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.problem_documents import database_problem, full_disk_problem, is_full, problem
from tune_jobs.service.queue import KeyUsedError
from tune_jobs.service.submitting import DoesNotFitError
from tune_jobs.spec.problems import WrongSpecError
from tune_jobs.store.objects.bucket import ConflictError, StorageError

_log = logging.getLogger(__name__)


class NotNowError(TuneJobsError):
    """It contradicts what the sweep does just now, such as deleting one that runs."""


class TooManyError(TuneJobsError):
    """Somebody has as many of something as the service allows."""


_STATUS: tuple[tuple[type[TuneJobsError], HTTPStatus], ...] = (
    (NotNowError, HTTPStatus.CONFLICT),
    (TooManyError, HTTPStatus.TOO_MANY_REQUESTS),
    (KeyUsedError, HTTPStatus.UNPROCESSABLE_ENTITY),
    (SpecError, HTTPStatus.UNPROCESSABLE_ENTITY),
    # Damaged is another thing than missing, though the one is a kind of the other.
    (CheckpointError, HTTPStatus.INTERNAL_SERVER_ERROR),
    (NotFoundError, HTTPStatus.NOT_FOUND),
    (EnvFailedError, HTTPStatus.UNPROCESSABLE_ENTITY),
    (DoesNotFitError, HTTPStatus.UNPROCESSABLE_ENTITY),
    (CannotRunError, HTTPStatus.SERVICE_UNAVAILABLE),
)

_RETRY_AFTER_S, _RETRY_AFTER_CHANGE_S = "5", "60"
"""Seconds after which a request may do that an object store didn't answer, or refused: then somebody has to change
something."""
_FRAMEWORKS = {
    "Not Found": ("There is nothing at this path.", "See the routes in /api/v1/openapi.json."),
    "There was an error parsing the body": (
        "The body of the request can't be read as JSON.",
        "Send JSON in UTF-8; numbers have at most 4,300 digits.",
    ),
}
"""What is said for what Starlette and FastAPI say."""


def add_handlers(app: FastAPI) -> None:
    """Let all errors of an app be problem documents."""
    handlers: dict[type[Exception], Any] = {
        TuneJobsError: _told,
        RefusedError: _refused,
        RequestValidationError: _invalid,
        HTTPException: _http,
        SQLAlchemyError: _database,
        OSError: _system,
        Exception: _unexpected,
    }
    for kind, handler in handlers.items():
        app.add_exception_handler(kind, handler)


async def _told(_: Request, error: TuneJobsError) -> JSONResponse:
    if (store_error := _of_store(error)) is not None:
        answer = problem(
            HTTPStatus.SERVICE_UNAVAILABLE, store_error.message, hint=store_error.hint, error=CannotRunError.__name__
        )
        answer.headers["Retry-After"] = _RETRY_AFTER_S if store_error.passes else _RETRY_AFTER_CHANGE_S
        return answer
    status = next((code for kind, code in _STATUS if isinstance(error, kind)), HTTPStatus.INTERNAL_SERVER_ERROR)
    if status == HTTPStatus.SERVICE_UNAVAILABLE and is_full(error):
        return full_disk_problem(error.message)
    problems = [item._asdict() for item in error.problems] if isinstance(error, WrongSpecError) else []
    # Of the words of the command line, which ends with the exit code of this kind of error.
    kind = next(item.__name__ for item in type(error).__mro__ if item.__module__ == TuneJobsError.__module__)
    return problem(status, error.message, hint=error.hint, error=kind, problems=problems)


def _of_store(error: BaseException | None) -> StorageError | None:
    """Return the error of an object store that another one came of."""
    while error is not None and not (isinstance(error, StorageError) and not isinstance(error, ConflictError)):
        error = error.__cause__
    return error


async def _refused(_: Request, error: RefusedError) -> JSONResponse:
    return error.answer()


async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
    problems = [
        {"path": ".".join(str(part) for part in item["loc"]), "text": item["msg"]} for item in error.errors()[:100]
    ]
    told = "; ".join(f"{item['path']}: {item['text']}" for item in problems[:3])
    return problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"The request is wrong: {told}.", problems=problems)


async def _http(request: Request, error: HTTPException) -> JSONResponse:
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        return _wrong_method(request)
    detail, hint = _FRAMEWORKS.get(error.detail, (str(error.detail), ""))
    answer = problem(error.status_code, detail, hint=hint)
    answer.headers.update(error.headers or {})
    return answer


async def _database(request: Request, error: SQLAlchemyError) -> JSONResponse:
    request.app.state.service.gate.outages.failed("A request", error)
    return database_problem(error)


async def _system(request: Request, error: OSError) -> JSONResponse:
    if is_full(error):
        return full_disk_problem("There is no space left on the service's disk.")
    return await _unexpected(request, error)


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    _log.error("Unexpected %s", type(error).__name__, exc_info=error)
    request.state.logged = error
    detail = f"Unexpected {type(error).__name__}; the service's log has the traceback."
    return problem(HTTPStatus.INTERNAL_SERVER_ERROR, detail)


def _wrong_method(request: Request) -> JSONResponse:
    # Starlette names the methods of the first of several routes with this path.
    routes = iter_route_contexts(request.app.routes)
    matching = [route for route in routes if route.path and compile_path(route.path)[0].match(request.scope["path"])]
    allowed = ", ".join(sorted({method for route in matching for method in route.methods or ()}))
    answer = problem(
        HTTPStatus.METHOD_NOT_ALLOWED, f"This path takes no {request.method[:20]}.", hint=f"It takes {allowed}."
    )
    answer.headers["Allow"] = allowed
    return answer
