"""What an env runner in another process raises, told as if it were raised in the process that trains."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from ray.exceptions import RayTaskError

from policies.errors import tellable


class TellsErrors:
    """Makes an env runner tell its errors to the process that called it.

    RLlib's own `apply` (2.60) ends the runner's process at any error: the caller learns that a process died, of exit
    code 1, and the cause is lost.
    """

    _failure: Exception | None = None

    def apply(self, func: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a function with this runner, as RLlib does with one in another process.

        Raises:
            Exception: Whatever the function raises.
        """
        try:
            return func(self, *args, **kwargs)
        except Exception as error:
            self._failure = tellable(error)
            if self._failure is error:
                raise
            raise self._failure from None

    def check_failure(self) -> None:
        """Refuse to go on after an error.

        RLlib does not wait for answers to new weights: an error there would be lost, and the runner would sample with
        the old ones.

        Raises:
            Exception: What an earlier call of `apply` raised.
        """
        if self._failure is not None:
            raise self._failure


@contextlib.contextmanager
def as_raised_there() -> Iterator[None]:
    """Raise what an env runner in another process raised, in place of Ray's error, which is its cause.

    Ray's error has the runner's traceback.
    """
    try:
        yield
    except RayTaskError as error:
        if isinstance(error.cause, Exception):
            raise error.cause from error
        raise
