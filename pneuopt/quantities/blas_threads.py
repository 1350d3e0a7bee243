"""`one_blas_thread`: linear algebra in the thread that calls it.

BLAS shares products of a few thousand numbers out to all cores, too, and its threads then wait in a loop for the next
one. An identification took a fifth more CPU time by it, and ended no sooner.
"""

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use no threads of its own in this process; its setting from before returns at the end."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _controller() -> "ThreadpoolController":
    """Of the libraries that are loaded: NumPy's, and SciPy's own."""
    import scipy.linalg  # noqa: F401 - a library that is loaded later is not limited
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
