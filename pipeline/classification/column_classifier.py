"""The column classifier: voxels of all scans, the columns in them, and the class of each column by the votes
of the forest and by its visibility."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.classification.column_extraction import MARGIN, PROFILE, examine
from pipeline.classification.features import BANDS, COUNT, NAMES, features
from pipeline.classification.forest import CLASSES, ForestOf, package_alone, vote
from pipeline.classification.ray_statistics import ScanView, count_rays, update_visibility
from pipeline.classification.voxel_map import (
    SLICE,
    SLICES,
    TILE,
    PackedVoxelMap,
    VoxelMap,
    corrected_voxels,
)
from pipeline.config.stages import Classification as Classification
from pipeline.geometry.hash_grid import nearest_other
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import AT_ROUND, Bool, Columns, Float32, Int, Int32, Verdict

VOXELS, LEAST_VOXELS = NAMES.index("voxels to 3 m"), 6.0
GONE, GONE_SCANS = 0.5, 5  # share and least number of scans with free view of the position
# Scans in a row with free view that show nothing, 5 s at the default interval. The most of a true tree were 6
# where its column was a tree, and 10 where it was none (614 trees of wild, dense, slope, stand, 4 sensors).
LEFT_SCANS = 12
UNFORCED = -1
VISIBILITY = ("viewed", "present", "absent", "absent_lately", "met", "passed")  # kept with a new axis
BREAST_HEIGHT = slice(6, 11)  # slices, 1.2 to 2.2 m
ABOVE_A_HEAD = slice(int(BANDS[3, 0]), int(BANDS[3, 1]))  # slices, 2.2 to 3.2 m
STOPPED, RAYS = 0.3, 10  # a trunk stops a larger share of the rays; least number of rays
MIGHT = 0.3  # share of the votes, weighted for a round cluster, from which a column might be a tree


@dataclass(frozen=True, slots=True, eq=False)
class ColumnVotes:
    """Columns of length C.

    Attributes:
        place: Positions x, y in the map, shape (C, 2) [m].
        votes: Shares of the votes in the order of CLASSES (tree first), shape (C, 6).
        otherwise: Verdict if the share of votes for tree is below `tree_share`, int32: the class with most
            votes, OTHER in place of TREE, or TOO_LOW (see `column_votes`).
        forced: Verdict that does not depend on the votes, int32, UNFORCED for none: too few voxels, gone, or
            TOO_LOW where rays pass at breast height.
    """

    place: Float
    votes: Float
    otherwise: Int32
    forced: Int32

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [bytes]."""
        return self.place.nbytes + self.votes.nbytes + self.otherwise.nbytes + self.forced.nbytes

    def verdict(self, tree_share: float) -> Int32:
        """Return the verdict of each column, int32, shape (C,): `forced` unless that is UNFORCED, else TREE
        if the share of votes for tree is at least `tree_share`, else `otherwise`.

        Args:
            tree_share: Minimum share of the votes of a tree, inclusive.
        """
        voted = np.where(self.votes[:, 0] >= tree_share, np.int32(Verdict.TREE), self.otherwise)
        verdict: Int32 = np.where(self.forced == UNFORCED, voted, self.forced).astype(np.int32)
        return verdict


