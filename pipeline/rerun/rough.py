"""A first answer before the run is mapped again: the kept clusters judged anew, at the poses of before.

It knows of no gate, no miss and no merging, and holds each pose for true, as it is known behind all loops,
but those of a robot that is lost or looks for a loop. Other parameters of SLAM may find others; the map that
follows is exact.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled, compiled_within
from pipeline.geometry import Float
from pipeline.parameters import Parameters
from pipeline.records import Bool, Int, Trees, Verdict
from pipeline.rerun.basis import Basis
from pipeline.rerun.clusters import ClusterTable
from pipeline.rerun.journal import Entry
from pipeline.rerun.tail import columns_of
from pipeline.slam.cells import Cells, cell_of, cells_for, first_of_four, per_metre
from pipeline.tracking.judging import REACH, nearest_other, tree_columns

MOST_PLACES = 20_000


def rough_trees(basis: Basis, clusters: ClusterTable, parameters: Parameters) -> Trees | None:
    """Where trees will be, without diameters and with numbers that hold for nothing else.

    Args:
        basis: The run before; clusters: of the same scans.
        parameters: That are tried.

    Returns:
        None where the parameters look at a scan in another way, or gather it in another.
    """
    scans = min(len(basis.entries), len(clusters))
    if scans == 0 or not basis.shows_as(parameters):
        return None
    entries, p = basis.entries[:scans], parameters
    pose = np.concatenate([basis.path[:scans], [e.offset[:2] for e in entries]], axis=1)
    tree = clusters.verdicts(p.detection, scans) == Verdict.TREE
    start = np.array(clusters.start[: scans + 1])
    tree &= np.repeat([e.is_usual for e in entries], np.diff(start))
    reach = max(p.tracking.proximity_radius, min(p.tracking.distance_max, REACH))
    place, hits = _gathered(clusters.centre(scans), tree, start, pose, reach, MOST_PLACES)
    confirmed = hits >= p.tracking.hits_to_confirm
    return _trees(*_judged(place, hits, confirmed, entries, p))


def _judged(
    place: Float, hits: Int, confirmed: Bool, entries: tuple[Entry, ...], p: Parameters
) -> tuple[Float, Int]:
    """Places and hits of the trees: what was gathered decides wherever it tells anything."""
    known = next((e.columns for e in reversed(entries) if e.columns is not None), None)
    if known is None or p.gathering.method == "none":
        return place[confirmed], hits[confirmed]
    columns = columns_of(known, p.gathering.tree_share)
    trees = tree_columns(columns)
    at = columns.axis[trees, :2].copy()
    track = nearest_other(at, place, REACH)
    seen = track >= 0
    at[seen] = place[track[seen]]
    free = confirmed & (nearest_other(place, columns.axis[:, :2].copy(), REACH) < 0)
    views = np.where(seen, hits[track] if len(hits) else 0, 0)
    return np.concatenate([at, place[free]]), np.concatenate([views, hits[free]])


def _trees(place: Float, hits: Int) -> Trees:
    n = len(place)
    unknown, none = np.full(n, np.nan), np.zeros(n, np.int64)
    return Trees(
        number=np.arange(1, n + 1),
        position=place,
        covariance=np.full((n, 2, 2), np.nan),
        velocity=np.zeros((n, 2)),
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
def _gathered(
    centre: Float, tree: Bool, start: Int, pose: Float, reach: float, most: int
) -> tuple[Float, Int]:
    """Means of the clusters that lie within reach of the first one of each place, and their number.

    Args:
        centre: Level sensor frame, shape (K, 2) [m]; tree: which of them are trees.
        start: The first row of each scan, shape (N + 1,).
        pose: x, y [m], yaw [rad] of the base in the map, and the sensor's x, y in its frame, shape (N, 5).
    """
    place, hits, n = np.empty((most, 2)), np.zeros(most, np.int64), 0
    cells, scale = cells_for(most), per_metre(reach)
    for k in range(pose.shape[0]):
        c, s = np.cos(pose[k, 2]), np.sin(pose[k, 2])
        for row in range(start[k], start[k + 1]):
            if not tree[row]:
                continue
            bx, by = centre[row, 0] + pose[k, 3], centre[row, 1] + pose[k, 4]
            x, y = pose[k, 0] + c * bx - s * by, pose[k, 1] + s * bx + c * by
            at = _nearest_in(cells, place, x, y, reach, scale)
            if at >= 0:
                _take_out(cells, at)
            elif n < most:
                at, n = n, n + 1
                place[at, 0] = place[at, 1] = 0.0
            else:
                continue
            hits[at] += 1
            place[at, 0] += (x - place[at, 0]) / hits[at]
            place[at, 1] += (y - place[at, 1]) / hits[at]
            _put_in(cells, place, at, scale)
    return place[:n].copy(), hits[:n].copy()


@compiled_within
def _nearest_in(cells: Cells, place: Float, x: float, y: float, reach: float, scale: float) -> int:
    """The nearest place within reach of a point, -1 for none."""
    u, v = first_of_four(x, y, scale)
    best, at = reach * reach, -1
    for quarter in range(4):
        t = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
        while t >= 0:
            dx, dy = place[t, 0] - x, place[t, 1] - y
            if dx * dx + dy * dy < best:
                best, at = dx * dx + dy * dy, t
            t = cells.following[t]
    return at


@compiled_within
def _put_in(cells: Cells, place: Float, t: int, scale: float) -> None:
    """File a place under the cell that it lies in."""
    at = cell_of(int(np.floor(scale * place[t, 0])), int(np.floor(scale * place[t, 1])))
    cells.cell[t], cells.following[t], cells.head[at] = at, cells.head[at], t


@compiled_within
def _take_out(cells: Cells, t: int) -> None:
    """Take a place out of the cell that it is filed under."""
    before = cells.head[cells.cell[t]]
    if before == t:
        cells.head[cells.cell[t]] = cells.following[t]
        return
    while cells.following[before] != t:
        before = cells.following[before]
    cells.following[before] = cells.following[t]
