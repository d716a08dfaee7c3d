"""Thinning: points of one small cube become their mean, in a table whose size is bounded."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled
from pipeline.types.records import Float32, Int, Int32

FINEST = 0.01  # m
COARSER = 1.5  # times, when the table is full
_AXIS_BITS, _MIDDLE = 21, 1 << 20
_SPREAD = np.uint64(0x9E3779B97F4A7C15)


class Thinned:
    """The means of all points so far, cube by cube.

    When more than `most` cubes hold points, the cubes grow and what was gathered is gathered again.

    Args:
        most: Cubes kept, a power of two.
        side: Of a cube, to begin with [m].
    """

    def __init__(self, most: int = 1 << 21, side: float = FINEST) -> None:
        self.side = side
        self._most = most
        self._begin(min(1 << 16, most))

    def _begin(self, room: int) -> None:
        self._key = np.zeros(room, np.int64)
        self._mean = np.zeros((room, 4), np.float32)
        self._count = np.zeros(room, np.int32)
        self._slot = np.full(2 * room, -1, np.int32)
        self._used = 0

    def add(self, points: Float32) -> None:
        """Take points of shape (N, 4): x, y, z and one value more, within 10 km of the origin [m]."""
        self._add(points, np.ones(len(points), np.int32))

    def _add(self, points: Float32, weight: Int32) -> None:
        begin = 0
        while True:
            begin, self._used = _add(
                points, weight, begin, self.side, self._key, self._mean, self._count, self._slot, self._used
            )
            if begin == len(points):
                return
            self._make_room()

    def _make_room(self) -> None:
        mean, count, room = self._mean[: self._used], self._count[: self._used], len(self._key)
        if 2 * room <= self._most:
            room *= 2
        else:
            self.side *= COARSER
        self._begin(room)
        self._add(mean, count)

    @property
    def points(self) -> Float32:
        """The means, float32, shape (M, 4), in the order in which their cubes were first met."""
        return self._mean[: self._used]


@compiled
def _add(
    points: Float32,
    weight: Int32,
    begin: int,
    side: float,
    keys: Int,
    mean: Float32,
    count: Int32,
    slot: Int32,
    used: int,
) -> tuple[int, int]:
    """Returns the first point that found no room (their number when all did) and the cubes in use."""
    mask = slot.shape[0] - 1
    shift = np.uint64(64 - int(np.log2(slot.shape[0]) + 0.5))
    for i in range(begin, points.shape[0]):
        key = np.int64(0)
        for a in range(3):
            key = (key << _AXIS_BITS) | (
                (np.int64(np.floor(points[i, a] / side)) + _MIDDLE) & (2 * _MIDDLE - 1)
            )
        at = np.int64((np.uint64(key) * _SPREAD) >> shift)
        while slot[at] >= 0 and keys[slot[at]] != key:
            at = (at + 1) & mask
        row = slot[at]
        if row < 0:
            if used == keys.shape[0]:
                return i, used
            row = np.int32(used)
            used += 1
            slot[at], keys[row] = row, key
        count[row] += weight[i]
        share = np.float32(weight[i]) / np.float32(count[row])
        for a in range(4):
            mean[row, a] += (points[i, a] - mean[row, a]) * share
    return points.shape[0], used
