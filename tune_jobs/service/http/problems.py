"""Errors as problem documents (RFC 9457), with the messages of the command line."""

from __future__ import annotations

import logging
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from policies.errors import CannotRunError, CheckpointError, EnvFailedError, NotFoundError, SpecError, TuneJobsError
from tune_jobs.service.access.refusal import RefusedError
from tune_jobs.service.problem_documents import problem
from tune_jobs.service.queue import KeyUsedError
from tune_jobs.spec.problems import WrongSpecError

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
    (CannotRunError, HTTPStatus.SERVICE_UNAVAILABLE),
)


def add_handlers(app: FastAPI) -> None:
    """Let all errors of an app be problem documents."""

    @app.exception_handler(TuneJobsError)
    async def _told(_: Request, error: TuneJobsError) -> JSONResponse:
        status = next((code for kind, code in _STATUS if isinstance(error, kind)), HTTPStatus.INTERNAL_SERVER_ERROR)
        problems = [item._asdict() for item in error.problems] if isinstance(error, WrongSpecError) else []
        return problem(status, error.message, hint=error.hint, problems=problems)

    @app.exception_handler(RefusedError)
    async def _refused(_: Request, error: RefusedError) -> JSONResponse:
        return error.answer()

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        problems = [
            {"path": ".".join(str(part) for part in item["loc"]), "text": item["msg"]} for item in error.errors()[:100]
        ]
        told = "; ".join(f"{item['path']}: {item['text']}" for item in problems[:3])
        return problem(HTTPStatus.UNPROCESSABLE_ENTITY, f"The request is wrong: {told}", problems=problems)

    @app.exception_handler(HTTPException)
    async def _http(_: Request, error: HTTPException) -> JSONResponse:
        answer = problem(error.status_code, str(error.detail))
        answer.headers.update(error.headers or {})
        return answer

    @app.exception_handler(SQLAlchemyError)
    async def _database(_: Request, error: SQLAlchemyError) -> JSONResponse:
        _log.error("The database can't be used: %s", error)
        answer = problem(HTTPStatus.SERVICE_UNAVAILABLE, "The service's database can't be used just now. Try again.")
        answer.headers["Retry-After"] = "5"
        return answer

    @app.exception_handler(Exception)
    async def _unexpected(_: Request, error: Exception) -> JSONResponse:
        _log.error("Unexpected %s", type(error).__name__, exc_info=error)
        detail = f"Unexpected {type(error).__name__}; the service's log has the traceback."
        return problem(HTTPStatus.INTERNAL_SERVER_ERROR, detail)
