"""Gathering: voxels of all scans, the columns in them, and what each column is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.classification.column_extraction import MARGIN, PROFILE, examine
from pipeline.classification.decision_rule import judged
from pipeline.classification.features import COUNT, features
from pipeline.classification.forest import CLASSES, ForestOf, package_alone, vote
from pipeline.classification.map_correction import bent, bent_columns
from pipeline.classification.packed_voxel_map import PackedMemory
from pipeline.classification.ray_statistics import View, look, look_through
from pipeline.classification.stale_tiles import seen_higher
from pipeline.classification.voxel_map import SLICE, SLICES, TILE, Memory
from pipeline.config.stages import Classification as GatheringParameters
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.loop_closure.map_correction import Bend
from pipeline.types.records import Bool, Columns, Float32, Int, Verdict

GROWN = 1.1  # a tile is judged anew when it holds so many times the returns it held
SAME = 0.35  # m; a column found again so near is the one of before
FOLD = 25  # scans after which a snapshot no longer repeats them one by one; as many are kept


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
        forests: Where the forest that votes on the columns is found.

    Raises:
        StemmapError: There is no such forest.
    """

    def __init__(
        self, parameters: GatheringParameters, *, all_around: bool, forests: ForestOf = package_alone
    ) -> None:
        self._all_around, self._forests = all_around, forests
        self.parameters = parameters
        self._memory: Memory | None = Memory.empty(1 << parameters.voxels_log2)
        self._folded: Callable[[], Memory] | None = None  # gives the memory where nobody has asked for it yet
        self.columns = no_columns()
        self._base = PackedMemory.of(self.memory)
        self._since: list[tuple[Float32, int, int]] = []

    @property
    def parameters(self) -> GatheringParameters:
        """In force; new ones act from the next scan that is taken on."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: GatheringParameters) -> None:
        self._forest = self._forests(parameters.forest, self._all_around)
        self._parameters = parameters
        self._vote_again = True

    @property
    def memory(self) -> Memory:
        """The voxels of all scans. After a step back it is unpacked once somebody asks for it."""
        if self._memory is None:
            assert self._folded is not None  # noqa: S101 - one of both is there
            self._memory, self._folded = self._folded(), None
        return self._memory

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
        profiles = self._find_again(_joined(tiles, seen_higher(self.columns)))
        c = self.columns
        first = len(c.verdict) - len(profiles)
        seen = (view.clear_range, view.steepest, view.sensor_offset, view.terrain)
        look(c.axis, c.viewed, c.present, c.absent, pose, *seen, p.range_max)
        through = (view.depth, view.sensor_offset, view.terrain)
        look_through(c.axis, c.met, c.passed, pose, *through, p.range_max)
        new = slice(first, None)
        scans, rays = (c.viewed[new], c.present[new], c.absent[new]), (c.met[new], c.passed[new])
        features(c.axis[new], profiles, *scans, *rays, c.figures[new])
        self._judge(first)

    def snapshot(self) -> GatheringState:
        """All state; parameters are not part of it."""
        return GatheringState(self._base, tuple(self._since), self.columns)

    def restore(self, state: GatheringState) -> None:
        """Go back to a snapshot; the state itself is left untouched."""
        self._base, self._since = state.base, list(state.since)
        self._memory, self._folded = None, state.folded
        self.columns = state.columns
        self._vote_again = True  # another forest may have voted then

    def bend(self, bend: Bend) -> None:
        """Move what is known with a path that was bent."""
        self.columns = bent_columns(self.columns, self.memory, bend)
        self._memory = bent(self.memory, bend)
        self.settle()

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
        for name in ("viewed", "present", "absent", "met", "passed", "figures", "share", "verdict"):
            getattr(fresh, name)[:n] = getattr(old, name)[kept]
        nearest = _nearest_before(old.axis, fresh.axis, n)
        again = np.flatnonzero(nearest >= 0)
        for name in ("viewed", "present", "absent", "met", "passed"):
            getattr(fresh, name)[n + again] = getattr(old, name)[nearest[again]]
        self.columns = fresh
        return np.concatenate(profiles)

    def _judge(self, first: int) -> None:
        """Give the columns from a row on their verdict; who walked away is told at any time."""
        c = self.columns
        if self._vote_again:
            first, self._vote_again = 0, False
        c.share[first:] = vote(c.figures[first:], self._forest)
        self.columns = replace(c, verdict=judged(c).verdict(self.parameters.tree_share))


def no_columns() -> Columns:
    """A table of columns without rows."""
    return _rows(np.zeros((0, 5)), np.zeros((0, 2), np.int64))


def _rows(axis: Float, tile: Int) -> Columns:
    n = len(axis)
    zero = np.zeros(n)
    return Columns(
        tile=tile,
        axis=axis,
        viewed=zero,
        present=zero.copy(),
        absent=zero.copy(),
        met=np.zeros((n, SLICES), np.int32),
        passed=np.zeros((n, SLICES), np.int32),
        figures=np.zeros((n, COUNT)),
        share=np.zeros((n, len(CLASSES))),
        verdict=np.full(n, Verdict.OTHER, np.int32),
    )


def _joined(tiles: Int, more: Int) -> Int:
    """The tiles and those of the others that are not among them."""
    return np.concatenate([tiles, more[~_among(more, tiles)]])


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
def _nearest_before(old: Float, axis: Float, first: int) -> Int:
    """For each column from a row on the nearest one of before within SAME, -1 where there is none."""
    nearest = np.full(axis.shape[0] - first, -1, np.int64)
    for k in range(first, axis.shape[0]):
        best = SAME * SAME
        for o in range(old.shape[0]):
            dx, dy = axis[k, 0] - old[o, 0], axis[k, 1] - old[o, 1]
            if dx * dx + dy * dy < best:
                best = dx * dx + dy * dy
                nearest[k - first] = o
    return nearest
