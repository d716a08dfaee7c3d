"""Rows of arrays: those that two arrays share, and an even selection of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def first_difference(old: NDArray[Any] | None, new: NDArray[Any]) -> int:
    """Return the number of leading rows that are equal in two arrays, at most the number of rows of the
    shorter one. NaN differs from NaN.

    Args:
        old: Shape (M, ...); None has no rows.
        new: Shape (N, ...), with the same number of columns.
    """
    if old is None:
        return 0
    n = min(len(old), len(new))
    differs = (old[:n] != new[:n]).reshape(n, -1).any(axis=1) if n else np.zeros(0, np.bool_)
    return int(np.argmax(differs)) if differs.any() else n


def evenly_spaced(n: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` row numbers of a table of n rows, int64, evenly spaced, ascending and without
    repetition; all of them if there are no more."""
    return np.arange(n) if n <= most else np.arange(most) * n // most
