"""Gathering: voxels of all scans, the columns in them, and what each column is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.compiled import compiled
from pipeline.gathering.columns import MARGIN, PROFILE, examine
from pipeline.gathering.features import COUNT, NAMES, features
from pipeline.gathering.forest import CLASSES, Forest, standard_forest, vote
from pipeline.gathering.memory import SLICE, SLICES, TILE, Memory
from pipeline.gathering.packed import PackedMemory
from pipeline.gathering.sight import View, look
from pipeline.geometry import Float
from pipeline.parameters.stages import Gathering as GatheringParameters
from pipeline.records import Bool, Columns, Float32, Int, Verdict

GROWN = 1.1  # a tile is judged anew when it holds so many times the returns it held
SAME = 0.35  # m; a column found again so near is the one of before
FOLD = 25  # scans after which a snapshot no longer repeats them one by one; as many are kept
VOXELS, LEAST_VOXELS = NAMES.index("voxels to 3 m"), 6.0
GONE, GONE_SCANS = 0.5, 5  # of the scans that could see something there, and at least so many


@dataclass(frozen=True, slots=True, eq=False)
class GatheringState:
    """What is known between two scans: a memory that nobody changes any more, the scans since, and the
    columns. It shares all of that with the gathering, so that taking it costs nothing."""

    base: PackedMemory
    since: tuple[tuple[Float32, int, int], ...]
    columns: Columns

    def folded(self) -> Memory:
        """The memory with the scans since, of its own."""
        memory = self.base.unpacked()
        for points, scan, most in self.since:
            memory.add(points, scan, most)
            memory.judge_anew(GROWN)
        return memory


class Gathering:
    """All that is remembered of places, and the columns in it.

    Args:
        parameters: Of this stage.
        all_around: Whether the sensor sees all around, or one way.
        forest: Votes on the columns; None takes the one that comes with the package.
    """

    def __init__(
        self, parameters: GatheringParameters, *, all_around: bool, forest: Forest | None = None
    ) -> None:
        self.parameters = parameters
        self._forest = forest or standard_forest(all_around)
        self.memory = Memory.empty(1 << parameters.voxels_log2)
        self.columns = no_columns()
        self._base = PackedMemory.of(self.memory)
        self._since: list[tuple[Float32, int, int]] = []

    def add(self, points: Float32, height: Float32, scan: int, view: View) -> None:
        """Take one scan.

        Args:
            points: Level sensor frame, float32, shape (N, 3) [m]; height: above the ground, (N,) [m].
            scan: Its number.
            view: From where, how far and how high it looked.
        """
        p, pose = self.parameters, view.T_map_base.as_array()
        here = _to_map(points, height, pose, view.sensor_offset, p.range_max)
        tiles = self._remember(here, scan, 1 << p.voxels_log2)
        profiles = self._find_again(tiles)
        c = self.columns
        first = len(c.verdict) - len(profiles)
        seen = (view.clear_range, view.steepest, view.sensor_offset, view.terrain)
        look(c.axis, c.viewed, c.present, c.absent, pose, *seen, p.range_max)
        new = (c.viewed[first:], c.present[first:], c.absent[first:], c.figures[first:])
        features(c.axis[first:], profiles, *new)
        self._judge(first)

    def snapshot(self) -> GatheringState:
        """All state; parameters are not part of it."""
        return GatheringState(self._base, tuple(self._since), self.columns)

    def restore(self, state: GatheringState) -> None:
        """Go back to a snapshot; the state itself is left untouched."""
        self._base, self._since = state.base, list(state.since)
        self.memory = state.folded()
        self.columns = state.columns

    @property
    def is_unsettled(self) -> bool:
        """Whether so many scans were taken that `settle` is due."""
        return len(self._since) >= FOLD

    def settle(self) -> None:
        """Fold the scans since into what a snapshot shares. It changes nothing that is known, so it may be
        done at any time, best between two scans that are taken; else the next one does it."""
        self._base, self._since = PackedMemory.of(self.memory), []

    def _remember(self, points: Float32, scan: int, most: int) -> Int:
        if self.is_unsettled:
            self.settle()
        self._since.append((points, scan, most))
        self.memory.add(points, scan, most)
        return self.memory.judge_anew(GROWN)

    def _find_again(self, tiles: Int) -> Float:
        """Find the columns of tiles anew, at the end of a new table; returns their profiles."""
        old = self.columns
        kept = ~_among(old.tile, tiles)
        axes, homes, profiles = [old.axis[kept]], [old.tile[kept]], [np.zeros((0, SLICES, PROFILE))]
        for tile in tiles:
            mean, returns = self.memory.around(tile, MARGIN)
            found, around = examine(mean, returns, tile * TILE, TILE)
            axes.append(found)
            homes.append(np.broadcast_to(tile, (len(found), 2)))
            profiles.append(around)
        fresh = _rows(np.concatenate(axes), np.concatenate(homes))
        n = len(axes[0])
        for name in ("viewed", "present", "absent", "figures", "share", "verdict"):
            getattr(fresh, name)[:n] = getattr(old, name)[kept]
        known = (old.axis, old.viewed, old.present, old.absent)
        _inherit(*known, fresh.axis, fresh.viewed, fresh.present, fresh.absent, n)
        self.columns = fresh
        return np.concatenate(profiles)

    def _judge(self, first: int) -> None:
        """Give the columns from a row on their verdict; who walked away is told at any time."""
        c = self.columns
        c.share[first:] = vote(c.figures[first:], self._forest)
        kind = np.array(CLASSES, np.int32)
        verdict = kind[c.share.argmax(axis=1)] if len(c.share) else np.zeros(0, np.int32)
        tree = c.share[:, 0] >= self.parameters.tree_share
        verdict[~tree & (verdict == Verdict.TREE)] = Verdict.OTHER
        verdict[tree] = Verdict.TREE
        verdict[_too_few(c.figures)] = Verdict.TOO_FEW_POINTS
        gone = (c.absent >= GONE_SCANS) & (c.absent > GONE * (c.present + c.absent))
        verdict[gone] = Verdict.MOVING
        self.columns = replace(c, verdict=verdict.astype(np.int32))


def no_columns() -> Columns:
    """A table of columns without rows."""
    return _rows(np.zeros((0, 5)), np.zeros((0, 2), np.int64))


def _too_few(figures: Float) -> Bool:
    """Columns of so few voxels that chance can pile them up."""
    few: Bool = figures[:, VOXELS] < LEAST_VOXELS
    return few


def _rows(axis: Float, tile: Int) -> Columns:
    n = len(axis)
    zero = np.zeros(n)
    return Columns(
        tile=tile,
        axis=axis,
        viewed=zero,
        present=zero.copy(),
        absent=zero.copy(),
        figures=np.zeros((n, COUNT)),
        share=np.zeros((n, len(CLASSES))),
        verdict=np.full(n, Verdict.OTHER, np.int32),
    )


def _among(home: Int, tiles: Int) -> Bool:
    there: Bool = np.isin((home[:, 0] << 32) + home[:, 1], (tiles[:, 0] << 32) + tiles[:, 1])
    return there


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
