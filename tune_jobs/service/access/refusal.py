"""A request that is turned away before it reaches a route."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.responses import JSONResponse

from tune_jobs.service.problem_documents import problem


class RefusedError(Exception):
    """The request is not let in.

    Args:
        status: The HTTP status.
        detail: What is wrong, as a sentence.
        hint: What to do, as an imperative sentence.
        headers: Headers of the answer.
    """

    def __init__(self, status: int, detail: str, hint: str = "", headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self._detail, self._hint, self._headers = status, detail, hint, dict(headers or {})

    def answer(self) -> JSONResponse:
        """Return the answer."""
        made = problem(self.status, self._detail, hint=self._hint)
        made.headers.update(self._headers)
        return made
