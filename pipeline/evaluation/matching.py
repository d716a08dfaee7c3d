"""One-to-one assignment of mapped trees to the ground truth with the minimum sum of distances."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Int, Trees, TruthTrees


def match(found: Float, truth: Float, distance_max: float) -> Int:
    """Return the row of `truth` that is assigned to each row of `found`, -1 for none, int64, shape (N,).
    Positions that are not finite have no partner; either side may be empty.

    The assignment has the maximum number of pairs within `distance_max`, and among such assignments the
    minimum sum of distances (Kuhn 1955, solved by scipy).

    Args:
        found: Positions, shape (N, 2) [m].
        truth: Positions in the same frame, shape (M, 2) [m].
        distance_max: Maximum distance of a pair [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    truth_of = np.full(len(found), -1, np.int64)
    rows, columns = _near(found, truth, distance_max)
    if not len(rows):
        return truth_of
    # Groups that share no allowed pair are independent problems. Solving them one by one takes milliseconds
    # for thousands of trees; the time for one matrix of all trees grows with the cube of their number.
    size = len(found) + len(truth)
    graph = coo_array((np.ones(len(rows), np.bool_), (rows, columns + len(found))), shape=(size, size))
    _, group_of = connected_components(graph, directed=False)
    group = group_of[rows]
    order = np.argsort(group, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        _solve(found, truth, distance_max, rows[part], columns[part], truth_of)
    return truth_of


def _near(found: Float, truth: Float, distance_max: float) -> tuple[Int, Int]:
    """Return rows of `found` and of `truth` for all pairs within `distance_max` [m], int64, shape (K,) each.
    A position that is not finite has no pair."""
    from scipy.spatial import cKDTree

    mine, others = (np.flatnonzero(np.isfinite(each).all(axis=1)) for each in (found, truth))
    if not len(mine) or not len(others):
        return mine[:0], mine[:0]
    reach = distance_max * (1.0 + 1e-9)  # scipy rounds the distance in another way
    pairs = cKDTree(found[mine]).sparse_distance_matrix(cKDTree(truth[others]), reach, output_type="ndarray")
    rows, columns = mine[pairs["i"]], others[pairs["j"]]
    near = np.hypot(*(found[rows] - truth[columns]).T) <= distance_max
    return rows[near], columns[near]


def _solve(found: Float, truth: Float, distance_max: float, rows: Int, columns: Int, truth_of: Int) -> None:
    """Assign one group of positions, and write the rows of `truth` into `truth_of`.

    Args:
        found, truth: All positions, shape (N, 2) and (M, 2) [m].
        distance_max: Maximum distance of a pair [m].
        rows, columns: Allowed pairs of the group: rows of `found` and of `truth`.
        truth_of: Result, shape (N,), modified in place.
    """
    from scipy.optimize import linear_sum_assignment

    if len(rows) == 1:
        truth_of[rows] = columns
        return
    mine, others = np.unique(rows), np.unique(columns)
    distance = np.hypot(*(found[mine][:, None, :] - truth[others][None, :, :]).transpose(2, 0, 1))
    # One forbidden pair costs more than all allowed pairs together.
    forbidden = (min(len(mine), len(others)) + 1) * distance_max
    chosen, partner = linear_sum_assignment(np.where(distance <= distance_max, distance, forbidden))
    good = distance[chosen, partner] <= distance_max
    truth_of[mine[chosen[good]]] = others[partner[good]]


def matched_rows(trees: Trees, truth: TruthTrees, distance_max: float) -> tuple[Int, Int]:
    """Return the rows of the matched mapped trees in `trees`, and of the real trees in `truth` that they are
    assigned to, int64, shape (K,) each. Pairs with another object of the ground truth are omitted.

    Args:
        trees: The map; confirmed trees are matched.
        truth: Ground truth in the frame of the map.
        distance_max: Maximum distance of a pair [m].
    """
    confirmed = np.flatnonzero(trees.confirmed)
    is_tree = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    position = np.stack([truth.x, truth.y], axis=1)
    truth_of = match(trees.position[confirmed], position, distance_max)
    # Other objects take part in the assignment, as in the scores; their pairs are dropped afterwards.
    good = truth_of >= 0
    good[good] = is_tree[truth_of[good]]
    return confirmed[good], truth_of[good]
