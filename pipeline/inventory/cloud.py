"""Whole clouds: one reading of the source, the extent of the plot, and thinning in bounded memory."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.hash_grid import add_to_voxels
from pipeline.geometry.poses import Float
from pipeline.types.records import CloudDescription, Float32, Int, WholeCloud


class SpooledCloud:
    """A cloud that is read from its source once: later readings come from a temporary file without a name.

    If the file cannot be written, each reading comes from the source.

    Args:
        cloud: The cloud.
        folder: Folder of the temporary file; None for that of the system.
    """

    def __init__(self, cloud: WholeCloud, folder: Path | None = None) -> None:
        self._cloud, self._folder = cloud, folder
        self._file: IO[bytes] | None = None

    @property
    def description(self) -> CloudDescription:
        """Description of the cloud."""
        return self._cloud.description

    @property
    def losses(self) -> dict[str, int]:
        """dict from reasons to numbers of points that were left out in the reading of the source."""
        return self._cloud.losses

    def parts(self) -> Iterator[Float32]:
        """Yield all points in parts: x, y, z minus the offset [m], float32, shape (N, 3). Each call begins at
        the first point. The first complete reading is stored; one that is left before its end, or a full
        disk, stores nothing.

        Raises:
            SourceError: The source cannot be read.
            OSError: The temporary file cannot be read.
        """
        if self._file is not None:
            yield from _read_points(self._file)
            return
        try:
            spool: IO[bytes] | None = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 - kept open
        except OSError:
            spool = None
        complete = False
        try:
            for part in self._cloud.parts():
                if spool is not None:
                    try:
                        spool.write(np.ascontiguousarray(part).data)
                    except OSError:  # the disk is full
                        spool.close()
                        spool = None
                yield part
            complete = True
        finally:
            if complete:
                self._file = spool
            elif spool is not None:
                spool.close()

    def close(self) -> None:
        """Delete the temporary file; a later reading comes from the source again."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _read_points(file: IO[bytes]) -> Iterator[Float32]:
    """Yield the points of a file of float32 x, y, z in parts of at most SPOOLED, shape (N, 3) [m]."""
    file.seek(0)
    while block := file.read(SPOOLED * 12):
        yield np.frombuffer(block, np.float32).reshape(-1, 3)


SPOOLED = 1 << 19  # points that are read at once
SQUARE = 8.0  # m
LEAST = 20  # points of a square that belongs to the plot with its neighbours
MOST_SQUARES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Extent of a plot.

    Attributes:
        low, high: Minimum and maximum x, y of the plot, shape (2,) [m].
        points: Number of all points.
        apart: Number of points in sparse squares outside of the plot.
    """

    low: Float
    high: Float
    points: int
    apart: int


class ExtentFinder:
    """Finds the extent of a cloud. Points in sparse squares that have no dense neighbour are outside of it
    and counted; if no square is dense, all points are inside."""

    def __init__(self) -> None:
        self._squares: dict[int, tuple[int, Float]] = {}

    def add(self, part: Float32, where: str) -> None:
        """Add points of shape (N, 3) [m], finite; N may be 0.

        Raises:
            SourceError: The points are in more than MOST_SQUARES squares; `where` is the name of the cloud.
        """
        if len(part):
            _count(part, self._squares)
        if len(self._squares) > MOST_SQUARES:
            raise SourceError("the points are spread too widely for a plot", where=where)

    def extent(self, where: str) -> Extent:
        """Return the bounds of the points in squares with at least LEAST points and those next to them (of
        all points if there is no such square), and the numbers of all points and of those in other squares.

        Raises:
            SourceError: There are no points; `where` is the name of the cloud.
        """
        squares = self._squares
        if not squares:
            raise SourceError("the cloud has no points", where=where, remedy="Export it again")
        count = np.array([n for n, _ in squares.values()])
        bounds = np.array([bound for _, bound in squares.values()])
        key = np.array(list(squares))
        dense = set(key[count >= LEAST].tolist()) or set(key.tolist())
        steps = [(a << 32) + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
        part_of = np.array([any(k + step in dense for step in steps) for k in key.tolist()])
        total = int(count.sum())
        return Extent(
            bounds[part_of, :2].min(axis=0),
            bounds[part_of, 2:].max(axis=0),
            total,
            total - int(count[part_of].sum()),
        )


def _count(part: Float32, squares: dict[int, tuple[int, Float]]) -> None:
    """Add the points of a part to the counts of squares, in place.

    Args:
        part: Points, shape (N, 3) [m], N at least 1.
        squares: Dict from the key of a square to its number of points and their bounds x min, y min, x max, y
            max, shape (4,) [m].
    """
    cell = np.floor(part[:, :2] / SQUARE).astype(np.int64) + (1 << 30)
    key = (cell[:, 0] << 32) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    key, xy = key[order], part[order, :2].astype(np.float64)
    starts = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    low, high = np.minimum.reduceat(xy, starts), np.maximum.reduceat(xy, starts)
    sizes = np.diff(np.append(starts, len(key)))
    for k, n, a, b in zip(key[starts].tolist(), sizes.tolist(), low, high, strict=True):
        before, bound = squares.get(k, (0, np.append(a, b)))
        squares[k] = (before + n, np.append(np.minimum(bound[:2], a), np.maximum(bound[2:], b)))


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
