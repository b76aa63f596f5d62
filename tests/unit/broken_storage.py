"""A storage whose paths give no answer, and the pathlib of Python 3.14, to which that is "it isn't there"."""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from os import stat_result
from pathlib import Path
from typing import cast

import pytest

Fail = Callable[..., AbstractContextManager[None]]
"""Lets a path, and with `below=True` all below it, give the error of a number to the `calls` for it, in a block."""

LISTING = ("listdir", "scandir")
_CALLS = ("stat", "lstat", "open", *LISTING)

# As in Lib/pathlib/__init__.py of Python 3.14, where any OSError is a False.
_OF_3_14 = {
    "exists": os.path.exists, "is_dir": os.path.isdir, "is_file": os.path.isfile, "is_symlink": os.path.islink,
}  # fmt: skip


@pytest.fixture(params=["own", "3.14"])
def pathlib_of(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Python's own pathlib, and that of 3.14."""
    if request.param == "3.14":
        for name, function in _OF_3_14.items():
            monkeypatch.setattr(Path, name, lambda path, function=function: function(path))
    return str(request.param)


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch) -> Fail:
    @contextlib.contextmanager
    def failing(at: Path, number: int, *, below: bool = False, calls: Sequence[str] = _CALLS) -> Iterator[None]:
        def called(name: str) -> Callable[..., int | stat_result | list[str]]:
            real = getattr(os, name)

            def call(path: object, *arguments: int, **options: object) -> int | stat_result | list[str]:
                asked = Path(os.fspath(path)) if isinstance(path, str | os.PathLike) else Path()
                if asked == at or (below and at in asked.parents):
                    raise OSError(number, os.strerror(number), str(asked))
                return cast("int | stat_result | list[str]", real(path, *arguments, **options))

            return call

        with monkeypatch.context() as patch:
            for name in calls:
                patch.setattr(os, name, called(name))
            yield

    return failing
