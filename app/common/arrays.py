"""Rows of arrays and tables: some of a table, those that two arrays share, and an even selection."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")


def rows_of(table: T, rows: Any) -> T:  # noqa: ANN401 - what indexes an array
    """Return some rows of a record of columns, for example of `Trees`; columns that are None stay None. The
    columns are copies; for a slice they are views.

    Args:
        table: A dataclass whose fields are arrays of equal length, or None.
        rows: Indexes, a mask or a slice.
    """
    columns = {f.name: getattr(table, f.name) for f in fields(table)}  # type: ignore[arg-type]
    return type(table)(**{name: None if c is None else c[rows] for name, c in columns.items()})


def first_difference(old: NDArray[Any] | None, new: NDArray[Any]) -> int:
    """Return the number of leading rows that are equal in two arrays, at most the number of rows of the
    shorter one. NaN differs from NaN, except in arrays that share their memory, see `GrowingColumns`.

    Args:
        old: Shape (M, ...); None has no rows.
        new: Shape (N, ...), with the same number of columns.
    """
    if old is None:
        return 0
    n = min(len(old), len(new))
    if _has_same_memory(old, new):
        return n
    differs = (old[:n] != new[:n]).reshape(n, -1).any(axis=1) if n else np.zeros(0, np.bool_)
    return int(np.argmax(differs)) if differs.any() else n


def _has_same_memory(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Return whether two arrays have their rows at the same addresses."""
    layouts = [(x.__array_interface__["data"], x.strides, x.dtype) for x in (a, b)]
    return layouts[0] == layouts[1]


def evenly_spaced(n: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` row numbers of a table of n rows, int64, evenly spaced, ascending and without
    repetition; all of them if there are no more."""
    return np.arange(n) if n <= most else np.arange(most) * n // most
