"""Backing: what single scans fitted as a round trunk from most sides is upright and round, whatever the votes
on its column say. Of trees, poles and persons that tells nothing, of bushes and walls that they are none.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import Cells, cell_of, first_of_four
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_borrowing, compiled_within
from pipeline.tracking.observation import SECTORS, sides_of
from pipeline.tracking.track_table import Rows
from pipeline.types.records import AT_ROUND, CLASSES, Int32, Verdict

REACH = 0.25  # m; a column's axis lies so near to the trunk that it is of
FITS = 20  # circles of single scans
SIDES = SECTORS // 2  # that they were seen on
TREE, TREE_VOTES = int(Verdict.TREE), CLASSES.index(Verdict.TREE)
_KINDS, _AT_ROUND = np.array(CLASSES, np.int64), np.array(AT_ROUND)


@compiled_borrowing
def back(
    rows: Rows,
    count: int,
    cells: Cells,
    scale: float,
    place: Float,
    votes: Float,
    verdict: Int32,
    tree_share: float,
) -> None:
    """Make trees of the columns that single scans back: v_tree / (v_round + 0.1 v_else) is at least
    `tree_share`, with the shares v of the votes, and neither poles nor persons have more than trees.

    Args:
        rows: Tracks in the same frame, the first `count`.
        cells: Of the columns, `scale` of them a metre, for searches of `REACH` at least.
        place: Of the columns, x, y first, shape (C, 2 or more) [m]; votes: shape (C, 6); verdict: of the
            votes and the rules, shape (C,), in place; what moved or is too few voxels stays so.
        tree_share: See `ColumnClassifier`.
    """
    for t in range(count):
        if rows.radii[t] < FITS or sides_of(rows.sides[t]) < SIDES:
            continue
        x, y = rows.x[t, 0], rows.x[t, 1]
        u, v = first_of_four(x, y, scale)
        for quarter in range(4):
            c = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while c >= 0:
                dx, dy = place[c, 0] - x, place[c, 1] - y
                near = dx * dx + dy * dy < REACH * REACH
                if near and _would_be_a_tree(votes[c], verdict[c], tree_share):
                    verdict[c] = TREE
                c = cells.following[c]


@compiled_within
def _would_be_a_tree(votes: Float, verdict: int, tree_share: float) -> bool:
    """Whether the votes alone refuse a column that is a tree if it is round."""
    voted, below, most = False, 0.0, 0.0
    for k in range(_KINDS.shape[0]):
        voted = voted or (verdict == _KINDS[k] and k != TREE_VOTES)
        below += votes[k] * _AT_ROUND[k]
        if _AT_ROUND[k] == 1.0:
            most = max(most, votes[k])
    return voted and votes[TREE_VOTES] >= most and votes[TREE_VOTES] / max(below, 1e-9) >= tree_share
