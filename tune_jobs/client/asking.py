"""What all methods of a client share: requests to paths of the API, pages, answers as models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar
from urllib.parse import quote

from pydantic import TypeAdapter, ValidationError

from policies.errors import CannotRunError, SpecError
from tune_jobs.client.address import service_url, token_of
from tune_jobs.client.connection import Connection

API = "/api/v1"
_PAGE = 1_000
_AnyT = TypeVar("_AnyT")


class Asking:
    """A service that is asked; see `Client`."""

    def __init__(
        self,
        url: str,
        token: str | None = None,
        *,
        token_file: str | Path | None = None,
        ca_file: str | Path | None = None,
        timeout_s: float = 60.0,
        patience_s: float = 120.0,
    ) -> None:
        self.url = service_url(url)
        self._patience_s = patience_s
        self._connection = Connection(self.url, token_of(token, token_file), ca_file=ca_file, timeout_s=timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.url!r})"

    def close(self) -> None:
        """Close the connections."""
        self._connection.close()

    def _ask(self, method: str, path: str, **request: Any) -> Any:
        return self._connection.json(method, f"{API}{path}", **request)

    def _pages(self, path: str, key: str, query: Mapping[str, Any]) -> Iterator[Any]:
        cursor = None
        while True:
            page = self._ask("GET", path, query={**query, "limit": _PAGE, "cursor": cursor})
            yield from page[key]
            cursor = page["next_cursor"]
            if cursor is None:
                return

    def _read(self, kind: type[_AnyT], found: Any) -> _AnyT:
        """Return an answer as a model, or as whatever pydantic can make of it."""
        try:
            return TypeAdapter(kind).validate_python(found)
        except ValidationError as error:
            wrong = error.errors()[0]
            where = ".".join(str(part) for part in wrong["loc"])
            raise self.unknown(f"{where}: {wrong['msg']}") from error

    def unknown(self, what: str) -> CannotRunError:
        """Return the error for an answer that another version of tune-jobs gave."""
        return CannotRunError(
            f"The service at {self.url} answers what this tune-jobs does not know: {what}.",
            "It is of another version: update the older one of the two.",
        )


def sweep_path(name: str) -> str:
    """Return the path of a sweep.

    Raises:
        SpecError: It is no name of one.
    """
    if not name or name in (".", "..") or "/" in name or not name.isprintable():
        raise SpecError(f"{name[:200]!r} is no name of a sweep.", "A service knows sweeps by name, not by folder.")
    return f"/sweeps/{quote(name, safe='')}"


def trial_path(name: str, trial_id: str) -> str:
    """Return the path of a trial.

    Raises:
        SpecError: They are no name of a sweep and id of a trial.
    """
    if not (trial_id.isascii() and trial_id.isalnum()):
        raise SpecError(f"{trial_id[:200]!r} is no id of a trial.", "Trials have ids such as t0003.")
    return f"{sweep_path(name)}/trials/{trial_id}"