def column_votes(columns: Columns) -> ColumnVotes:
    """Return the data that decide the verdicts of columns, as copies; empty arrays if there are no columns.
    The forced verdict is MOVING if the column was absent in at least GONE_SCANS scans and more than the share
    GONE, or in the last LEFT_SCANS scans with free view of it, else TOO_FEW_POINTS (`too_few`), else TOO_LOW
    if rays pass at breast height (`is_transparent`). `otherwise` is TOO_LOW where rays pass above a head and
    the votes for tree, weighted by AT_ROUND, reach MIGHT."""
    c = columns
    if not len(c.share):
        nothing = np.zeros(0, np.int32)
        return ColumnVotes(np.zeros((0, 2)), np.zeros((0, len(CLASSES))), nothing, nothing)
    otherwise = np.array(CLASSES, np.int32)[c.share.argmax(axis=1)]
    otherwise[otherwise == Verdict.TREE] = Verdict.OTHER
    otherwise[(c.share[:, 0] >= MIGHT * (c.share @ np.array(AT_ROUND))) & is_transparent(c, ABOVE_A_HEAD)] = (
        Verdict.TOO_LOW
    )
    forced = np.full(len(c.share), UNFORCED, np.int32)
    forced[is_transparent(c, BREAST_HEIGHT)] = Verdict.TOO_LOW
    forced[too_few(c.figures)] = Verdict.TOO_FEW_POINTS
    forced[(c.absent >= GONE_SCANS) & (c.absent > GONE * (c.present + c.absent))] = Verdict.MOVING
    forced[c.absent_lately >= LEFT_SCANS] = Verdict.MOVING
    return ColumnVotes(c.axis[:, :2].copy(), c.share.copy(), otherwise, forced)


def is_transparent(columns: Columns, slices: slice) -> Bool:
    """Return which columns stop less than the share STOPPED of the rays in a band of heights, shape (C,).

    Columns with fewer than RAYS rays in the band are not transparent.

    Args:
        columns: Columns with the numbers of rays that ended at them and that passed them, by slice.
        slices: The band, as a slice of the axis of heights.
    """
    met, passed = (rays[:, slices].sum(axis=1) for rays in (columns.met, columns.passed))
    transparent: Bool = (met + passed >= RAYS) & (met < STOPPED * (met + passed))
    return transparent


def too_few(figures: Float) -> Bool:
    """Return which columns have fewer than LEAST_VOXELS voxels up to 3 m, shape (C,). `figures` are their
    features, shape (C, COUNT)."""
    few: Bool = figures[:, VOXELS] < LEAST_VOXELS
    return few


LOW, HIGH = 0.6, 1.6  # m above the ground; voxels in this band decide when a column was last seen


def corrected_columns(columns: Columns, memory: VoxelMap, correction: PathCorrection) -> Columns:
    """Return the columns after a correction of the path: position and lean move with the scan that last saw
    the horizontally nearest voxel between LOW and HIGH, and tiles are updated. All other attributes are
    shared. If there are no columns or no such voxels, the argument is returned.

    Args:
        columns: The columns; not changed.
        memory: The voxels before the correction.
        correction: The correction.
    """
    from scipy.spatial import cKDTree

    height = memory.mean[: memory.used, 2]
    rows = np.flatnonzero((height >= LOW) & (height < HIGH))
    if not len(rows) or not len(columns.axis):
        return columns
    _, nearest = cKDTree(memory.mean[rows, :2]).query(columns.axis[:, :2])
    scan = memory.latest[rows[nearest]].astype(np.int64)
    axis = columns.axis.copy()
    axis[:, :2], turn = correction.moved(columns.axis[:, :2], scan)
    c, s = np.cos(turn), np.sin(turn)
    u, v = columns.axis[:, 2], columns.axis[:, 3]
    axis[:, 2], axis[:, 3] = c * u - s * v, s * u + c * v
    return replace(columns, axis=axis, tile=np.floor(axis[:, :2] / TILE).astype(np.int64))


HIGHER = 0.5  # m; least increase of the visible height
MOST_STALE = 2  # tiles per scan, which bounds the time of a scan
_LOOKED, _RAYS = NAMES.index("looked at up to"), NAMES.index("rays up to")


