"""Show a running sweep in a notebook: one output of its cell, which is updated in place."""

from __future__ import annotations

import contextlib
import contextvars
import io
import logging
import sys
import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any

from rich.console import Console, RenderableType

_INTERVAL_S = 0.5
# It says in every cell that ipywidgets is missing, which is not needed here.
_NOISY = logging.getLogger("ray.widgets.util")
WIDTH = 110
_PAGE = "<pre style=\"white-space:pre;line-height:1.2;font-family:Menlo,'DejaVu Sans Mono',monospace\">{code}</pre>"

_outputs: dict[tuple[str, int], _Output] = {}
"""The outputs of the present cell, by the sweep's name and the cell's number."""


def kernel_shell() -> Any:
    """Return the IPython shell if this process is the kernel of a notebook; None: it is not."""
    module = sys.modules.get("IPython")
    shell = None if module is None else module.get_ipython()
    return shell if getattr(shell, "kernel", None) is not None else None


def as_html(drawn: RenderableType) -> str:
    """Return what a terminal would show, as HTML."""
    console = Console(file=io.StringIO(), record=True, width=WIDTH, force_terminal=True, force_jupyter=False)
    console.print(drawn)
    return console.export_html(inline_styles=True, code_format=_PAGE)


class _Output:
    """One output of a cell."""

    def __init__(self) -> None:
        # Whoever runs a notebook has it; it is not required.
        module: Any = import_module("IPython.display")
        self.page = ""
        self._html = module.HTML
        self._handle = module.display(module.HTML(""), display_id=True)

    def show(self, page: str) -> None:
        """Replace what is shown."""
        # A kernel that is shut down shows nothing any more, and the sweep goes on.
        with contextlib.suppress(Exception):
            self._handle.update(self._html(page))


class NotebookView(contextlib.AbstractContextManager[None]):
    """Redraws the output of a sweep while a block runs.

    Args:
        name: The sweep's name; what is shown of it in the same cell is shown in the same place.
        draw: Returns what is to be shown now: a whole page, or a line that is put below the last page.
        is_line: Whether it is a line, which is taken away at the end.
    """

    def __init__(self, name: str, draw: Callable[[], RenderableType], *, is_line: bool) -> None:
        key = (name, int(getattr(kernel_shell(), "execution_count", 0)))
        if key not in _outputs:
            _outputs.clear()
            _outputs[key] = _Output()
        self._output = _outputs[key]
        self._draw = draw
        self._is_line = is_line
        self._level = logging.NOTSET
        self._over = threading.Event()
        # The messages of the thread are of the cell that began it.
        self._thread = threading.Thread(target=contextvars.copy_context().run, args=(self._run,), daemon=True)

    def __enter__(self) -> None:
        self._level = _NOISY.level
        _NOISY.setLevel(logging.WARNING)
        self._show()
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        _NOISY.setLevel(self._level)
        if self._is_line:
            self._output.show(self._output.page)
        else:
            self._output.page = as_html(self._draw())
            self._output.show(self._output.page)

    def _run(self) -> None:
        while not self._over.wait(_INTERVAL_S):
            self._show()

    def _show(self) -> None:
        self._output.show((self._output.page if self._is_line else "") + as_html(self._draw()))
