"""Problem documents (RFC 9457): what the service answers where something is wrong."""

from __future__ import annotations

from http import HTTPStatus
from typing import Any

from starlette.responses import JSONResponse

MEDIA_TYPE = "application/problem+json"


def problem(status: int, detail: str, **more: Any) -> JSONResponse:
    """Return a problem document.

    Args:
        status: The HTTP status.
        detail: What is wrong, as a sentence.
        more: Further members, such as `hint` and `problems`; those that are empty are left out.
    """
    content = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": status, "detail": detail}
    content |= {name: value for name, value in more.items() if value}
    return JSONResponse(content, status_code=status, media_type=MEDIA_TYPE)
