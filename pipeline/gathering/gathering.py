"""Gathering: what all scans together say of each place where a stem may stand."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.compiled import compiled
from pipeline.direction import direction_bin
from pipeline.gathering.columns import MARGIN, find_columns, profile, straighten
from pipeline.gathering.features import COUNT, features
from pipeline.gathering.memory import SLICE, SLICES, TILE, Memory
from pipeline.geometry import Float, Pose2
from pipeline.ground import ground_at
from pipeline.records import Float32, Int
from pipeline.visibility import BEHIND, BINS

GROWN = 1.1  # a tile is judged anew when it holds so many times the returns it held
NEAR = 0.6  # m; what is seen so near to a column is the column
SAME = 0.35  # m; a column found again so near is the one of before
FOLD = 100  # scans after which a snapshot no longer repeats them one by one


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The columns that were found, as columns of a table of length K.

    Attributes:
        tile: int64, shape (K, 2): in which tile the foot stands.
        axis: shape (K, 5): see `find_columns`.
        viewed: How high above the ground any scan looked there [m].
        present, absent: In how many scans something, or nothing, stood there in free view.
        figures: shape (K, COUNT): see `features`.
    """

    tile: Int
    axis: Float
    viewed: Float
    present: Float
    absent: Float
    figures: Float

    @classmethod
    def empty(cls, rows: int = 0) -> Columns:
        """Rows of zeros."""
        zero = np.zeros(rows)
        tile, axis = np.zeros((rows, 2), np.int64), np.zeros((rows, 5))
        return cls(tile, axis, zero, zero.copy(), zero.copy(), np.zeros((rows, COUNT)))

    def __len__(self) -> int:
        return len(self.tile)


class Gathering:
    """All that is remembered of places, and the columns in it."""

    def __init__(self, most: int, range_max: float) -> None:
        self.memory = Memory.empty()
        self.columns = Columns.empty()
        self.most, self.range_max = most, range_max

    def add(
        self,
        points: Float32,
        height: Float32,
        scan: int,
        T_map_base: Pose2,
        sensor_offset: Float,
        clear_range: Float,
        steepest: Float,
        terrain: Float,
    ) -> Int:
        """Take one scan; returns the rows of `columns` that were judged anew.

        Args:
            points: Level sensor frame, float32, shape (N, 3) [m]; height: above the ground, (N,) [m].
            scan: Its number.
            T_map_base: The pose; sensor_offset: the sensor in the base frame, shape (3,) [m].
            clear_range: How far the view was free by direction of the base frame, shape (BINS,) [m].
            steepest: Tangent of the steepest elevation of a return by direction, shape (BINS,).
            terrain: The ground under this scan, as `Terrain.height`.
        """
        pose = T_map_base.as_array()
        self.memory.add(_to_map(points, height, pose, sensor_offset, self.range_max), scan, self.most)
        tiles = self.memory.judge_anew(GROWN)
        profiles = self._find_again(tiles)
        c = self.columns
        here = len(c) - len(profiles)
        _look(c.axis, c.viewed, c.present, c.absent, pose, clear_range, steepest, sensor_offset, terrain, self.range_max)
        for k, rows in enumerate(profiles):
            row = here + k
            c.figures[row] = features(c.axis[row], rows, c.viewed[row], c.present[row], c.absent[row])
        return np.arange(here, len(c))

    def _find_again(self, tiles: Int) -> list[Float]:
        """Find the columns of tiles anew, at the end of the table; returns their profiles."""
        old = self.columns
        replaced = _among(old.tile, tiles)
        axes, homes, profiles = [old.axis[~replaced]], [old.tile[~replaced]], []
        for tile in tiles:
            mean, returns = self.memory.around(tile, MARGIN)
            found = find_columns(mean, returns, tile * TILE, TILE)
            straighten(found, mean, returns)
            found = found[_inside(found, tile)]
            axes.append(found)
            homes.append(np.broadcast_to(tile, (len(found), 2)))
            profiles += [profile(axis, mean, returns) for axis in found]
        axis, home = np.concatenate(axes), np.concatenate(homes)
        self.columns = fresh = _with_axes(axis, home)
        kept = len(axes[0])
        for f in ("viewed", "present", "absent", "figures"):
            getattr(fresh, f)[:kept] = getattr(old, f)[~replaced]
        _inherit(old.axis, old.viewed, old.present, old.absent, fresh.axis, fresh.viewed, fresh.present, fresh.absent, kept)
        return profiles


