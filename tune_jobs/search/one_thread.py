"""Let models compute with one thread, as trials train on the cores and the models' matrices are small.

NumPy's OpenBLAS has a thread a core, which spin while they wait for each other. Where every core trains a pack, one
choice in ten took over 180 ms, and CPU time from the packs; with one thread, 24 ms. The sums are then also formed in an
order that does not depend on the number of cores.
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
