"""Judging: which column is which track, and what that makes of it."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import (
    Cells,
    cell_of,
    cells_for,
    fill,
    first_of_four,
    nearest_in,
    per_metre,
    put_in,
)
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing, compiled_within
from pipeline.tracking.assignment import by_pose
from pipeline.tracking.round_fit_override import back
from pipeline.tracking.track_table import Rows, begin
from pipeline.tracking.tracking_inputs import Sight
from pipeline.types.records import Bool, Columns, Int, Int32, Verdict

TREE, OTHER = int(Verdict.TREE), int(Verdict.OTHER)
ONE_TREE = 0.5  # m; tree columns nearer to one another than this are one tree
REACH = 0.45  # m; a track farther from a column than this is something else
# m; how near to the axis of its column a trunk's track lies: of those alone in reach 95 of 100 within 16 cm
# in sim:stand and within 12 cm in sim:dense.
OWN = 0.15
BESIDE = 0.7  # m; a tree whose own column is gone is what the column so near is: a person fits no circle well
SCORE_STANDING = 5.0  # at least, of a tree that what was gathered stands for
GATHERED_SIGMA = 0.1  # m; the middle of the returns of one side lies so far before the axis
DUE_NS = 5_000_000_000  # after its first sight a trunk so near has a column: a dozen scans were gathered
DUE_REACH = 10.0  # m
DUE_SHARE = 0.4  # of how far away returns are gathered: what stands farther may have been seen by few scans
GLIMPSE_NS, FORMER_NS = 1_000_000_000, 60_000_000_000  # bounds of being out of sight, see `_is_out_of_sight`


@compiled
def judge(
    rows: Rows,
    count: int,
    number: int,
    sight: Sight,
    place: Float,
    votes: Float,
    verdict: Int32,
    tree_share: float,
    range_max: float,
    velocity_sigma: float,
) -> tuple[int, int]:
    """Take the verdicts of what was gathered: a track is confirmed by them alone, and a tree that no single
    scan showed begins its track here.

    Args:
        rows: The first `count` are tracks, in place, with room for one more a column.
        number: Of the next new tree.
        sight: Of the scan.
        place: Of the columns, x, y first, shape (C, 2 or more) [m]; votes: shape (C, 6); verdict: of the
            votes and the rules, shape (C,): those that the tracks back become trees in place (see `backing`).
        tree_share, range_max: See `ColumnClassifier`.

    Returns:
        The number of tracks, and that of the next new one.
    """
    columns = verdict.shape[0]
    cells, scale = cells_for(columns), per_metre(BESIDE)
    fill(cells, place, columns, scale)
    back(rows, count, cells, scale, place, votes, verdict, tree_share)
    trees = _best_first(place, votes, verdict)
    _learn(rows, count, sight, cells, scale, place, verdict, min(DUE_REACH, DUE_SHARE * range_max))
    fresh = _with_tree(rows, count, place, trees)
    _begin_at(rows, count, number, sight, place, trees[fresh], velocity_sigma)
    count += fresh.shape[0]
    for t in range(count):
        if rows.verdict[t] == TREE:
            rows.score[t] = max(rows.score[t], SCORE_STANDING)
    return count, number + fresh.shape[0]


def tree_columns(columns: Columns) -> Int:
    """Rows of the columns that are trees; of those that are one tree the one with most votes."""
    return _best_first(columns.axis, columns.share, columns.verdict)


@compiled
def _best_first(place: Float, votes: Float, verdict: Int32) -> Int:
    rows, fewest, n = np.empty(verdict.shape[0], np.int64), np.empty(verdict.shape[0]), 0
    for c in range(verdict.shape[0]):
        if verdict[c] == TREE:
            rows[n], fewest[n] = c, -votes[c, 0]
            n += 1
    rows = rows[np.argsort(fewest[:n], kind="mergesort")]
    cells, scale, apart = cells_for(place.shape[0]), per_metre(ONE_TREE), 0
    for k in range(n):
        c = rows[k]
        if nearest_in(cells, place, place[c, 0], place[c, 1], ONE_TREE, scale) < 0:
            put_in(cells, place, c, scale)
            rows[apart] = c
            apart += 1
    best: Int = rows[:apart].copy()
    return best


@compiled_borrowing
def _learn(
    rows: Rows,
    count: int,
    sight: Sight,
    cells: Cells,
    scale: float,
    place: Float,
    verdict: Int32,
    due_reach: float,
) -> None:
    """Give every track the verdict of what stands at its place.

    A track that no column is near to keeps what it was, but a tree does not beside a column of something
    else; where its column is overdue, or it is out of sight, nothing upright stands there, and its hits alone
    make it no tree.
    """
    for t in range(count):
        x, y, known = rows.x[t, 0], rows.x[t, 1], rows.verdict[t]
        near = nearest_in(cells, place, x, y, BESIDE, scale)
        told = np.int64(verdict[near]) if near >= 0 else known
        if near >= 0 and (place[near, 0] - x) ** 2 + (place[near, 1] - y) ** 2 < REACH * REACH:
            rows.verdict[t] = OTHER if told == TREE else told  # another track is that tree, unless told below
        elif known == TREE and near >= 0 and told != TREE:
            rows.verdict[t] = told
        elif known < 0 and (
            _is_due(rows, t, sight, due_reach)
            or _is_out_of_sight(rows.first_ns[t], rows.stamp_ns[t], sight.stamp_ns)
        ):
            rows.verdict[t] = OTHER


@compiled
def learn_between(rows: Rows, count: int, place: Float, verdict: Int32) -> None:
    """Give tracks that nothing was told of yet the verdict of the column that is known at their place:
    between two scans that are gathered their hits alone would make trees of them, beside a column of none.

    Args:
        rows: The first `count` are tracks, in place.
        place: Of the columns, x, y first, shape (C, 2 or more) [m]; verdict: shape (C,), as `judge` left it.
    """
    for t in range(count):
        if rows.verdict[t] >= 0 or rows.hits[t] == 0:
            continue
        nearest, least = -1, REACH * REACH
        for c in range(verdict.shape[0]):
            dx, dy = place[c, 0] - rows.x[t, 0], place[c, 1] - rows.x[t, 1]
            if dx * dx + dy * dy < least:
                nearest, least = c, dx * dx + dy * dy
        if nearest >= 0:
            told = np.int64(verdict[nearest])
            rows.verdict[t] = OTHER if told == TREE else told  # another track is that tree


@compiled_within
def _is_due(rows: Rows, t: int, sight: Sight, reach: float) -> bool:
    """Whether a track would have a column by now if it were a tree."""
    dx, dy = rows.x[t, 0] - sight.pose[0], rows.x[t, 1] - sight.pose[1]
    return bool(dx * dx + dy * dy < reach * reach and sight.stamp_ns - rows.first_ns[t] >= DUE_NS)


@compiled_within
def _is_out_of_sight(first_ns: int, last_ns: int, now_ns: int) -> bool:
    """Whether a track has not been seen for longer than it had been seen, as who walked on has not. At least
    a second and at most as long as a column takes; what was last seen long ago is of another drive, or was
    put back by a loop, and nobody walked there."""
    unseen = now_ns - last_ns
    return min(max(last_ns - first_ns, GLIMPSE_NS), DUE_NS) < unseen < FORMER_NS


@compiled
def _with_tree(rows: Rows, count: int, place: Float, trees: Int) -> Int:
    """Make one track of each tree column a tree, the likeliest free one in reach; the best columns choose
    first.

    Returns:
        Places in `trees` of those without a track.
    """
    taken, fresh, n = np.zeros(count, np.bool_), np.empty(trees.shape[0], np.int64), 0
    cells, scale = cells_for(count), per_metre(REACH)
    fill(cells, rows.x, count, scale)
    at = np.empty(trees.shape[0], np.int64)
    for k in range(trees.shape[0]):
        c = trees[k]
        at[k] = _likeliest(rows, taken, cells, scale, place[c, 0], place[c, 1])
        if at[k] >= 0:
            taken[at[k]] = True
        else:
            fresh[n] = k
            n += 1
    for k in range(trees.shape[0]):
        t, c = at[k], trees[k]
        if t < 0:
            continue
        rows.verdict[t] = TREE
        if rows.hits[t] == 0:  # what no scan has measured stands where what was gathered stands
            rows.x[t, 0], rows.x[t, 1] = place[c, 0], place[c, 1]
    found: Int = fresh[:n].copy()
    return found


@compiled_within
def _likeliest(rows: Rows, taken: Bool, cells: Cells, scale: float, x: float, y: float) -> int:
    """The free track in reach of a column's axis that is its likeliest, by hits and distance d, the first row
    of equals, -1 for none:

    (1 + ln(1 + hits)) exp(-d^2 / (2 OWN^2))

    Hits alone would give a stem in undergrowth the branches beside it, seen before it and as often.
    """
    u, v = first_of_four(x, y, scale)
    most, best = 0.0, np.int64(-1)
    for quarter in range(4):
        t = np.int64(cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))])
        while t >= 0:
            dx, dy = x - rows.x[t, 0], y - rows.x[t, 1]
            square = dx * dx + dy * dy
            if not taken[t] and square < REACH * REACH:
                likely = (1.0 + np.log(1.0 + rows.hits[t])) * np.exp(-0.5 * square / (OWN * OWN))
                if likely > most or (likely == most and t < best):
                    most, best = likely, t
            t = np.int64(cells.following[t])
    return int(best)


@compiled
def _begin_at(
    rows: Rows, count: int, number: int, sight: Sight, place: Float, trees: Int, velocity_sigma: float
) -> None:
    """Begin the tracks of tree columns, by their rows."""
    z, R = np.empty((trees.shape[0], 2)), np.zeros((trees.shape[0], 2, 2))
    B = np.empty((trees.shape[0], 2, 2))
    for k in range(trees.shape[0]):
        z[k, 0], z[k, 1] = place[trees[k], 0], place[trees[k], 1]
        R[k, 0, 0] = R[k, 1, 1] = GATHERED_SIGMA * GATHERED_SIGMA
        xx, xy, yy = by_pose(z[k, 0] - sight.pose[0], z[k, 1] - sight.pose[1], sight.covariance)
        B[k, 0, 0], B[k, 0, 1], B[k, 1, 0], B[k, 1, 1] = xx, xy, xy, yy
    begin(rows, count, number, sight.stamp_ns, z, R, B, velocity_sigma)
    for k in range(trees.shape[0]):
        rows.verdict[count + k] = TREE


@compiled
def nearest_other(place: Float, other: Float, reach: float) -> Int:
    """The nearest other place to each, the first of equals; -1 where none is in reach; shape (N,)."""
    nearest = np.empty(place.shape[0], np.int64)
    cells, scale = cells_for(other.shape[0]), per_metre(reach)
    fill(cells, other, other.shape[0], scale)
    for a in range(place.shape[0]):
        nearest[a] = nearest_in(cells, other, place[a, 0], place[a, 1], reach, scale)
    return nearest
