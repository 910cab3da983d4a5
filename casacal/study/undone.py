"""What a method may do to its process without later ones noticing."""

from __future__ import annotations

import contextlib
import os
import random
import warnings
from collections.abc import Iterator

import numpy as np


@contextlib.contextmanager
def undone(seed: int) -> Iterator[None]:
    """Put back afterwards: folder, environment, error handling of NumPy, warnings, and the common random numbers.

    These begin at a seed, so that a method which draws from them does the same whatever ran before. What overflows
    raises nothing meanwhile.
    """
    folder, environment = _folder(), dict(os.environ)
    drawn = random.getstate(), np.random.get_state()  # noqa: NPY002  the common one is what is meant
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            yield
    finally:
        random.setstate(drawn[0])
        np.random.set_state(drawn[1])  # noqa: NPY002
        if os.environ != environment:
            os.environ.clear()
            os.environ.update(environment)
        if folder is not None and _folder() != folder:
            with contextlib.suppress(OSError):
                os.chdir(folder)


def _folder() -> str | None:
    """The working folder; None where it was removed."""
    try:
        return os.getcwd()
    except OSError:
        return None
