"""Judging: which column is which track, and what that makes of it."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Columns, Int, Int32, Verdict
from pipeline.tracking.table import TrackTable

TREE, OTHER = int(Verdict.TREE), int(Verdict.OTHER)
ONE_TREE = 0.5  # m; tree columns nearer to one another than this are one tree
REACH = 0.45  # m; a track farther from a column than this is something else
BESIDE = 0.7  # m; a tree whose own column is gone is what the column so near is: a person fits no circle well


def tree_columns(columns: Columns) -> Int:
    """Rows of the columns that are trees; of those that are one tree the one with most votes."""
    return _best_first(columns.axis, columns.share, columns.verdict)


@compiled
def _best_first(axis: Float, share: Float, verdict: Int32) -> Int:
    rows, votes, n = np.empty(verdict.shape[0], np.int64), np.empty(verdict.shape[0]), 0
    for c in range(verdict.shape[0]):
        if verdict[c] == TREE:
            rows[n], votes[n] = c, -share[c, 0]
            n += 1
    rows = rows[np.argsort(votes[:n], kind="mergesort")]
    place = np.empty((rows.shape[0], 2))
    for k in range(rows.shape[0]):
        place[k, 0], place[k, 1] = axis[rows[k], 0], axis[rows[k], 1]
    best: Int = rows[_apart(place, ONE_TREE)]
    return best


def assign_verdicts(tracks: TrackTable, columns: Columns, trees: Int, due: Bool) -> Int:
    """Give every track the verdict of what stands at its place.

    Each tree column makes one track a tree, the one with most hits in reach. A track that no column
    is near to keeps what it was, but a tree does not beside a column of something else; where its column is
    overdue, nothing upright stands there, and its hits alone make it no tree.

    Args:
        tracks: Changed in place.
        columns: All of them; trees: rows of those that are trees, best first.
        due: shape (T,): which tracks would have a column by now if they were trees, or be in sight.

    Returns:
        Places in `trees` of those without a track.
    """
    return _assigned(
        tracks.x, tracks.hits, tracks.verdict, columns.axis, columns.verdict, trees, due, REACH, BESIDE
    )  # fmt: skip


@compiled
def _assigned(
    x: Float,
    hits: Int,
    verdict: Int,
    axis: Float,
    of_column: Int32,
    trees: Int,
    due: Bool,
    reach: float,
    beside: float,
) -> Int:
    nearest, farther = nearest_other(x, axis, reach), nearest_other(x, axis, beside)
    for t in range(x.shape[0]):
        if nearest[t] >= 0:
            told = np.int64(of_column[nearest[t]])
            # Another track is that tree, unless told below.
            verdict[t] = OTHER if told == TREE else told
        elif verdict[t] == TREE and farther[t] >= 0 and of_column[farther[t]] != TREE:
            verdict[t] = of_column[farther[t]]
        elif due[t] and verdict[t] < 0:
            verdict[t] = OTHER
    place = np.empty((trees.shape[0], 2))
    for k in range(trees.shape[0]):
        place[k, 0], place[k, 1] = axis[trees[k], 0], axis[trees[k], 1]
    track_of = _track_of(place, x, hits, reach)
    for k in range(trees.shape[0]):
        t = track_of[k]
        if t < 0:
            continue
        verdict[t] = TREE
        if hits[t] == 0:  # what no scan has measured stands where what was gathered stands
            x[t, 0], x[t, 1] = place[k, 0], place[k, 1]
    return np.flatnonzero(track_of < 0)


@compiled
def _apart(place: Float, distance: float) -> Bool:
    """Which places are not within a distance of an earlier one that is kept, shape (N,)."""
    kept = np.zeros(place.shape[0], np.bool_)
    for a in range(place.shape[0]):
        kept[a] = True
        for b in range(a):
            dx, dy = place[a, 0] - place[b, 0], place[a, 1] - place[b, 1]
            if kept[b] and dx * dx + dy * dy < distance * distance:
                kept[a] = False
                break
    return kept


@compiled
def nearest_other(place: Float, other: Float, reach: float) -> Int:
    """The nearest other place to each, the first of equals; -1 where none is in reach; shape (N,)."""
    nearest = np.full(place.shape[0], -1, np.int64)
    order, along = _from_left(other)
    for a in range(place.shape[0]):
        best = reach * reach
        for k in range(np.searchsorted(along, place[a, 0] - reach), along.shape[0]):
            b = order[k]
            dx, dy = place[a, 0] - other[b, 0], place[a, 1] - other[b, 1]
            if -dx > reach:
                break
            d = dx * dx + dy * dy
            if d < best or (d == best and b < nearest[a]):
                best, nearest[a] = d, b
    return nearest


@compiled
def _track_of(place: Float, track: Float, hits: Int, reach: float) -> Int:
    """The free track in reach of each place that has most hits, the first of equals, -1 for none; earlier
    places choose first."""
    track_of = np.full(place.shape[0], -1, np.int64)
    taken = np.zeros(track.shape[0], np.bool_)
    order, along = _from_left(track)
    for a in range(place.shape[0]):
        most = np.int64(-1)
        for k in range(np.searchsorted(along, place[a, 0] - reach), along.shape[0]):
            b = order[k]
            dx, dy = place[a, 0] - track[b, 0], place[a, 1] - track[b, 1]
            if -dx > reach:
                break
            more = hits[b] > most or (hits[b] == most and b < track_of[a])
            if not taken[b] and more and dx * dx + dy * dy < reach * reach:
                most, track_of[a] = hits[b], b
        if track_of[a] >= 0:
            taken[track_of[a]] = True
    return track_of


@compiled
def _from_left(place: Float) -> tuple[Int, Float]:
    """Rows by their x, and these, so that only those near to a place are looked at."""
    along = np.empty(place.shape[0])
    for k in range(place.shape[0]):
        along[k] = place[k, 0]
    order = np.argsort(along)
    return order, along[order]
