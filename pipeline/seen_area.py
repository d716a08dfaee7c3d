"""The observed area: a raster with the nearest view of each cell by a drive, or what a cloud covers."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.columns import GrowingColumns
from pipeline.geometry.directions import direction_bins
from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Bool, Int, Path

CELL = 0.5  # m
RANGE = 30.0  # m; views from farther away are not recorded
# A cell counts as observed up to this distance behind the end of the free range [m], because a trunk ends the
# free range in front of its own axis.
INTO = 0.5
# A scan is recorded after this motion [m, rad].
SPACING, TURN = 0.5, math.radians(10.0)
# Gaps up to this width [m] count as observed, such as the shadow of a stem.
GAP = 1.0
# Rows of views that are grouped at once: their arrays take about 100 MB, while a view has 11,000 rows.
ROWS_MOST = 1_000_000
MOST_VIEWS = 4  # of one place; twice the views that a cell needs in a plot by default


@dataclass(frozen=True, slots=True, eq=False)
class SeenArea:
    """Observed cells of the map; columns of length K, one row per cell, in the order of `place`.

    Attributes:
        cell: Side of the square cells [m].
        place: Indices of the cell along x and y of the map, int64, shape (K, 2); the cell spans from place *
            cell to (place + 1) * cell [m].
        nearest: Distance of the nearest view [m]; NaN if unknown, as for a whole cloud.
        views: Number of recorded scans with a view of the cell, int64; 0 if unknown.
        clear: Whether one of them is free at all heights of the stems, so that no undergrowth is on the way;
            False if unknown.
    """

    cell: float
    place: Int
    nearest: Float
    views: Int
    clear: Bool

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
        return SeenArea(self.cell, self.place[keep], self.nearest[keep], self.views[keep], self.clear[keep])

    def clear_cells(self) -> SeenArea:
        """Return the cells that show that a tree is absent: clear ones, and all of unknown views."""
        return self.where(self.clear | (self.views == 0))

    def closed(self) -> SeenArea:
        """Return the area with gaps up to GAP closed: stems hide the cells behind them. A cell of a gap has
        the distance and the views of the nearest cell, and is not clear."""
        from scipy.ndimage import binary_closing, distance_transform_edt

        if not len(self.place):
            return self
        steps = math.ceil(0.5 * GAP / self.cell)  # from both sides
        low = self.place.min(axis=0) - steps - 1
        row = np.full(self.place.max(axis=0) - low + steps + 2, -1)
        row[tuple((self.place - low).T)] = np.arange(len(self.place))
        place = np.argwhere(binary_closing(row >= 0, iterations=steps))
        nearest = distance_transform_edt(row < 0, return_distances=False, return_indices=True)
        of = row[tuple(nearest[:, place[:, 0], place[:, 1]])]
        clear = self.clear[of] & (row[tuple(place.T)] >= 0)
        return SeenArea(self.cell, place + low, self.nearest[of], self.views[of], clear)

    def joined(self, other: SeenArea, T_map_other: Pose2 | None = None) -> SeenArea:
        """Return the union with the area of another drive, which has cells of the same size (not checked). A
        cell in both areas has the smaller distance, or the known one if the other is NaN, and the sum of the
        views. It is clear if it is clear in one of them.

        Args:
            other: The other area.
            T_map_other: Pose of the frame of `other` in the frame of this area; None if both frames are the
                same.
        """
        if T_map_other is None:
            place, nearest, views, clear = other.place, other.nearest, other.views, other.clear
        else:
            # Nine points per cell leave no hole between rotated cells.
            steps = (np.arange(3) + 0.5) / 3.0
            within = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
            points = (other.place[:, None, :] + within).reshape(-1, 2) * other.cell
            place = np.floor(T_map_other.apply(points) / self.cell).astype(np.int64)
            row = np.repeat(np.arange(len(other.place)), len(within))
            place, nearest, views, clear = _grouped(
                place, other.nearest[row], other.views[row], other.clear[row], np.maximum
            )
        both = (
            np.concatenate([self.place, place]),
            np.concatenate([self.nearest, nearest]),
            np.concatenate([self.views, views]),
            np.concatenate([self.clear, clear]),
        )
        return SeenArea(self.cell, *_grouped(*both, np.add))


def _grouped(
    place: Int, nearest: Float, views: Int, clear: Bool, of_views: np.ufunc
) -> tuple[Int, Float, Int, Bool]:
    """Return cells, distances [m], views and whether they are clear with one row per cell, sorted by cell,
    with the smallest distance (NaN if all are NaN), the views combined by `of_views`, beginning with 0, and
    clear if one row is.

    Args:
        place: Cells, shape (N, 2), which may repeat; N may be 0.
        nearest: Distance of a view of each cell, shape (N,) [m].
        views: Number of views of each cell, shape (N,).
        clear: Whether each cell is clear, shape (N,).
        of_views: np.add or np.maximum.
    """
    if not len(place):
        return place, nearest, views, clear
    low = place.min(axis=0)
    span = int(place[:, 1].max() - low[1]) + 1
    # One number per cell, in the order of its rows: sorting numbers is much faster than sorting rows.
    number, row = np.unique((place[:, 0] - low[0]) * span + place[:, 1] - low[1], return_inverse=True)
    cells = np.stack([number // span, number % span], axis=1) + low
    least = np.full(len(cells), np.nan)
    np.fmin.at(least, row.ravel(), nearest)
    combined = np.zeros(len(cells), np.int64)
    of_views.at(combined, row.ravel(), views)
    any_clear = np.zeros(len(cells), np.bool_)
    any_clear[row.ravel()[clear]] = True
    return cells, least, combined, any_clear


def covered_area(points: Float) -> SeenArea:
    """Return the area that a cloud covers seen from above: cells with a point at any height, with gaps up to
    GAP closed. Distances, numbers of views and what is clear are unknown.

    Args:
        points: Positions x, y, shape (N, 2) [m], closer to one another than CELL. They count to the
            millimetre, so that the offset of a file does not change a cell.
    """
    place = np.unique(np.floor(np.round(points, 3) / CELL).astype(np.int64), axis=0)
    n = len(place)
    return SeenArea(CELL, place, np.full(n, np.nan), np.zeros(n, np.int64), np.zeros(n, np.bool_)).closed()


class ViewSelection:
    """Selects the scans of a drive whose views are recorded: one after each SPACING or TURN, and at most
    MOST_VIEWS with the robot in the same cell of SPACING and the same sector of TURN, because further laps
    observe nothing else."""

    def __init__(self) -> None:
        self._last: Pose2 | None = None
        self._views: Counter[tuple[int, int, int]] = Counter()

    def take(self, T_map_base: Pose2) -> bool:
        """Return whether the view of a scan with this pose is recorded; then its pose becomes the last one.
        It is recorded if it is the first or at least SPACING or TURN away from the last one, and its cell of
        side SPACING and its sector of TURN have fewer than MOST_VIEWS views."""
        if self._last is not None:
            step = self._last.inverse() @ T_map_base
            if math.hypot(step.x, step.y) < SPACING and abs(step.yaw) < TURN:
                return False
        place = (
            math.floor(T_map_base.x / SPACING),
            math.floor(T_map_base.y / SPACING),
            math.floor(T_map_base.yaw / TURN),
        )
        if self._views[place] >= MOST_VIEWS:
            return False
        self._views[place] += 1
        self._last = T_map_base
        return True


class SeenRecorder:
    """Collects the views of scans along a drive. Poses are applied at the end, so that corrections of the
    path also move what was observed."""

    def __init__(self) -> None:
        self._row_of: dict[int, int] = {}  # by time
        self._views: GrowingColumns | None = None

    def add(self, stamp_ns: int, view: Float) -> None:
        """Record a scan, in place of one of the same time.

        Args:
            stamp_ns: Time of the scan [ns].
            view: Free range, and range up to which stems are in view, by direction in the base frame, shape
                (2, BINS) [m], see `pipeline.front_end.SegmentedScan.view`; copied, limited to RANGE.
        """
        if self._views is None:
            self._views = GrowingColumns(np.zeros((0, *view.shape), np.float32))
        row = len(self._views)
        self._views.write(row, np.minimum(view, RANGE)[None])
        self._row_of[stamp_ns] = row  # last, because another thread may read

    def area(self, path: Path) -> SeenArea:
        """Return the observed area: a scan observes the cells whose centres are at most RANGE away and at
        most INTO behind the end of the range up to which stems are in view. Those within the free range are
        clear. Without scans it has no cells.

        Args:
            path: Final path; recorded scans whose stamps it does not have are left out.
        """
        none = np.zeros(0, np.int64)
        area = SeenArea(CELL, np.zeros((0, 2), np.int64), np.zeros(0), none, none.astype(np.bool_))
        cells: list[Int] = []
        distance: list[Float] = []
        clear: list[Bool] = []
        rows = 0
        half = math.ceil(RANGE / CELL) + 1
        side = np.arange(-half, half + 1)
        grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
        grid = grid[np.hypot(*grid.T) * CELL <= RANGE + CELL]
        row_of = {stamp: row for row, stamp in enumerate(path.stamp_ns.tolist())}
        recorded = list(self._row_of.items())  # another thread may add scans
        views = np.zeros((0, 2, 1)) if self._views is None else self._views.column(0)
        for stamp, of_view in recorded:
            row = row_of.get(stamp)
            if row is None:
                continue
            free, in_view = views[of_view]
            pose = Pose2(float(path.x[row]), float(path.y[row]), float(path.yaw[row]))
            place = grid + np.floor(np.array([pose.x, pose.y]) / CELL).astype(np.int64)
            local = pose.inverse().apply((place + 0.5) * CELL)
            reach = np.hypot(*local.T)
            bins = direction_bins(local, len(free))
            seen = (reach <= in_view[bins] + INTO) & (reach <= RANGE)
            cells.append(place[seen])
            distance.append(reach[seen])
            clear.append((reach <= free[bins])[seen])
            rows += len(cells[-1])
            if rows >= max(ROWS_MOST, len(area.place)):  # each time the whole area is sorted
                area = _with_views(area, cells, distance, clear)
                cells, distance, clear, rows = [], [], [], 0
        return _with_views(area, cells, distance, clear)


def _with_views(area: SeenArea, cells: list[Int], distance: list[Float], clear: list[Bool]) -> SeenArea:
    """Return an area with further views: the cells of each, shape (K, 2), their distances, shape (K,) [m],
    and whether they are clear, shape (K,)."""
    if not cells:
        return area
    place, nearest = np.concatenate(cells), np.concatenate(distance)
    once = np.ones(len(place), np.int64)
    return area.joined(SeenArea(CELL, place, nearest, once, np.concatenate(clear)))
