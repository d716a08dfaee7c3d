"""Which tree of the map is which of the ground truth: one to one, with the least sum of distances."""

from __future__ import annotations

import numpy as np

from pipeline.geometry import Float
from pipeline.records import Int, Trees, TruthTrees


def match(found: Float, truth: Float, distance_max: float) -> Int:
    """The row of `truth` for each row of `found`, -1 for none.

    As many pairs within `distance_max` as possible are made, and among such matchings the one with
    the least sum of distances (Kuhn 1955, as scipy solves it).

    Args:
        found, truth: shape (N, 2) and (M, 2) [m], same frame.
        distance_max: [m].
    """
    from scipy.optimize import linear_sum_assignment

    truth_of = np.full(len(found), -1, np.int64)
    if len(found) == 0 or len(truth) == 0:
        return truth_of
    distance = np.hypot(*(found[:, None, :] - truth[None, :, :]).transpose(2, 0, 1))
    # One forbidden pair costs more than all allowed ones together.
    forbidden = (min(len(found), len(truth)) + 1) * distance_max
    rows, columns = linear_sum_assignment(np.where(distance <= distance_max, distance, forbidden))
    good = distance[rows, columns] <= distance_max
    truth_of[rows[good]] = columns[good]
    return truth_of


def matched_rows(trees: Trees, truth: TruthTrees, distance_max: float) -> tuple[Int, Int]:
    """Rows of `trees` (confirmed ones) and of `truth` (of kind tree) that are the same tree."""
    confirmed = np.flatnonzero(trees.confirmed)
    is_tree = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    position = np.stack([truth.x, truth.y], axis=1)
    truth_of = match(trees.position[confirmed], position, distance_max)
    # A pole takes its match too, as in the scores; what is left are trees that are trees.
    good = truth_of >= 0
    good[good] = is_tree[truth_of[good]]
    return confirmed[good], truth_of[good]
