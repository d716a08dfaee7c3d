"""Backing: what single scans fitted as a round trunk from most sides is upright and round, whatever the votes
on its column say. Of trees, poles and persons that tells nothing, of bushes and walls that they are none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import CLASSES, Bool, Columns, Int, Verdict
from pipeline.tracking.observation import SECTORS
from pipeline.tracking.table import TrackTable

REACH = 0.25  # m; a column's axis lies so near to the trunk that it is of
FITS = 20  # circles of single scans
SIDES = SECTORS // 2  # that they were seen on
ROUND = np.array([kind in (Verdict.TREE, Verdict.POLE, Verdict.PERSON) for kind in CLASSES])
#: What the votes for all else count at a place that is round: so seldom is it anything else (docs/trunks.md).
LEFT = 0.1
TREE = CLASSES.index(Verdict.TREE)


def backed(columns: Columns, tracks: TrackTable, tree_share: float) -> Columns:
    """The columns, of which those that single scans back are trees: v_tree / (v_round + 0.1 v_else) is at
    least `tree_share`, with the shares v of the votes, and neither poles nor persons have more than trees.

    Args:
        columns: With the verdicts of the votes and of the rules; what moved or is too few voxels stays so.
        tracks: In the same frame.
        tree_share: See `Gathering`.
    """
    voted = np.isin(columns.verdict, CLASSES) & (columns.verdict != Verdict.TREE)
    share = columns.share[:, TREE] / np.maximum(columns.share @ np.where(ROUND, 1.0, LEFT), 1e-9)
    leads = columns.share[:, TREE] >= columns.share[:, ROUND].max(axis=1)
    doubtful = np.flatnonzero(voted & leads & (share >= tree_share))
    round_tracks = np.flatnonzero(tracks.radii >= FITS)
    if not len(doubtful) or not len(round_tracks):
        return columns
    found = _near_round(
        columns.axis[doubtful, :2], tracks.x[round_tracks, :2], tracks.sides[round_tracks], REACH, SIDES
    )
    verdict = columns.verdict.copy()
    verdict[doubtful[found]] = Verdict.TREE
    return replace(columns, verdict=verdict)


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