def seen_higher(columns: Columns) -> Int:
    """Return at most MOST_STALE tiles, int64, shape (T, 2), with columns whose visible height has increased
    by more than HIGHER since they were classified, largest increase first; shape (0, 2) if there are no
    columns.

    A person next to the robot at the start is seen from two metres, where no ring reaches above the head.
    Later views from a distance add few returns, so that the tile does not count as grown.
    """
    c = columns
    gain = _gains(c.viewed, c.met, c.passed, c.figures)
    rows = np.flatnonzero(gain > HIGHER)
    rows = rows[np.argsort(-gain[rows], kind="stable")]
    _, first = np.unique(_tile_keys(c.tile[rows]), return_index=True)
    tiles: Int = c.tile[rows[np.sort(first)[:MOST_STALE]]]
    return tiles


def _gains(viewed: Float, met: Int32, passed: Int32, figures: Float) -> Float:
    """Return the increase of the visible height of each column since its features were computed, shape (K,)
    [m]: the larger of those by views and by rays. It is negative if less is visible now.

    Args:
        viewed: Maximum height that a scan observed, shape (K,) [m].
        met, passed: Rays by slice of height, shape (K, SLICES).
        figures: Features at the classification, shape (K, COUNT).
    """
    last = met.shape[1] - 1
    seen = (met + passed > 0)[:, ::-1]
    highest = np.where(seen.any(axis=1), last - seen.argmax(axis=1), 0)
    gain: Float = np.maximum(viewed - figures[:, _LOOKED], highest * SLICE - figures[:, _RAYS])
    return gain


GROWN = 1.1  # factor by which the returns of a tile grow before its columns are classified again
SAME = 0.35  # m; a column within this distance of an earlier one is the same column
FOLD = 25  # scans that a state stores one by one, before they are folded into its voxels


@dataclass(frozen=True, slots=True, eq=False)
class ColumnClassifierState:
    """State between two scans: packed voxels, the scans since as tuples (points, scan number, maximum number
    of voxels), and the columns.

    It shares its arrays with the classifier, so that a snapshot copies nothing.
    """

    base: PackedVoxelMap
    since: tuple[tuple[Float32, int, int], ...]
    columns: Columns

    def folded(self) -> VoxelMap:
        """Return an independent voxel map with the scans since; the state does not change. The tiles that
        were classified after these scans are marked as classified."""
        memory = self.base.unpacked()
        for points, scan, most in self.since:
            memory.add(points, scan, most)
            memory.due_tiles(GROWN)
        return memory


