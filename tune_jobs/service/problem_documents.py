"""Problem documents (RFC 9457): what the service answers where something is wrong."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel, Field
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from starlette.responses import JSONResponse

from policies.errors import fit

MEDIA_TYPE = "application/problem+json"
_FULL = (errno.ENOSPC, errno.EDQUOT)


class PartOfProblem(BaseModel):
    """One of several things that are wrong."""

    path: str = Field(description="Where, such as space.lr or body.priority.")
    text: str = Field(description="What is wrong there.")


class Problem(BaseModel):
    """What is wrong (RFC 9457)."""

    type: str = Field(description="Always about:blank: the status says what kind of problem it is.")
    title: str = Field(description="The status in words.")
    status: int = Field(description="The HTTP status.")
    detail: str = Field(description="What is wrong, as a sentence.")
    hint: str = Field("", description="What to do about it.")
    error: str = Field("", description="The kind of error in Python, such as SpecError.")
    problems: list[PartOfProblem] = Field(default_factory=list, description="What is wrong, place by place.")


def problem(status: int, detail: str, **more: Any) -> JSONResponse:
    """Return a problem document.

    Args:
        status: The HTTP status.
        detail: What is wrong, as a sentence.
        more: Further members, such as `hint` and `problems`; those that are empty are left out.
    """
    content = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": status, "detail": detail}
    content |= {name: value for name, value in more.items() if value}
    return JSONResponse(_fit(content), status_code=status, media_type=MEDIA_TYPE)


def is_full(error: BaseException | None) -> bool:
    """Whether an error came of a disk that is full."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _FULL:
            return True
        if isinstance(error, DBAPIError) and "disk is full" in str(error.orig):
            return True
        error = error.__cause__
    return False


def full_disk_problem(detail: str) -> JSONResponse:
    """Return what is said where the service's disk is full."""
    return problem(HTTPStatus.INSUFFICIENT_STORAGE, detail, hint="Free some space, then send it again.")


def database_problem(error: SQLAlchemyError) -> JSONResponse:
    """Return what is said where the service's database can't be used."""
    if is_full(error):
        return full_disk_problem("There is no space left on the disk of the service's database.")
    answer = problem(HTTPStatus.SERVICE_UNAVAILABLE, "The service's database can't be used just now. Try again.")
    answer.headers["Retry-After"] = "5"
    return answer


def problems(meanings: Mapping[int, str]) -> dict[int | str, dict[str, Any]]:
    """Return problem documents as `responses` of a route, for the OpenAPI document.

    Args:
        meanings: What each status means, as a sentence.
    """
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {status: {"description": text, "content": content} for status, text in meanings.items()}


def _fit(value: Any) -> Any:
    # Problems quote what came, and halves of surrogate pairs in it are nothing that can be encoded.
    if isinstance(value, str):
        return fit(value)
    if isinstance(value, dict):
        return {name: _fit(item) for name, item in value.items()}
    return [_fit(item) for item in value] if isinstance(value, list) else value
