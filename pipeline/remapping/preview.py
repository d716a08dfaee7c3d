"""Preview of a rerun: where trees would stand, in a fraction of a second.

The known clusters of all scans, or of every n-th scan of a long run, get their verdicts again, at the known
poses; clusters at one place are a tree. The preview knows no gate, no miss and no merging, and keeps the
poses, so the rerun that follows may differ. Scans of a lost robot are left out.

Where the parameters change the clusters themselves, a sample of the scans is segmented again. How often a
tree is found in the sample, before and after, gives an estimate for all scans.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pipeline.classification import column_votes
from pipeline.config import Parameters
from pipeline.config.stages import Detection
from pipeline.detection.verdicts import classify_clusters
from pipeline.front_end import SegmentedScan
from pipeline.geometry.columns import GrowingColumns
from pipeline.geometry.hash_grid import cells_for, nearest_in, nearest_other, per_metre, put_in, take_out
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.remapping.rerun import SEGMENTATION_STAGES
from pipeline.tracking.track_classification import REACH, tree_columns
from pipeline.types.records import Bool, Clusters, Columns, Frame, Int, Path, Trees, Verdict
from pipeline.types.units import SECOND_NS

MOST_PLACES = 20_000
LEAST_HITS = 2  # finds of a tree in the sample, below which the sample says nothing about it
SAMPLE_SCANS, SAMPLE_BYTES = 56, 20 << 20  # at most, in the sample; the time of a preview grows with them
TREE_SHARE = {"tree_share"}  # of the classification parameters, it only turns votes into verdicts
COLUMN_STAGES, NOT_OF_COLUMNS = ("acquisition", "filters", "ground"), {"voxel_size"}
JUDGED_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "hidden": ("?", ()),
    "cut": ("?", ()),
    "extent": ("<f8", (3,)),
    "eccentricity": ("<f8", ()),
    "radial_std": ("<f8", ()),
    "radius": ("<f8", ()),
    "arc": ("<f8", ()),
    "centre": ("<f8", (2,)),
}
MOST_ROWS = 400_000  # clusters in a table, 39 MB, as its arrays double; a scan among trees has 20 to 50
MOST_SCANS = 40_000  # scans of a table with clusters, 1 MB


class ClusterTable:
    """Clusters of all scans of a run, about 75 bytes each: what their verdicts need, and where they are.

    Above MOST_ROWS clusters or MOST_SCANS scans, every second scan is dropped, repeatedly.

    Attributes:
        spacing: Power of two; scans whose number is a multiple of it are stored.
        start: First row of each stored scan, then the number of all rows.
    """

    def __init__(self) -> None:
        """Create a table without scans."""
        self.spacing = 1
        self._rows = GrowingColumns(*(np.zeros((0, *shape), kind) for kind, shape in JUDGED_COLUMNS.values()))
        self.start = array("q", [0])
        self._offsets = array("d")  # sensor in the base frame, x, y of each stored scan [m]
        self._lost = array("b")
        self._scans = 0

    def __len__(self) -> int:
        """Return the number of scans, stored or not."""
        return self._scans

    def put(self, index: int, clusters: Clusters, offset: Float, *, lost: bool = False) -> None:
        """Store the clusters of a scan. Those of this and later scans are removed first. A scan beyond the
        next one is ignored. While there are more than MOST_ROWS clusters or MOST_SCANS scans, every second
        scan is removed and `spacing` doubled, until one scan is left.

        Args:
            index: Number of the scan; one that is no multiple of `spacing` is counted, not stored.
            clusters: Clusters of the scan; copied.
            offset: Position of the sensor in the base frame, shape (3,) [m].
            lost: Whether the robot was lost, so that the pose is unusable.
        """
        if index > len(self):
            return
        self._scans = index + 1
        stored = -(-index // self.spacing)
        del self.start[stored + 1 :], self._offsets[2 * stored :], self._lost[stored:]
        if index % self.spacing:
            return
        self._rows.write(self.start[-1], *(getattr(clusters, name) for name in JUDGED_COLUMNS))
        self.start.append(len(self._rows))
        self._offsets.extend(offset[:2].tolist())
        self._lost.append(lost)
        while self.start[-1] > MOST_ROWS or len(self._lost) > MOST_SCANS:
            if len(self._lost) == 1:
                return
            self._drop_every_second_scan()

    def _drop_every_second_scan(self) -> None:
        """Double `spacing`, and drop the scans whose number is no multiple of it."""
        part = self.of(range(0, len(self), 2 * self.spacing))
        self.spacing *= 2
        self.start, self._offsets, self._lost = part.start, part._offsets, part._lost
        self._rows = part._rows

    def until(self, scans: int) -> ClusterTable:
        """Return a copy with the first scans, which must be in the table."""
        part, stored = ClusterTable(), -(-scans // self.spacing)
        part.spacing, part._scans = self.spacing, scans
        part.start, part._lost = self.start[: stored + 1], self._lost[:stored]
        part._offsets = self._offsets[: 2 * stored]
        part._rows = GrowingColumns(*(column[: part.start[-1]] for column in self._columns().values()))
        return part

    def record(self, frame: Frame) -> None:
        """Store the clusters of a mapped scan, and remove those of this and later scans before; a scan beyond
        the next one is ignored. The robot counts as lost if its health is "lost"."""
        lost = frame.estimate.health.state == "lost"
        self.put(frame.index, frame.clusters, frame.sensor_offset, lost=lost)

    def of(self, scans: Sequence[int]) -> ClusterTable:
        """Return a table of some scans as a copy: its scan k is the k-th of `scans`, its `spacing` 1. Scans
        that are not stored have no clusters in it.

        Raises:
            IndexError: A scan is not in the table.
        """
        number = np.array(scans, np.int64)
        if number.max(initial=-1) >= len(self):
            raise IndexError("a scan is not in the table")
        start, row = np.array(self.start), number // self.spacing
        sizes = np.where(number % self.spacing == 0, np.diff(start)[row], 0)
        rows = [np.arange(first, first + size) for first, size in zip(start[row], sizes, strict=True)]
        every = np.concatenate([np.zeros(0, np.int64), *rows])
        part = ClusterTable()
        part.start = array("q", np.cumsum([0, *sizes]).tolist())
        part._rows = GrowingColumns(*(column[every] for column in self._columns().values()))
        part._offsets = array("d", np.array(self._offsets).reshape(-1, 2)[row].ravel().tolist())
        part._lost = array("b", np.array(self._lost, np.int8)[row].tolist())
        part._scans = len(number)
        return part

    def verdicts(self, parameters: Detection) -> Int:
        """Return the verdict of each stored cluster by these parameters, a number of `Verdict`, int64, shape
        (K,)."""
        unused = np.zeros(self.start[-1])
        clusters = Clusters(
            **self._columns(),
            size=unused.astype(np.int64),
            centroid=unused,
            covariance=unused,
            radius_sigma=unused,
            verdict=unused.astype(np.int32),
        )
        verdict: Int = classify_clusters(clusters, parameters).verdict.astype(np.int64)
        return verdict

    def places(self, path: Float, p: Parameters) -> tuple[Float, Int, Int, Int]:
        """Group the clusters with the verdict TREE by their position in the map, and return the results of
        `grouped`. Scans of a lost robot are omitted; at most MOST_PLACES groups are returned.

        Args:
            path: x, y [m], yaw [rad] of the base at each stored scan, shape (N, 3).
            p: Parameters of the verdicts, and of the distance between two trees.
        """
        start = np.array(self.start)
        tree = self.verdicts(p.detection) == Verdict.TREE
        tree &= ~np.repeat(np.array(self._lost, np.bool_), np.diff(start))
        pose = np.concatenate([path, np.array(self._offsets).reshape(-1, 2)], axis=1)
        return grouped(self._columns()["centre"], tree, start, pose, _reach(p), MOST_PLACES)

    def _columns(self) -> dict[str, Any]:
        """Return a dict from the names in JUDGED_COLUMNS to the values of the stored clusters, views that
        `put` may change."""
        return {name: self._rows.column(k)[: self.start[-1]] for k, name in enumerate(JUDGED_COLUMNS)}


def sample_scans(scans: int, size: int) -> range:
    """Return the numbers of the scans that a sample of a run has: every n-th one, where n is the smallest
    power of two with at most SAMPLE_SCANS scans and SAMPLE_BYTES; at least the first scan of a run that has
    one.

    Args:
        scans: Number of scans of the run.
        size: Size of the points of a scan [bytes].
    """
    most = max(1, min(SAMPLE_SCANS, SAMPLE_BYTES // max(size, 1)))
    spacing = 1
    while len(numbers := range(0, scans, spacing)) > most:
        spacing *= 2
    return numbers


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """A run as it is mapped.

    Attributes:
        parameters: Parameters with which the run was mapped.
        clusters: Clusters of the run.
        path: Path of the run.
        columns: Voxel columns of the run; None if there is none.
    """

    parameters: Parameters
    clusters: ClusterTable
    path: Path
    columns: Columns | None


def needs_sample(known: KnownMap, parameters: Parameters) -> bool:
    """Return whether `preview_trees` with these arguments needs a sample: whether a stage of the segmentation
    differs, so that the clusters change. False where there is no preview with a sample either."""
    differs = any(getattr(parameters, s) != getattr(known.parameters, s) for s in SEGMENTATION_STAGES)
    return differs and _classifies_alike(known.parameters, parameters)


def preview_trees(
    known: KnownMap, parameters: Parameters, sample: Mapping[int, SegmentedScan] | None = None
) -> Trees | None:
    """Return the trees that a rerun with other parameters would approximately give, without diameters,
    covariances and times (NaN or 0). All are confirmed, and their numbers (from 1) are unrelated to those of
    the run.

    Args:
        known: The run as it is mapped; unchanged.
        parameters: The other parameters.
        sample: Some scans as these parameters segment them, by their numbers, ascending; used if
            `needs_sample`.

    Returns:
        The trees. None if no scan is known, if the parameters classify columns in another way (apart from
        `tree_share`), or if a needed sample is empty.
    """
    path = np.stack([known.path.x, known.path.y, known.path.yaw], axis=1)
    scans = min(len(path), len(known.clusters))
    if scans == 0 or not _classifies_alike(known.parameters, parameters):
        return None
    table, path = known.clusters.of(range(scans)), path[:scans]
    if not needs_sample(known, parameters):
        return _trees(_all_places(known, table, path, parameters))
    if not sample:
        return None
    same = {stage: getattr(known.parameters, stage) for stage in SEGMENTATION_STAGES}
    before = _all_places(known, table, path, parameters.model_copy(update=same))
    return _trees(_with_sample(before, known, table, path, parameters, sample))


class _Places(NamedTuple):
    """T trees: position x, y in the map, shape (T, 2) [m], number of clusters, shape (T,), and whether the
    tree is that of a voxel column, shape (T,)."""

    place: Float
    hits: Int
    has_column: Bool


def _classifies_alike(before: Parameters, now: Parameters) -> bool:
    """Return whether both classify the same columns with the same votes: whether the classification differs
    at most in `tree_share`."""
    a, b = (p.classification.model_dump(exclude=TREE_SHARE) for p in (before, now))
    return bool(a == b)


def _has_same_columns(before: Parameters, now: Parameters) -> bool:
    """Return whether both integrate the same points into the columns: the stages COLUMN_STAGES differ at most
    in the voxel size."""
    a, b = (
        [getattr(p, stage).model_dump(exclude=NOT_OF_COLUMNS) for stage in COLUMN_STAGES]
        for p in (before, now)
    )
    return a == b


def _reach(p: Parameters) -> float:
    """Return the distance up to which clusters belong to one tree [m]: the proximity radius, at least the
    association distance up to REACH."""
    return max(p.tracking.proximity_radius, min(p.slam.distance_max, REACH))


def _columns(known: KnownMap, p: Parameters) -> Columns | None:
    """Return the voxel columns with the verdicts of other parameters; the other arrays are shared. None
    without columns or if the parameter `classification.method` is "none"."""
    if known.columns is None or p.classification.method == "none":
        return None
    return replace(known.columns, verdict=column_votes(known.columns).verdict(p.classification.tree_share))


def _all_places(known: KnownMap, table: ClusterTable, path: Float, p: Parameters) -> _Places:
    """Return the trees of all scans: first one for each voxel column with the verdict TREE, then each group
    of clusters (`ClusterTable.places`) that its hits and their time confirm, without a column within REACH.
    The hits of a group are its clusters times `spacing`. The tree of a column has position and hits of the
    nearest group within REACH; without one, the position of the column and 0 hits.

    Args:
        known: The run, for its columns.
        table: Clusters of N scans.
        path: x, y [m], yaw [rad] of the base at these scans, shape (N, 3).
        p: Parameters of verdicts, tracking and classification.
    """
    place, hits, first, last = table.places(path, p)
    hits *= known.clusters.spacing
    # As for the hits: each stored scan is for those up to the next one.
    last = np.minimum(last + known.clusters.spacing - 1, len(path) - 1)
    seen_s = (known.path.stamp_ns[last] - known.path.stamp_ns[first]) / SECOND_NS
    confirmed = (hits >= p.tracking.hits_to_confirm) & (seen_s >= p.tracking.confirm_time)
    columns = _columns(known, p)
    if columns is None:
        return _Places(place[confirmed], hits[confirmed], np.zeros(np.count_nonzero(confirmed), np.bool_))
    at = columns.axis[tree_columns(columns), :2].copy()
    track = nearest_other(at, place, REACH)
    seen = track >= 0
    at[seen] = place[track[seen]]
    free = confirmed & (nearest_other(place, columns.axis[:, :2].copy(), REACH) < 0)
    views = np.where(seen, hits[track] if len(hits) else 0, 0)
    has_column = np.arange(len(at) + np.count_nonzero(free)) < len(at)
    return _Places(np.concatenate([at, place[free]]), np.concatenate([views, hits[free]]), has_column)


def _with_sample(
    before: _Places,
    known: KnownMap,
    table: ClusterTable,
    path: Float,
    p: Parameters,
    sample: Mapping[int, SegmentedScan],
) -> _Places:
    """Return the trees of all scans, corrected by a sample of scans that was segmented again.

    The clusters of the sample within REACH of a tree are counted with the parameters of the run (`old`) and
    with `p` (`new`). If `old` is at least LEAST_HITS, the hits of the tree are multiplied by `new / old` and
    rounded down, and a tree with fewer than `hits_to_confirm` hits is removed; otherwise the tree is
    unchanged. The tree of a voxel column is not removed if the parameters of the columns are the same or
    `new` is above 0; else it counts as a tree without column. A position with at least LEAST_HITS clusters
    with `p` is a new tree if no tree, no voxel column and no position with the parameters of the run is
    within REACH.

    Args:
        before: Trees of all scans with the segmentation of the run.
        known: The run.
        table: Clusters of N scans.
        path: Poses x, y [m], yaw [rad] of the base in the map at these scans, shape (N, 3).
        p: The other parameters.
        sample: Scans segmented with `p`, a dict from the row in the table; rows of N or more are ignored.
    """
    scans = [k for k in sample if k < len(table)]
    part, fresh = table.of(scans), ClusterTable()
    for n, k in enumerate(scans):
        fresh.put(n, sample[k].clusters, sample[k].sensor_offset, lost=bool(part._lost[n]))
    old, old_hits, *_ = part.places(path[scans], p)
    new, new_hits, *_ = fresh.places(path[scans], p)

    was, now = (
        _sums(nearest_other(place, before.place, REACH), found, len(before.place))
        for place, found in ((old, old_hits), (new, new_hits))
    )
    is_known = was >= LEAST_HITS
    hits = np.where(is_known, before.hits * now // np.maximum(was, 1), before.hits)
    has_column = before.has_column & (_has_same_columns(known.parameters, p) | (now > 0))
    stays = has_column | ~is_known | (hits >= p.tracking.hits_to_confirm)

    is_new = (new_hits >= LEAST_HITS) & (nearest_other(new, before.place, REACH) < 0)
    is_new &= nearest_other(new, old, REACH) < 0
    columns = _columns(known, p)
    if columns is not None:
        is_new &= nearest_other(new, columns.axis[:, :2].copy(), REACH) < 0
    return _Places(
        np.concatenate([before.place[stays], new[is_new]]),
        np.concatenate([hits[stays], new_hits[is_new]]),
        np.concatenate([before.has_column[stays], np.zeros(np.count_nonzero(is_new), np.bool_)]),
    )


def _sums(row: Int, hits: Int, rows: int) -> Int:
    """Return for each row from 0 to `rows` - 1 the sum of the entries of `hits` whose entry in `row`, of the
    same shape, is this row, int64, shape (rows,). Entries with the row -1 are omitted."""
    valid = row >= 0
    return np.bincount(row[valid], hits[valid], rows).astype(np.int64)


def _trees(known: _Places) -> Trees:
    """Return T trees as confirmed `Trees` with the numbers 1 to T and the hits as observations; diameters,
    eccentricities and covariances are NaN, times and coverage 0."""
    place, hits, n = known.place, known.hits, len(known.place)
    unknown, none = np.full(n, np.nan), np.zeros(n, np.int64)
    return Trees(
        number=np.arange(1, n + 1),
        position=place,
        covariance=np.full((n, 2, 2), np.nan),
        dbh=unknown,
        dbh_sigma=unknown,
        eccentricity=unknown,
        observations=hits.astype(np.int64),
        coverage=np.zeros(n),
        first_seen_ns=none,
        last_seen_ns=none,
        confirmed=np.ones(n, np.bool_),
    )


@compiled
def grouped(
    centre: Float, tree: Bool, start: Int, pose: Float, reach: float, most: int
) -> tuple[Float, Int, Int, Int]:
    """Group the clusters that are trees, in their order: each joins the group whose mean position is nearest
    and within `reach`, or begins a group. Return the mean position x, y of each of T groups in the map, shape
    (T, 2) [m], its number of clusters, and its first and its last scan, int64, shape (T,).

    Args:
        centre: Positions in the level sensor frame, shape (K, 2) [m].
        tree: Which clusters are trees, shape (K,).
        start: First row of each scan, then K, int64, shape (N + 1,).
        pose: x, y [m], yaw [rad] of the base in the map, then x, y of the sensor in the base frame, shape (N,
            5).
        reach: Maximum distance between a cluster and the mean position of its group [m].
        most: Maximum number of groups; clusters that would begin further ones are omitted.
    """
    place, hits, n = np.empty((most, 2)), np.zeros(most, np.int64), 0
    first, last = np.empty(most, np.int64), np.empty(most, np.int64)
    cells, scale = cells_for(most), per_metre(reach)
    for k in range(pose.shape[0]):
        c, s = np.cos(pose[k, 2]), np.sin(pose[k, 2])
        for row in range(start[k], start[k + 1]):
            if not tree[row]:
                continue
            bx, by = centre[row, 0] + pose[k, 3], centre[row, 1] + pose[k, 4]
            x, y = pose[k, 0] + c * bx - s * by, pose[k, 1] + s * bx + c * by
            at = nearest_in(cells, place, x, y, reach, scale)
            if at >= 0:
                take_out(cells, at)
            elif n < most:
                at, n = n, n + 1
                place[at, 0] = place[at, 1] = 0.0
                first[at] = k
            else:
                continue
            hits[at] += 1
            last[at] = k
            place[at, 0] += (x - place[at, 0]) / hits[at]
            place[at, 1] += (y - place[at, 1]) / hits[at]
            put_in(cells, place, at, scale)
    return place[:n].copy(), hits[:n].copy(), first[:n].copy(), last[:n].copy()
