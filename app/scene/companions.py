"""Clusters have no identity from scan to scan; for a calm picture they are given one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]


class Companions:
    """Gives the clusters of a scan the numbers of the clusters that stood there before.

    Colours and labels follow these numbers, so that neither flickers while the robot drives by.

    Args:
        reach: A cluster farther from its former place than this is another one [m].
    """

    def __init__(self, reach: float = 0.5) -> None:
        self._reach = reach
        self._places: Float = np.zeros((0, 2))
        self._numbers: Int = np.zeros(0, dtype=np.int64)
        self._next = 0

    def follow(self, places: Float) -> Int:
        """Numbers for clusters at these places.

        Args:
            places: shape (K, 2) [m] in the frame of the map.

        Returns:
            A number for each, none twice, shape (K,).
        """
        numbers = np.full(len(places), -1, dtype=np.int64)
        if len(places) and len(self._places):
            gaps = np.linalg.norm(places[:, None, :] - self._places[None, :, :], axis=2)
            for row, column in _nearest_first(gaps, self._reach):
                numbers[row] = self._numbers[column]
        new = numbers < 0
        numbers[new] = self._next + np.arange(int(new.sum()))
        self._next += int(new.sum())
        self._places, self._numbers = np.array(places, dtype=np.float64), numbers
        return numbers


def _nearest_first(gaps: Float, reach: float) -> list[tuple[int, int]]:
    rows, columns = np.nonzero(gaps <= reach)
    order = np.argsort(gaps[rows, columns], kind="stable")
    taken_rows: set[int] = set()
    taken_columns: set[int] = set()
    pairs = []
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if row not in taken_rows and column not in taken_columns:
            taken_rows.add(row)
            taken_columns.add(column)
            pairs.append((row, column))
    return pairs
