"""Arrays as few bytes, and back to the bit: what is alike comes to stand together, so that it packs well."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int32, UInt16

Int8 = NDArray[np.int8]
_AS_IT_IS, _ON_GRID = b"\0", b"\1"
_LARGEST = 1 << 29  # of a number of steps; differences of such still have room
WINDOW = 48  # returns before one among which its neighbour is looked for: a firing of most sensors
NEAR = 100  # steps; a neighbour so near is not improved on


class Cutter:
    """Takes one array after the other from a block."""

    def __init__(self, block: bytearray) -> None:
        self._block = block
        self._at = 0

    def __call__(self, kind: str, count: int) -> Any:  # noqa: ANN401 - of the kind
        """So many numbers; they lie in the block itself.

        Raises:
            ValueError: The block is too short.
        """
        if count < 0:
            raise ValueError("less than nothing")
        array = np.frombuffer(self._block, kind, count, self._at)
        self._at += array.nbytes
        return array


def planes(columns: NDArray[Any]) -> bytes:
    """The first bytes of all numbers of each row, then the second ones, and so on; shape (rows, N)."""
    rows, count = columns.shape
    laid = np.ascontiguousarray(columns).view(np.uint8).reshape(rows, count, columns.itemsize)
    return laid.transpose(0, 2, 1).tobytes()


def from_planes(cut: Cutter, kind: str, rows: int, count: int) -> Any:  # noqa: ANN401 - of the kind
    """What `planes` was given, shape (rows, N)."""
    size = np.dtype(kind).itemsize
    laid = cut("u1", rows * size * count).reshape(rows, size, count).transpose(0, 2, 1)
    return np.ascontiguousarray(laid).view(kind).reshape(rows, count)


def places_coded(points: Float32, height: Float32, step: float) -> bytes:
    """x, y and height, shapes (N, 2) and (N,): of what lies on a grid the differences to the neighbour that
    a sensor's beam of before has left."""
    columns = np.stack([points[:, 0], points[:, 1], height])
    steps = _steps(columns, step)
    if steps is None:
        return _AS_IT_IS + planes(columns)
    left, jump = _to_neighbours(steps, WINDOW, NEAR)
    return _ON_GRID + planes(_unsigned(left)) + jump.tobytes()


def places_from(cut: Cutter, count: int, step: float) -> tuple[Float32, Float32]:
    """Points as shape (N, 3) with z = 0, and heights.

    Raises:
        ValueError: A point has no neighbour.
    """
    if cut("u1", 1).tobytes() == _AS_IT_IS:
        columns = from_planes(cut, "<f4", 3, count)
    else:
        left = _signed(from_planes(cut, "<u4", 3, count))
        steps = _from_neighbours(left, cut("i1", count))
        if len(steps[0]) < count:
            raise ValueError("a point has no neighbour")
        columns = steps.astype(np.float32) * np.float32(step)
    points = np.zeros((count, 3), np.float32)
    points[:, 0], points[:, 1] = columns[0], columns[1]
    return points, columns[2].copy()


def heights_coded(height: Float, step: float) -> bytes:
    """Of the ground, shape (sectors, rings): differences along each sector."""
    steps = _steps(height, step)
    if steps is None:
        return _AS_IT_IS + planes(height)
    left = steps.copy()
    left[:, 1:] -= steps[:, :-1]
    return _ON_GRID + planes(_unsigned(left).reshape(1, -1))


def heights_from(cut: Cutter, sectors: int, rings: int, step: float) -> Float:
    """What `heights_coded` was given."""
    if cut("u1", 1).tobytes() == _AS_IT_IS:
        told: Float = from_planes(cut, "<f8", sectors, rings)
        return told
    left = _signed(from_planes(cut, "<u4", 1, sectors * rings)).reshape(sectors, rings)
    return np.cumsum(left, axis=1, dtype=np.int32).astype(np.float64) * step


def image_coded(image: UInt16) -> bytes:
    """Of an image that is empty in most places, shape (directions, elevations): where it is not, and the
    differences along each elevation."""
    turned = image.T
    there = turned > 0
    told = turned[there].astype(np.int32)
    left = told.copy()
    left[1:] -= told[:-1]
    return np.packbits(there).tobytes() + planes(_unsigned(left).reshape(1, -1))


