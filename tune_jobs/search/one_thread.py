"""Let models compute with one thread, as trials train on the cores and the models' matrices are small.

NumPy's OpenBLAS has a thread a core, which wait for each other by turning round and round. Where every core trains a
pack, a point that takes 16 ms took up to a second, and time from the packs. With one thread the sums are also formed in
the same order on every machine.
"""

from __future__ import annotations

import contextlib
import functools
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let matrix products of NumPy and SciPy use one thread in this block, in all threads of this process."""
    with _pools(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


@functools.lru_cache(maxsize=1)
def _pools(num_modules: int) -> ThreadpoolController:  # noqa: ARG001 - it is made again when there are others
    # It knows the libraries that are loaded when it is made, and looks for them for two milliseconds.
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
