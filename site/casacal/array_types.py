"""Names for the arrays that stand in signatures; shapes and units are in the docstrings."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Numbers."""
Rows: TypeAlias = NDArray[np.bool_]
"""Which rows: true or false for each."""
Index: TypeAlias = NDArray[np.intp]
"""Positions."""
