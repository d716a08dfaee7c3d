"""Which tree of the map is which of the ground truth: one to one, with the least sum of distances."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Int, Trees, TruthTrees


def match(found: Float, truth: Float, distance_max: float) -> Int:
    """The row of `truth` for each row of `found`, -1 for none.

    As many pairs within `distance_max` as possible are made, and among such matchings the one with
    the least sum of distances (Kuhn 1955, as scipy solves it).

    Args:
        found, truth: shape (N, 2) and (M, 2) [m], same frame.
        distance_max: [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    truth_of = np.full(len(found), -1, np.int64)
    rows, columns = _near(found, truth, distance_max)
    if not len(rows):
        return truth_of
    # Groups of rows that share no allowed pair are solved apart: the sums add up, and thousands of trees take
    # milliseconds where one matrix of all of them takes the cube of their number.
    size = len(found) + len(truth)
    graph = coo_array((np.ones(len(rows), np.bool_), (rows, columns + len(found))), shape=(size, size))
    _, group_of = connected_components(graph, directed=False)
    group = group_of[rows]
    order = np.argsort(group, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        _solve(found, truth, distance_max, rows[part], columns[part], truth_of)
    return truth_of


def _near(found: Float, truth: Float, distance_max: float) -> tuple[Int, Int]:
    """The rows of the pairs within `distance_max`; what is not finite has no partner."""
    from scipy.spatial import cKDTree

    mine, others = (np.flatnonzero(np.isfinite(each).all(axis=1)) for each in (found, truth))
    if not len(mine) or not len(others):
        return mine[:0], mine[:0]
    reach = distance_max * (1.0 + 1e-9)  # the library's rounding is not ours
    pairs = cKDTree(found[mine]).sparse_distance_matrix(cKDTree(truth[others]), reach, output_type="ndarray")
    rows, columns = mine[pairs["i"]], others[pairs["j"]]
    near = np.hypot(*(found[rows] - truth[columns]).T) <= distance_max
    return rows[near], columns[near]


def _solve(found: Float, truth: Float, distance_max: float, rows: Int, columns: Int, truth_of: Int) -> None:
    """Write the best partners of a group into `truth_of`, given its allowed pairs."""
    from scipy.optimize import linear_sum_assignment

    if len(rows) == 1:
        truth_of[rows] = columns
        return
    mine, others = np.unique(rows), np.unique(columns)
    distance = np.hypot(*(found[mine][:, None, :] - truth[others][None, :, :]).transpose(2, 0, 1))
    # One forbidden pair costs more than all allowed ones together.
    forbidden = (min(len(mine), len(others)) + 1) * distance_max
    chosen, partner = linear_sum_assignment(np.where(distance <= distance_max, distance, forbidden))
    good = distance[chosen, partner] <= distance_max
    truth_of[mine[chosen[good]]] = others[partner[good]]


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