def _with_axes(axis: Float, tile: Int) -> Columns:
    zero = np.zeros(len(axis))
    return Columns(tile, axis, zero, zero.copy(), zero.copy(), np.zeros((len(axis), COUNT)))


def _inside(found: Float, tile: Int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    foot = found[:, :2]
    return np.all((foot >= tile * TILE) & (foot < (tile + 1) * TILE), axis=1)


def _among(home: Int, tiles: Int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    key = (home[:, 0] << 32) + home[:, 1]
    return np.isin(key, (tiles[:, 0] << 32) + tiles[:, 1])


@compiled
def _to_map(points: Float32, height: Float32, pose: Float, offset: Float, range_max: float) -> Float32:
    """x, y in the frame of the map and the height of the points that are kept, float32, shape (M, 3)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    kept = np.empty((points.shape[0], 3), np.float32)
    n = 0
    for i in range(points.shape[0]):
        x, y = points[i, 0] + offset[0], points[i, 1] + offset[1]
        if x * x + y * y < range_max * range_max and 0.0 < height[i] < SLICES * SLICE:
            kept[n, 0], kept[n, 1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
            kept[n, 2] = height[i]
            n += 1
    return kept[:n].copy()


@compiled
def _inherit(
    old_axis: Float,
    old_viewed: Float,
    old_present: Float,
    old_absent: Float,
    axis: Float,
    viewed: Float,
    present: Float,
    absent: Float,
    first: int,
) -> None:
    """Give each new column what was known of its place."""
    for k in range(first, axis.shape[0]):
        best = SAME * SAME
        for o in range(old_axis.shape[0]):
            dx, dy = axis[k, 0] - old_axis[o, 0], axis[k, 1] - old_axis[o, 1]
            if dx * dx + dy * dy < best:
                best = dx * dx + dy * dy
                viewed[k], present[k], absent[k] = old_viewed[o], old_present[o], old_absent[o]


@compiled
def _look(
    axis: Float,
    viewed: Float,
    present: Float,
    absent: Float,
    pose: Float,
    clear_range: Float,
    steepest: Float,
    offset: Float,
    terrain: Float,
    range_max: float,
) -> None:
    """Count for each column in view whether something stood there, and how high the scan looked."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for k in range(axis.shape[0]):
        dx, dy = axis[k, 0] - pose[0], axis[k, 1] - pose[1]
        reach = np.sqrt(dx * dx + dy * dy)
        if reach > range_max:
            continue
        x, y = c * dx + s * dy, c * dy - s * dx
        b = direction_bin(x, y, BINS)
        x, y = x - offset[0], y - offset[1]
        up = np.sqrt(x * x + y * y) * steepest[b] - ground_at(terrain, x, y)
        viewed[k] = max(viewed[k], min(up, SLICES * SLICE))
        if clear_range[b] > reach + BEHIND:
            absent[k] += 1.0
        elif abs(clear_range[b] - reach) < NEAR:
            present[k] += 1.0


@compiled
def steepest_by_direction(points: Float32, offset: Float, all_around: bool) -> Float:
    """Tangent of the steepest elevation seen in each direction of the base frame, shape (BINS,).

    Args:
        points: Level sensor frame, shape (N, 3) [m]; offset: the sensor in the base frame, shape (3,).
        all_around: Whether the sensor looks equally high in all directions, so that one tells for all.
    """
    steepest = np.full(BINS, -1.0)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        rho = np.sqrt(x * x + y * y)
        if rho > 1.0:
            b = direction_bin(x + offset[0], y + offset[1], BINS)
            steepest[b] = max(steepest[b], points[i, 2] / rho)
    if all_around:
        steepest[:] = steepest.max()
    return steepest