def image_from(cut: Cutter, directions: int, elevations: int) -> UInt16:
    """What `image_coded` was given."""
    there = bits_from(cut, elevations * directions).reshape(elevations, directions)
    count = int(np.count_nonzero(there))
    turned = np.zeros((elevations, directions), np.uint16)
    turned[there] = np.cumsum(_signed(from_planes(cut, "<u4", 1, count))[0], dtype=np.int32).astype(np.uint16)
    return np.ascontiguousarray(turned.T)


def row_coded(values: Float) -> bytes:
    """Of numbers that often are the same as the one before, shape (N,)."""
    other = np.ones(len(values), np.bool_)
    bits = values.view(np.uint64)
    other[1:] = bits[1:] != bits[:-1]
    return np.packbits(other).tobytes() + planes(values[None, other])


def row_from(cut: Cutter, count: int) -> Float:
    """What `row_coded` was given.

    Raises:
        ValueError: There is no first number.
    """
    at = np.cumsum(bits_from(cut, count)) - 1
    if count and at[0] != 0:
        raise ValueError("a row has no first number")
    told: Float = from_planes(cut, "<f8", 1, int(at[-1]) + 1 if count else 0)[0][at]
    return told


def bits_from(cut: Cutter, count: int) -> Bool:
    """What `np.packbits` was given, shape (N,)."""
    return np.unpackbits(cut("u1", -(-count // 8)), count=count).view(np.bool_)


def _steps(values: NDArray[Any], step: float) -> Int32 | None:
    """How many steps each value is, None where one of them is not a number of steps."""
    steps = np.rint(values * values.dtype.type(1.0 / step))
    told = np.abs(steps) < _LARGEST
    if not told.all() or not np.array_equal(steps * values.dtype.type(step), values):
        return None
    if (np.signbit(values) & (values == 0.0)).any():  # a step has no -0
        return None
    whole: Int32 = steps.astype(np.int32)
    return whole


def _unsigned(left: Int32) -> NDArray[np.uint32]:
    """0, -1, 1, -2 ... as 0, 1, 2, 3 ..., so that what is small has empty bytes."""
    return ((left << 1) ^ (left >> 31)).view(np.uint32)


def _signed(left: NDArray[np.uint32]) -> Int32:
    """The inverse of `_unsigned`."""
    return ((left >> 1) ^ (~(left & 1) + np.uint32(1))).view(np.int32)


@compiled
def _to_neighbours(steps: Int32, window: int, near: int) -> tuple[Int32, Int8]:
    """Of each point the difference to its neighbour, shape (3, N), and where that stands, shape (N,).

    A scan comes firing by firing, and the neighbour of a point in the firing before is that which follows its
    predecessor's; where another one is nearer by far, its place is told by the jump to it.
    """
    n = steps.shape[1]
    left, jump = np.empty((3, n), np.int32), np.zeros(n, np.int8)
    m = -1
    for i in range(n):
        if i == 0:
            left[0, i], left[1, i], left[2, i] = steps[0, i], steps[1, i], steps[2, i]
            continue
        expected = min(m + 1, i - 1)
        m = expected
        apart = _apart(steps, i, m)
        if apart > near:
            best, at = apart, m
            for j in range(max(0, i - window), i):
                d = _apart(steps, i, j)
                if d < best:
                    best, at = d, j
            if 2 * best + near < apart:
                m = at
        jump[i] = m - expected
        for a in range(3):
            left[a, i] = steps[a, i] - steps[a, m]
    return left, jump


@compiled
def _from_neighbours(left: Int32, jump: Int8) -> Int32:
    """The inverse of `_to_neighbours`; of fewer points where a neighbour is none."""
    n = left.shape[1]
    steps = np.empty((3, n), np.int32)
    m = -1
    for i in range(n):
        if i == 0:
            steps[0, i], steps[1, i], steps[2, i] = left[0, i], left[1, i], left[2, i]
            continue
        m = min(m + 1, i - 1) + jump[i]
        if m < 0 or m >= i:
            return steps[:, :i].copy()
        for a in range(3):
            steps[a, i] = left[a, i] + steps[a, m]
    return steps


@compiled
def _apart(steps: Int32, i: int, j: int) -> int:
    return int(
        abs(np.int64(steps[0, i]) - steps[0, j])
        + abs(np.int64(steps[1, i]) - steps[1, j])
        + abs(np.int64(steps[2, i]) - steps[2, j])
    )
