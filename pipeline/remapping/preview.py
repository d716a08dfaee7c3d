"""A first answer before the run is mapped again: the kept clusters judged anew, at the poses of before.

It knows of no gate, no miss and no merging, and holds each pose for true, as it is known behind all loops,
but those of a robot that is lost or looks for a loop. Other parameters of SLAM may find others; the map that
follows is exact.

Where a scan would show other clusters, some scans are looked at again: what they find of a tree, as against
what they found, tells how often the others would.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.config import Parameters
from pipeline.front_end import SegmentedScan
from pipeline.geometry.hash_grid import cells_for, nearest_in, per_metre, put_in, take_out
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.remapping.clusters import ClusterTable
from pipeline.remapping.notes import Notes
from pipeline.remapping.resume_point import Basis
from pipeline.remapping.retracking import columns_of
from pipeline.tracking.track_classification import REACH, nearest_other, tree_columns
from pipeline.types.records import Bool, Columns, Int, Trees, Verdict

MOST_PLACES = 20_000
LEAST = 2  # looks at a tree in the sample that tell anything of it


def rough_trees(
    basis: Basis,
    clusters: ClusterTable,
    parameters: Parameters,
    sample: Mapping[int, SegmentedScan] | None = None,
) -> Trees | None:
    """Where trees will be, without diameters and with numbers that hold for nothing else.

    Args:
        basis: The run before; clusters: of the same scans.
        parameters: That are tried.
        sample: What some of the scans show with these, by their numbers, ascending.

    Returns:
        None where the parameters gather in another way, or look at scans in another one without a sample.
    """
    scans = min(len(basis.notes), len(clusters))
    if scans == 0 or not basis.gathers_as(parameters):
        return None
    if basis.shows_as(parameters):
        return _trees(_known(basis, clusters, parameters, scans))
    if not sample:
        return None
    before = _known(basis, clusters, basis.looking_as_before(parameters), scans)
    return _trees(_with_sample(before, basis, clusters, parameters, sample))


class _Places(NamedTuple):
    """Trees: where, by how many clusters, and whether what was gathered tells of them, shape (T, ...)."""

    place: Float
    hits: Int
    gathered: Bool


def _known(basis: Basis, clusters: ClusterTable, p: Parameters, scans: int) -> _Places:
    """Of what all scans have shown."""
    notes = basis.notes.first(scans)
    place, hits = _found(basis, range(scans), clusters, p)
    return _judged(place, hits, hits >= p.tracking.hits_to_confirm, notes, p)


def _found(basis: Basis, scans: Sequence[int], clusters: ClusterTable, p: Parameters) -> tuple[Float, Int]:
    """The places where the clusters of scans, which are those of the table in their order, show trees."""
    rows = np.array(scans, np.int64)
    offset, usual = basis.notes.offset[rows, :2], basis.notes.is_usual[rows]
    start = np.array(clusters.start[: len(rows) + 1])
    tree = clusters.verdicts(p.detection, len(rows)) == Verdict.TREE
    tree &= np.repeat(usual, np.diff(start))
    pose = np.concatenate([basis.path[rows], offset], axis=1)
    return _gathered(clusters.centre(len(rows)), tree, start, pose, _reach(p), MOST_PLACES)


def _reach(p: Parameters) -> float:
    return max(p.tracking.proximity_radius, min(p.tracking.distance_max, REACH))


def _judged(place: Float, hits: Int, confirmed: Bool, notes: Notes, p: Parameters) -> _Places:
    """The trees among places: what was gathered decides wherever it tells anything."""
    columns = _columns(notes, p)
    if columns is None:
        return _Places(place[confirmed], hits[confirmed], np.zeros(np.count_nonzero(confirmed), np.bool_))
    trees = tree_columns(columns)
    at = columns.axis[trees, :2].copy()
    track = nearest_other(at, place, REACH)
    seen = track >= 0
    at[seen] = place[track[seen]]
    free = confirmed & (nearest_other(place, columns.axis[:, :2].copy(), REACH) < 0)
    views = np.where(seen, hits[track] if len(hits) else 0, 0)
    gathered = np.arange(len(at) + np.count_nonzero(free)) < len(at)
    return _Places(np.concatenate([at, place[free]]), np.concatenate([views, hits[free]]), gathered)


def _columns(notes: Notes, p: Parameters) -> Columns | None:
    known = notes.newest_columns()
    return (
        None
        if known is None or p.classification.method == "none"
        else columns_of(known, p.classification.tree_share)
    )


def _with_sample(
    before: _Places, basis: Basis, clusters: ClusterTable, p: Parameters, sample: Mapping[int, SegmentedScan]
) -> _Places:
    """The trees as a sample of scans changes them: who is found less often there has fewer hits, and what is
    found there, and was not, is a tree. What was gathered hangs on no clusters, and stays; but where
    something else is gathered too, it stays as long as anything is found of it."""
    scans = [k for k in sample if k < min(len(basis.notes), len(clusters))]
    fresh = ClusterTable()
    for n, k in enumerate(scans):
        fresh.put(n, sample[k].clusters)
    old, old_hits = _found(basis, scans, clusters.of(scans), p)
    new, new_hits = _found(basis, scans, fresh, p)

    was, now = (
        _sums(nearest_other(place, before.place, REACH), found, len(before.place))
        for place, found in ((old, old_hits), (new, new_hits))
    )
    told = was >= LEAST
    hits = np.where(told, before.hits * now // np.maximum(was, 1), before.hits)
    gathered = before.gathered & (basis.gathers_the_same(p) | (now > 0))
    stays = gathered | ~told | (hits >= p.tracking.hits_to_confirm)

    alone = (new_hits >= LEAST) & (nearest_other(new, before.place, REACH) < 0)
    alone &= nearest_other(new, old, REACH) < 0
    columns = _columns(basis.notes, p)
    if columns is not None:
        alone &= nearest_other(new, columns.axis[:, :2].copy(), REACH) < 0
    return _Places(
        np.concatenate([before.place[stays], new[alone]]),
        np.concatenate([hits[stays], new_hits[alone]]),
        np.concatenate([before.gathered[stays], np.zeros(np.count_nonzero(alone), np.bool_)]),
    )


def _sums(row: Int, hits: Int, rows: int) -> Int:
    """Of the hits of each row; -1 is none."""
    there = row >= 0
    return np.bincount(row[there], hits[there], rows).astype(np.int64)


def _trees(known: _Places) -> Trees:
    place, hits, n = known.place, known.hits, len(known.place)
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
            at = nearest_in(cells, place, x, y, reach, scale)
            if at >= 0:
                take_out(cells, at)
            elif n < most:
                at, n = n, n + 1
                place[at, 0] = place[at, 1] = 0.0
            else:
                continue
            hits[at] += 1
            place[at, 0] += (x - place[at, 0]) / hits[at]
            place[at, 1] += (y - place[at, 1]) / hits[at]
            put_in(cells, place, at, scale)
    return place[:n].copy(), hits[:n].copy()
