"""Merging: trees nearer to one another than `proximity_radius` are one tree."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import Cells, cell_of, cells_for, fill, first_of_four, per_metre
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.tracking.split_covariance_intersection import split
from pipeline.tracking.track_table import Rows, TrackTable
from pipeline.types.records import Bool, Verdict


@compiled
def merge_near(rows: Rows, touched: Bool, radius: float) -> Bool:
    """Join every touched tree with older ones within the radius; the older number stays.

    Args:
        rows: In the order of their numbers; the joined ones change in place.
        touched: shape (T,), of the first rows: trees that moved; two that rest cannot come nearer.
        radius: [m]; 0 joins nothing.

    Returns:
        Which rows are still trees of their own, shape (T,).
    """
    alive = np.ones(touched.shape[0], np.bool_)
    while radius > 0.0:
        cells, scale = cells_for(touched.shape[0]), per_metre(radius)
        fill(cells, rows.x, touched.shape[0], scale)
        old, young = _first_pair(rows.x, touched, alive, radius, cells, scale)
        if old < 0:
            break
        _join(rows, old, young)
        alive[young] = False
        touched[old] = True
    return alive


def join(tracks: TrackTable, old: int, young: int) -> None:
    """Add to a tree, by its row, what is known of another row of the same tree, which is left as it is."""
    _join(tracks.as_rows(), old, young)


@compiled_borrowing
def _first_pair(
    x: Float, touched: Bool, alive: Bool, radius: float, cells: Cells, scale: float
) -> tuple[int, int]:
    """Rows of two trees nearer than the radius, one of which was touched, the first of all; -1 for none."""
    for i in range(touched.shape[0]):
        if not (touched[i] and alive[i]):
            continue
        first = -1
        u, v = first_of_four(x[i, 0], x[i, 1], scale)
        for quarter in range(4):
            j = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while j >= 0:
                dx, dy = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
                near = j != i and alive[j] and dx * dx + dy * dy < radius * radius
                # One before it that was touched has looked at this one already.
                if near and (j > i or not touched[j]) and (first < 0 or j < first):
                    first = j
                j = cells.following[j]
        if first >= 0:
            return min(i, first), max(i, first)
    return -1, -1


@compiled
def _join(rows: Rows, old: int, young: int) -> None:
    x, P, shared, stamp_ns, first_ns = rows.x, rows.P, rows.shared, rows.stamp_ns, rows.first_ns
    hits, score, sides, verdict = rows.hits, rows.score, rows.sides, rows.verdict
    # Two halves of one trunk in one scan; a tree that only its column tells of has no view to take off. In
    # how many scans before this one both halves were seen is not kept, and they count for both.
    if stamp_ns[old] == stamp_ns[young] and min(hits[old], hits[young]) > 0:
        hits[old] -= 1
    row, own, common = np.array([old]), np.empty((1, 2, 2)), np.empty((1, 2, 2))
    for a in range(2):
        for b in range(2):
            own[0, a, b], common[0, a, b] = P[young, a, b] - shared[young, a, b], shared[young, a, b]
    other = split(P, shared, row, own, common, np.zeros(1), 0.0)[0]
    place, joined = fuse(x[old], P[old], x[young], other)
    for a in range(4):
        x[old, a] = place[a]
        for b in range(4):
            P[old, a, b] = joined[a, b]
    stamp_ns[old] = max(stamp_ns[old], stamp_ns[young])
    first_ns[old] = min(first_ns[old], first_ns[young])
    score[old] = max(score[old], score[young])
    sides[old] |= sides[young]
    # A piece that was begun in this scan has no verdict yet, and must not take that of the whole away.
    if verdict[young] == Verdict.TREE or verdict[old] < 0:
        verdict[old] = verdict[young]
    hits[old] += hits[young]
    for total in (rows.eccentricity, rows.radius, rows.radius_weight, rows.radius_reach, rows.radius_above):
        total[old] += total[young]
    for number in (rows.eccentricities, rows.radii):
        number[old] += number[young]


@compiled
def fuse(x: Float, P: Float, other_x: Float, other_P: Float) -> tuple[Float, Float]:
    """The best of two independent estimates of the measured part of the state (position).

    The velocity of the first is kept: two still trees say nothing new about it. With S = P + Q of the
    positions, K = P[:, :2] S^-1, and P becomes (I - K H) P (I - K H)^T + K Q K^T.
    """
    S00, S01 = P[0, 0] + other_P[0, 0], P[0, 1] + other_P[0, 1]
    S10, S11 = P[1, 0] + other_P[1, 0], P[1, 1] + other_P[1, 1]
    det = S00 * S11 - S01 * S10
    K, M = np.empty((4, 2)), np.empty((4, 4))
    place = np.empty(4)
    y0, y1 = other_x[0] - x[0], other_x[1] - x[1]
    for a in range(4):
        K[a, 0] = (P[a, 0] * S11 - P[a, 1] * S10) / det
        K[a, 1] = (P[a, 1] * S00 - P[a, 0] * S01) / det
        place[a] = x[a] + K[a, 0] * y0 + K[a, 1] * y1
    for a in range(4):
        for b in range(4):
            M[a, b] = P[a, b] - K[a, 0] * P[0, b] - K[a, 1] * P[1, b]
    joined = np.empty((4, 4))
    for a in range(4):
        for b in range(a, 4):
            KQ0 = K[a, 0] * other_P[0, 0] + K[a, 1] * other_P[1, 0]
            KQ1 = K[a, 0] * other_P[0, 1] + K[a, 1] * other_P[1, 1]
            joined[a, b] = M[a, b] - M[a, 0] * K[b, 0] - M[a, 1] * K[b, 1] + KQ0 * K[b, 0] + KQ1 * K[b, 1]
            joined[b, a] = joined[a, b]
    return place, joined
