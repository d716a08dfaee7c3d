"""Backing: what single scans fitted as a round trunk from most sides is upright and round, whatever the votes
on its column say. Of trees, poles and persons that tells nothing, of bushes and walls that they are none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import AT_ROUND, CLASSES, Bool, Columns, Int, Int32, Verdict
from pipeline.tracking.observation import SECTORS
from pipeline.tracking.table import TrackTable

REACH = 0.25  # m; a column's axis lies so near to the trunk that it is of
FITS = 20  # circles of single scans
SIDES = SECTORS // 2  # that they were seen on
TREE = CLASSES.index(Verdict.TREE)
_KINDS, _AT_ROUND = np.array(CLASSES, np.int64), np.array(AT_ROUND)


def backed(columns: Columns, tracks: TrackTable, tree_share: float) -> Columns:
    """The columns, of which those that single scans back are trees: v_tree / (v_round + 0.1 v_else) is at
    least `tree_share`, with the shares v of the votes, and neither poles nor persons have more than trees.

    Args:
        columns: With the verdicts of the votes and of the rules; what moved or is too few voxels stays so.
        tracks: In the same frame.
        tree_share: See `Gathering`.
    """
    round_tracks = np.flatnonzero(tracks.radii >= FITS)
    if not len(round_tracks):
        return columns
    doubtful = _doubtful(columns.share, columns.verdict, _KINDS, _AT_ROUND, tree_share)
    if not len(doubtful):
        return columns
    found = _near_round(
        columns.axis[doubtful, :2], tracks.x[round_tracks, :2], tracks.sides[round_tracks], REACH, SIDES
    )
    verdict = columns.verdict.copy()
    verdict[doubtful[found]] = Verdict.TREE
    return replace(columns, verdict=verdict)


@compiled
def _doubtful(share: Float, verdict: Int32, kinds: Int, at_round: Float, tree_share: float) -> Int:
    """Rows of the columns that the votes alone refuse, and that would be trees were they round."""
    rows, n = np.empty(verdict.shape[0], np.int64), 0
    for c in range(verdict.shape[0]):
        voted = False
        for k in range(kinds.shape[0]):
            voted = voted or (verdict[c] == kinds[k] and k != TREE)
        if not voted:
            continue
        below, most = 0.0, 0.0
        for k in range(kinds.shape[0]):
            below += share[c, k] * at_round[k]
            if at_round[k] == 1.0:
                most = max(most, share[c, k])
        if share[c, TREE] >= most and share[c, TREE] / max(below, 1e-9) >= tree_share:
            rows[n] = c
            n += 1
    return rows[:n].copy()


@compiled
def _near_round(place: Float, track: Float, sides: Int, reach: float, least: int) -> Bool:
    """Whether a track that was seen on so many sides stands within reach of each place."""
    near = np.zeros(place.shape[0], np.bool_)
    for b in range(track.shape[0]):
        left, seen = sides[b], 0
        while left:
            left &= left - 1  # takes the lowest bit away
            seen += 1
        if seen < least:
            continue
        for a in range(place.shape[0]):
            dx, dy = place[a, 0] - track[b, 0], place[a, 1] - track[b, 1]
            near[a] = near[a] or dx * dx + dy * dy < reach * reach
    return near
