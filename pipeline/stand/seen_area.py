"""The area that a drive observed: a raster with the nearest free view of each cell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.detection.free_space import directions
from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Bool, Int, Path

CELL = 0.5  # m
RANGE = 30.0  # m; views from farther away are not recorded
# A cell counts as observed up to this distance behind the end of the free range [m], because a trunk ends the
# free range in front of its own axis.
INTO = 0.5
# A scan is recorded after this motion [m, rad].
SPACING, TURN = 0.5, math.radians(10.0)


@dataclass(frozen=True, slots=True, eq=False)
class SeenArea:
    """Observed cells of the map; columns of length K, one row per cell, in the order of `place`.

    Attributes:
        cell: Side of the square cells [m].
        place: int64, shape (K, 2): the cell spans from place * cell to (place + 1) * cell [m].
        nearest: Distance of the nearest free view [m]; NaN if unknown, as for a whole cloud.
        views: int64, number of recorded scans with a free view of the cell; 0 if unknown.
    """

    cell: float
    place: Int
    nearest: Float
    views: Int

    @property
    def centres(self) -> Float:
        """Centres of the cells, shape (K, 2) [m]."""
        return np.asarray((self.place + 0.5) * self.cell, np.float64)

    def rows(self, points: Float) -> Int:
        """Return the row of the cell that contains each point, int64, shape (N,); -1 outside of the area.

        Args:
            points: Positions in the map, shape (N, 2) [m].
        """
        row_of = {tuple(p): k for k, p in enumerate(self.place.tolist())}
        cells = np.floor(np.reshape(points, (-1, 2)) / self.cell).astype(np.int64).tolist()
        return np.array([row_of.get(tuple(c), -1) for c in cells], np.int64)

    def where(self, keep: Bool) -> SeenArea:
        """Return the area with the rows for which `keep`, shape (K,), is true."""
        return SeenArea(self.cell, self.place[keep], self.nearest[keep], self.views[keep])

    def joined(self, other: SeenArea, T_map_other: Pose2 | None = None) -> SeenArea:
        """Return the union with the area of another drive, which has cells of the same size.

        Args:
            other: The other area.
            T_map_other: Pose of its frame in the frame of this area; None if they are the same.
        """
        if T_map_other is None:
            place, nearest, views = other.place, other.nearest, other.views
        else:
            # Nine points per cell leave no hole between rotated cells.
            steps = (np.arange(3) + 0.5) / 3.0
            within = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
            points = (other.place[:, None, :] + within).reshape(-1, 2) * other.cell
            place = np.floor(T_map_other.apply(points) / self.cell).astype(np.int64)
            nearest, views = np.repeat(other.nearest, len(within)), np.repeat(other.views, len(within))
            place, nearest, views = _grouped(place, nearest, views, np.maximum)
        both = (
            np.concatenate([self.place, place]),
            np.concatenate([self.nearest, nearest]),
            np.concatenate([self.views, views]),
        )
        return SeenArea(self.cell, *_grouped(*both, np.add))


def _grouped(place: Int, nearest: Float, views: Int, of_views: np.ufunc) -> tuple[Int, Float, Int]:
    """Return one row per cell, with the smallest distance and the views combined by `of_views`."""
    cells, row = np.unique(place, axis=0, return_inverse=True)
    least = np.full(len(cells), np.nan)
    np.fmin.at(least, row.ravel(), nearest)
    combined = np.zeros(len(cells), np.int64)
    of_views.at(combined, row.ravel(), views)
    return cells, least, combined


class SeenRecorder:
    """Collects the free range of scans along a drive. Poses are applied at the end, so that corrections of
    the path also move what was observed."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._free: list[Float] = []
        self._last: Pose2 | None = None

    def is_due(self, T_map_base: Pose2) -> bool:
        """Return whether the robot has moved since the last recorded scan, so that another one is of use."""
        if self._last is None:
            return True
        step = self._last.inverse() @ T_map_base
        return math.hypot(step.x, step.y) >= SPACING or abs(step.yaw) >= TURN

    def add(self, stamp_ns: int, T_map_base: Pose2, free: Float) -> None:
        """Record a scan.

        Args:
            stamp_ns: Its time.
            T_map_base: Its pose as known now.
            free: Free range by direction in the base frame, see `pipeline.detection.free_space.clear_range`.
        """
        self._stamps.append(stamp_ns)
        self._free.append(np.minimum(free, RANGE))
        self._last = T_map_base

    def area(self, path: Path) -> SeenArea:
        """Return the observed area; without cells if no scan was recorded.

        Args:
            path: Final path, which has the stamps of the recorded scans.
        """
        cells: list[Int] = []
        distance: list[Float] = []
        half = math.ceil(RANGE / CELL) + 1
        side = np.arange(-half, half + 1)
        grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
        grid = grid[np.hypot(*grid.T) * CELL <= RANGE + CELL]
        for row, free in zip(np.searchsorted(path.stamp_ns, self._stamps), self._free, strict=True):
            pose = Pose2(float(path.x[row]), float(path.y[row]), float(path.yaw[row]))
            place = grid + np.floor(np.array([pose.x, pose.y]) / CELL).astype(np.int64)
            local = pose.inverse().apply((place + 0.5) * CELL)
            reach = np.hypot(*local.T)
            points = np.column_stack([local, np.zeros(len(local))]).astype(np.float32)
            seen = (reach <= free[directions(points, np.zeros(3))] + INTO) & (reach <= RANGE)
            cells.append(place[seen])
            distance.append(reach[seen])
        if not cells:
            return SeenArea(CELL, np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0, np.int64))
        place, nearest = np.concatenate(cells), np.concatenate(distance)
        return SeenArea(CELL, *_grouped(place, nearest, np.ones(len(place), np.int64), np.add))
