"""Judging: which column is which track, and what that makes of it."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Columns, Int, Verdict
from pipeline.tracking.table import TrackTable

ONE_TREE = 0.5  # m; tree columns nearer to one another than this are one tree
REACH = 0.45  # m; a track farther from a column than this is something else


def tree_columns(columns: Columns) -> Int:
    """Rows of the columns that are trees; of those that are one tree the one with most votes."""
    rows = np.flatnonzero(columns.verdict == Verdict.TREE)
    rows = rows[np.argsort(-columns.share[rows, 0], kind="stable")]
    one_each: Int = rows[_apart(columns.axis[rows, :2], ONE_TREE)]
    return one_each


def assign_verdicts(tracks: TrackTable, columns: Columns, trees: Int, due: Bool) -> Int:
    """Give every track the verdict of what stands at its place.

    Each tree column makes one track a tree, the one with most hits in reach. A track that no column
    is near to keeps what it was; where its column is overdue, nothing upright stands there, and its hits
    alone make it no tree.

    Args:
        tracks: Changed in place.
        columns: All of them; trees: rows of those that are trees, best first.
        due: shape (T,): which tracks would have a column by now if they were trees.

    Returns:
        Places in `trees` of those without a track.
    """
    is_tree = np.zeros(len(columns.verdict), np.bool_)
    is_tree[trees] = True
    nearest = nearest_other(tracks.x[:, :2], columns.axis[:, :2], REACH)
    near = nearest >= 0
    verdict = columns.verdict[nearest[near]].astype(np.int64)
    verdict[verdict == Verdict.TREE] = Verdict.OTHER  # another track is that tree, unless told below
    tracks.verdict[near] = verdict
    tracks.verdict[~near & due & (tracks.verdict < 0)] = Verdict.OTHER
    track_of = _track_of(columns.axis[trees, :2], tracks.x[:, :2], tracks.hits, REACH)
    found = track_of >= 0
    tracks.verdict[track_of[found]] = Verdict.TREE
    # What no scan has measured stands where what was gathered stands.
    at = np.flatnonzero(found)
    at = at[tracks.hits[track_of[at]] == 0]
    tracks.x[track_of[at], :2] = columns.axis[trees[at], :2]
    return np.flatnonzero(~found)


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
    """The nearest other place to each, -1 where none is in reach, shape (N,)."""
    nearest = np.full(place.shape[0], -1, np.int64)
    for a in range(place.shape[0]):
        best = reach * reach
        for b in range(other.shape[0]):
            dx, dy = place[a, 0] - other[b, 0], place[a, 1] - other[b, 1]
            if dx * dx + dy * dy < best:
                best, nearest[a] = dx * dx + dy * dy, b
    return nearest


@compiled
def _track_of(place: Float, track: Float, hits: Int, reach: float) -> Int:
    """The free track in reach of each place that has most hits, -1 for none; earlier places choose first."""
    track_of = np.full(place.shape[0], -1, np.int64)
    taken = np.zeros(track.shape[0], np.bool_)
    for a in range(place.shape[0]):
        most = np.int64(-1)
        for b in range(track.shape[0]):
            dx, dy = place[a, 0] - track[b, 0], place[a, 1] - track[b, 1]
            if not taken[b] and hits[b] > most and dx * dx + dy * dy < reach * reach:
                most, track_of[a] = hits[b], b
        if track_of[a] >= 0:
            taken[track_of[a]] = True
    return track_of