class ColumnClassifier:
    """Integrates scans into voxels and classifies the columns in them.

    Args:
        parameters: Parameters of this stage.
        all_around: Initial value of the attribute `all_around`.
        forests: Function of the name of a random forest and `all_around` that returns the forest.

    Attributes:
        columns: The columns.
        votes: What decided their verdicts at the last scan that was added.

    Raises:
        StemmapError: There is no such forest.
    """

    def __init__(
        self, parameters: Classification, *, all_around: bool, forests: ForestOf = package_alone
    ) -> None:
        self._all_around, self._forests = all_around, forests
        self.parameters = parameters
        self._memory: VoxelMap | None = VoxelMap.empty(1 << parameters.voxels_log2)
        self._folded: Callable[[], VoxelMap] | None = None  # makes the voxel map on demand after `restore`
        self.columns = no_columns()
        self.votes = column_votes(self.columns)
        self._base = PackedVoxelMap.of(self.memory)
        self._since: list[tuple[Float32, int, int]] = []

    @property
    def all_around(self) -> bool:
        """Whether the random forest for sensors that see all around is used, see `is_seen_all_around`. A
        change loads the other forest (StemmapError if it cannot be read; the value then stays); the next scan
        classifies all columns again."""
        return self._all_around

    @all_around.setter
    def all_around(self, all_around: bool) -> None:
        if all_around != self._all_around:
            self._forest = self._forests(self.parameters.forest, all_around)
            self._all_around, self._vote_again = all_around, True

    @property
    def parameters(self) -> Classification:
        """Parameters. Setting them loads the forest (StemmapError if there is none of that name; the
        parameters then stay); the next scan classifies all columns again with it."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: Classification) -> None:
        self._forest = self._forests(parameters.forest, self._all_around)
        self._parameters = parameters
        self._vote_again = True

    @property
    def memory(self) -> VoxelMap:
        """The voxels of all scans, not a copy. After `restore` they are unpacked at the first access, which
        takes time."""
        if self._memory is None:
            assert self._folded is not None  # noqa: S101 - one of both exists
            self._memory, self._folded = self._folded(), None
        return self._memory

    def add(self, points: Float32, height: Float32, scan: int, view: ScanView) -> None:
        """Integrate a scan and classify the columns of the tiles that are due; afterwards `columns` is a new
        table. The visibility and the rays of all columns in range, also new ones, are updated, and all
        columns get their verdict again.

        Args:
            points: Points in the level sensor frame, float32, shape (N, 3) [m].
            height: Heights of the points above the ground, shape (N,) [m]. Points are ignored if the height
                is NaN, at most 0 or at least SLICES * SLICE, or if they are `range_max` or farther from the
                base.
            scan: Number of the scan, not negative, ascending.
            view: Pose and visibility of the scan.
        """
        p, pose = self.parameters, view.T_map_base.as_array()
        here = _to_map(points, height, pose, view.sensor_offset, p.range_max)
        tiles = self._remember(here, scan, 1 << p.voxels_log2)
        profiles = self._extract_columns(_joined(tiles, seen_higher(self.columns)))
        c = self.columns
        first = len(c.verdict) - len(profiles)
        seen = (view.clear_range, view.steepest, view.sensor_offset, view.terrain)
        presence = (c.present, c.absent, c.absent_lately)
        update_visibility(c.axis, c.viewed, *presence, pose, *seen, p.range_max)
        through = (view.depth, view.sensor_offset, view.terrain)
        count_rays(c.axis, c.met, c.passed, pose, *through, p.range_max)
        new = slice(first, None)
        scans, rays = (c.viewed[new], c.present[new], c.absent[new]), (c.met[new], c.passed[new])
        features(c.axis[new], profiles, *scans, *rays, c.figures[new])
        self._classify(first)

    def snapshot(self) -> ColumnClassifierState:
        """Return the state without the parameters. It shares its arrays with the classifier, which never
        changes them later."""
        return ColumnClassifierState(self._base, tuple(self._since), self.columns)

    def restore(self, state: ColumnClassifierState) -> None:
        """Return to a state of `snapshot`; the state itself does not change. The parameters remain, and the
        next scan classifies all columns again."""
        self._base, self._since = state.base, list(state.since)
        self._memory, self._folded = None, state.folded
        self.columns = state.columns
        self._vote_again = True  # another forest may have voted at that time

    def correct(self, correction: PathCorrection) -> None:
        """Move voxels and columns with a corrected path, and call `settle`. All tiles become due; verdicts
        change at the next scan."""
        self.columns = corrected_columns(self.columns, self.memory, correction)
        self._memory = corrected_voxels(self.memory, correction)
        self.settle()

    @property
    def is_unsettled(self) -> bool:
        """Whether `settle` is due: FOLD or more scans were added since the last call."""
        return len(self._since) >= FOLD

    def settle(self) -> None:
        """Fold the scans since the last call into the packed voxels of later states, which copies all voxels.
        The result of the classification does not depend on it; if it is not called between two scans, `add`
        calls it when it is due."""
        self._base, self._since = PackedVoxelMap.of(self.memory), []

    def _remember(self, points: Float32, scan: int, most: int) -> Int:
        """Add points of a scan to the voxels and return the tiles that are due for classification, shape (T,
        2); settles first if that is due.

        Args:
            points: x, y in the frame of the map and height above the ground, float32, shape (N, 3) [m].
            scan: Number of the scan.
            most: Maximum number of voxels, a power of two.
        """
        if self.is_unsettled:
            self.settle()
        self._since.append((points, scan, most))
        self.memory.add(points, scan, most)
        return self.memory.due_tiles(GROWN)

    def _extract_columns(self, tiles: Int) -> Float:
        """Extract the columns of tiles again; return their profiles, shape (K, SLICES, PROFILE).

        `columns` is replaced by a new table: first the columns of other tiles, then the K new ones, with axis
        and tile and the visibility of the nearest earlier column within SAME; their features and votes are 0.

        Args:
            tiles: Indices of the tiles, shape (T, 2).
        """
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
        for name in (*VISIBILITY, "figures", "share", "verdict"):
            getattr(fresh, name)[:n] = getattr(old, name)[kept]
        nearest = nearest_other(fresh.axis[n:], old.axis, SAME)
        again = np.flatnonzero(nearest >= 0)
        for name in VISIBILITY:
            getattr(fresh, name)[n + again] = getattr(old, name)[nearest[again]]
        self.columns = fresh
        return np.concatenate(profiles)

    def _classify(self, first: int) -> None:
        """Compute the votes of the columns from row `first` onwards, or of all after a change of the forest;
        all columns get their verdict, because objects may have left."""
        c = self.columns
        if self._vote_again:
            first, self._vote_again = 0, False
        c.share[first:] = vote(c.figures[first:], self._forest)
        self.votes = column_votes(c)
        self.columns = replace(c, verdict=self.votes.verdict(self.parameters.tree_share))


def no_columns() -> Columns:
    """Return a table of columns without rows."""
    return _rows(np.zeros((0, 5)), np.zeros((0, 2), np.int64))


def _rows(axis: Float, tile: Int) -> Columns:
    """Return columns with zeros for statistics, features and votes, and the verdict OTHER.

    Args:
        axis: Axes, shape (K, 5): x, y at 1.3 m [m], shift per metre of height, strength; not copied.
        tile: Tile of each column, int64, shape (K, 2); not copied.
    """
    n = len(axis)
    zero = np.zeros(n)
    return Columns(
        tile=tile,
        axis=axis,
        viewed=zero,
        present=zero.copy(),
        absent=zero.copy(),
        absent_lately=zero.copy(),
        met=np.zeros((n, SLICES), np.int32),
        passed=np.zeros((n, SLICES), np.int32),
        figures=np.zeros((n, COUNT)),
        share=np.zeros((n, len(CLASSES))),
        verdict=np.full(n, Verdict.OTHER, np.int32),
    )


def _joined(tiles: Int, more: Int) -> Int:
    """Return the tiles of `tiles`, then those of `more` that are not among them; shape (T, 2) each."""
    return np.concatenate([tiles, more[~_among(more, tiles)]])


def _among(home: Int, tiles: Int) -> Bool:
    """Return whether each tile of `home`, int64, shape (K, 2), is among `tiles`, shape (T, 2); shape (K,)."""
    there: Bool = (_tile_keys(home)[:, None] == _tile_keys(tiles)).any(axis=1)
    return there


def _tile_keys(tiles: Int) -> Int:
    """Return a number of each tile, int64, shape (T,), for tiles of shape (T, 2)."""
    return (tiles[:, 0] << 32) + tiles[:, 1]


@compiled
def _to_map(points: Float32, height: Float32, pose: Float, offset: Float, range_max: float) -> Float32:
    """Return x, y in the frame of the map and height above the ground [m] of the points in range and between
    0 and SLICES * SLICE above the ground, both exclusive, float32, shape (M, 3), in their order; points with
    NaN are left out.

    Args:
        points: Points in the level sensor frame, shape (N, 3) [m].
        height: Heights of the points above the ground, shape (N,) [m].
        pose: Pose x, y [m], yaw [rad] of the base in the map, shape (3,).
        offset: Position of the sensor in the base frame, shape (3,) [m].
        range_max: Maximum horizontal distance from the base, exclusive [m].
    """
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
