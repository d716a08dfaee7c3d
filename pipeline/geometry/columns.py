"""Tables of columns of equal length: columns that grow at the end, rows of a table, and quantisation.

The front end quantises the data of a scan that is integrated over many scans, for a first run and for a
rerun, so that the scan cache stores it in few bytes without loss. The steps are powers of two, so that their
multiples are exact.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.file_arrays import extended

POINT = 1.0 / 256  # m; step of a return: a standard error of 1.1 mm, that of a sensor is 10 to 30 mm
GROUND = 1.0 / 1024  # m; step of a ground height

Real = TypeVar("Real", np.float32, np.float64)


def rounded(values: NDArray[Real], step: float) -> NDArray[Real]:
    """Return values rounded to the nearest multiple of `step`, with their type and shape; a value half-way
    between two multiples is rounded to the even one, and -0 becomes 0. NaN and infinity remain.

    Args:
        values: Values, float32 or float64, any shape; not changed.
        step: A power of two.
    """
    kind = values.dtype.type
    result: NDArray[Real] = np.rint(values * kind(1.0 / step)) * kind(step) + kind(0.0)  # + 0 turns -0 into 0
    return result


Column = NDArray[Any]


class GrowingColumns:
    """Columns of N rows; the capacity doubles when it is full. Large columns are in files, see `extended`.

    Columns that `shared` returned share their memory with later ones, but their values never change: where
    one of their rows is replaced, the columns get new memory.

    Args:
        columns: The rows so far, each of shape (N, ...); copied.
    """

    def __init__(self, *columns: Column) -> None:
        self._columns = [column.copy() for column in columns]
        self._length, self._rows_shared = len(columns[0]), 0

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._length

    def column(self, number: int) -> Column:
        """Return the column with this number, from 0, of all rows; a view that later calls may change."""
        return self._columns[number][: self._length]

    def shared(self) -> list[Column]:
        """Return all columns of all rows, whose values never change; they are not copied."""
        self._rows_shared = max(self._rows_shared, self._length)
        return [column[: self._length] for column in self._columns]

    def write(self, start: int, *rows: Column) -> None:
        """Replace the rows from `start`, which is at most N, onwards; N becomes `start` plus the number of
        the new rows.

        Args:
            start: First row.
            rows: The new rows of each column.
        """
        end, capacity = start + len(rows[0]), len(self._columns[0])
        if start < self._rows_shared or end > capacity:
            capacity = 2 * end if end > capacity else capacity
            # Set once all rows are copied: another thread may read them.
            self._columns = [extended(column, capacity) for column in self._columns]
            self._rows_shared = 0
        for column, new in zip(self._columns, rows, strict=True):
            column[start:end] = new
        self._length = end

    def return_to(self, length: int) -> None:
        """Set N to `length`, at most the largest N so far. A larger N than the present one gives back the
        rows that were written there last."""
        self._length = length


Table = TypeVar("Table")


def rows_of(table: Table, rows: Any) -> Table:  # noqa: ANN401 - what indexes an array
    """Return some rows of a record of columns, for example of `Trees`; columns that are None stay None. The
    columns are copies; for a slice they are views.

    Args:
        table: A dataclass whose fields are arrays of equal length, or None.
        rows: Row numbers, a mask or a slice.
    """
    columns = {f.name: getattr(table, f.name) for f in fields(table)}  # type: ignore[arg-type]
    return type(table)(**{name: None if c is None else c[rows] for name, c in columns.items()})


def columns_of(table: object) -> list[Column]:
    """Return the columns of a record whose fields are arrays, such as a `Path`, in the order of fields."""
    return [getattr(table, f.name) for f in fields(table)]  # type: ignore[arg-type]


def rows_in_common(old: Table, new: Table) -> int:
    """Return the number of leading rows that two records of columns share, at most the rows of the shorter
    one; see `first_difference`."""
    return min(map(first_difference, columns_of(old), columns_of(new)))


def first_difference(old: NDArray[Any] | None, new: NDArray[Any]) -> int:
    """Return the number of leading rows that are equal in two arrays, at most the number of rows of the
    shorter one. NaN differs from NaN, except in arrays that share their memory, see `GrowingColumns`.

    Args:
        old: Rows, shape (M, ...); None has no rows.
        new: Rows, shape (N, ...), with the same number of columns.
    """
    if old is None:
        return 0
    n = min(len(old), len(new))
    if _has_same_memory(old, new):
        return n
    differs = (old[:n] != new[:n]).reshape(n, -1).any(axis=1) if n else np.zeros(0, np.bool_)
    return int(np.argmax(differs)) if differs.any() else n


def _has_same_memory(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Return whether two arrays have their rows at the same addresses; their lengths may differ."""
    layouts = [(x.__array_interface__["data"], x.strides, x.dtype) for x in (a, b)]
    return layouts[0] == layouts[1]


def evenly_spaced(n: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` row numbers of a table of n rows, int64, evenly spaced, ascending and without
    repetition; all of them if there are no more."""
    return np.arange(n) if n <= most else np.arange(most) * n // most
