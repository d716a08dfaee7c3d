"""Thinning of points in bounded memory."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import Float32, Int, add_to_voxels

FINEST = 0.01  # m
COARSER = 1.5  # factor of the side when the table is full


class Thinned:
    """Thins points: all points in one cube are replaced by their mean.

    When there are more than `most` cubes, the side of the cubes is enlarged and the means so far are thinned
    again.

    Args:
        most: Maximum number of cubes, a power of two.
        side: Side of a cube at the beginning [m].
    """

    def __init__(self, most: int = 1 << 21, side: float = FINEST) -> None:
        self.side = side
        self._most = most
        self._begin(min(1 << 16, most))

    def _begin(self, room: int) -> None:
        """Replace the cubes by an empty table with `room` rows, a power of two."""
        self._keys, self._counts = np.zeros(room, np.int64), np.zeros(room, np.int64)
        self._sums = np.zeros((room, 4))
        self._slots = np.full(2 * room, -1, np.int32)
        self._used = 0

    def add(self, points: Float32, weight: Int | None = None) -> None:
        """Add points of shape (N, 4): x, y, z within 10 km of the origin [m], and another value, which is
        averaged too. `side` grows if the table is full.

        Args:
            points: The points.
            weight: Number of points that each of them represents, shape (N,); None for 1 each.
        """
        weight = np.ones(len(points), np.int64) if weight is None else weight
        begin = 0
        while True:
            tables = self._keys, self._sums, self._counts, self._slots, self._used
            begin, self._used = add_to_voxels(points, weight, begin, self.side, *tables)
            if begin == len(points):
                return
            mean, count, room = self.points, self._counts[: self._used], len(self._keys)
            if 2 * room <= self._most:
                room *= 2
            else:
                self.side *= COARSER
            self._begin(room)
            self.add(mean, count)

    @property
    def points(self) -> Float32:
        """The means in the order of the first points of their cubes, float32, shape (M, 4)."""
        mean = self._sums[: self._used] / np.maximum(self._counts[: self._used, None], 1)
        return np.asarray(mean, np.float32)
