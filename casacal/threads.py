"""How many threads linear algebra may use: the matrices of an arm are too small to share."""

from __future__ import annotations

import os

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def one_thread_each() -> None:
    """Let linear algebra of processes started from here, and of this one where NumPy is not yet loaded, use one thread.

    Threads that share a matrix of thirty unknowns mostly wait for one another. A user's own setting stands.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
