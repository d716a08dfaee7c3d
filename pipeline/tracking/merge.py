"""Merging: trees nearer to one another than `proximity_radius` are one tree."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Int, Verdict
from pipeline.tracking.shared import split
from pipeline.tracking.table import TrackTable

# Of a table, all that a merged row is made of; numbers stay.
_Columns = tuple[
    Float, Float, Float, Int, Int, Int, Float, Float, Int, Float, Float, Float, Float, Int, Int, Int
]  # fmt: skip


def merge_near(tracks: TrackTable, touched: Bool, radius: float) -> TrackTable:
    """Join every touched tree with older ones within the radius; the older number stays.

    Args:
        tracks: Rows in the order of their numbers.
        touched: shape (T,): trees that moved; two that rest cannot come nearer.
        radius: [m].
    """
    if radius <= 0.0:
        return tracks
    alive = _merge(_columns(tracks), touched, radius)
    return tracks if alive.all() else tracks.take(alive)


def join(tracks: TrackTable, old: int, young: int) -> None:
    """Add to a tree, by its row, what is known of another row of the same tree, which is left as it is."""
    _join(_columns(tracks), old, young)


def _columns(t: TrackTable) -> _Columns:
    return (
        t.x, t.P, t.shared, t.stamp_ns, t.first_ns, t.hits, t.score, t.eccentricity, t.eccentricities,
        t.radius, t.radius_weight, t.radius_reach, t.radius_above, t.radii, t.sides, t.verdict,
    )  # fmt: skip


@compiled
def _merge(columns: _Columns, touched: Bool, radius: float) -> Bool:
    """Which rows are still trees of their own, shape (T,)."""
    alive = np.ones(touched.shape[0], np.bool_)
    while _is_any_near(columns[0], touched, alive, radius):
        old, young = _first_pair(columns[0], touched, alive, radius)
        _join(columns, old, young)
        alive[young] = False
        touched[old] = True
    return alive


@compiled
def _is_any_near(x: Float, touched: Bool, alive: Bool, radius: float) -> bool:
    """Whether `_first_pair` finds any: from left to right each tree is held to the next ones alone."""
    along = x[:, 0].copy()
    order = np.argsort(along)
    for a in range(order.shape[0]):
        i = order[a]
        for b in range(a + 1, order.shape[0]):
            j = order[b]
            dx, dy = along[j] - along[i], x[j, 1] - x[i, 1]
            if not dx < radius:
                break
            near = dx * dx + dy * dy < radius * radius
            if near and alive[i] and alive[j] and (touched[i] or touched[j]):
                return True
    return False


@compiled
def _first_pair(x: Float, touched: Bool, alive: Bool, radius: float) -> tuple[int, int]:
    """Rows of two trees nearer than the radius, one of which was touched, the first of all."""
    for i in range(x.shape[0]):
        if not (touched[i] and alive[i]):
            continue
        for j in range(x.shape[0]):
            dx, dy = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
            # One before it that was touched has looked at this one already.
            near = dx * dx + dy * dy < radius * radius
            if near and j != i and alive[j] and (j > i or not touched[j]):
                return min(i, j), max(i, j)
    return -1, -1


@compiled
def _join(columns: _Columns, old: int, young: int) -> None:
    x, P, shared, stamp_ns, first_ns, hits, score, eccentricity, eccentricities = columns[:9]
    radius, radius_weight, radius_reach, radius_above, radii, sides, verdict = columns[9:]
    # Two halves of one trunk in one scan; a tree that only its column tells of has no view to take off.
    if stamp_ns[old] == stamp_ns[young] and min(hits[old], hits[young]) > 0:
        hits[old] -= 1
    other, row = P[young].copy(), np.array([old])
    own, common = np.empty((1, 2, 2)), np.empty((1, 2, 2))
    for a in range(2):
        for b in range(2):
            own[0, a, b], common[0, a, b] = other[a, b] - shared[young, a, b], shared[young, a, b]
    other[:2, :2] = split(P, shared, row, own, common, np.zeros(1), 0.0)[0]
    x[old], P[old] = fuse(x[old], P[old], x[young], other)
    stamp_ns[old] = max(stamp_ns[old], stamp_ns[young])
    first_ns[old] = min(first_ns[old], first_ns[young])
    score[old] = max(score[old], score[young])
    sides[old] |= sides[young]
    # A piece that was begun in this scan has no verdict yet, and must not take that of the whole away.
    if verdict[young] == Verdict.TREE or verdict[old] < 0:
        verdict[old] = verdict[young]
    hits[old] += hits[young]
    eccentricity[old] += eccentricity[young]
    eccentricities[old] += eccentricities[young]
    radius[old] += radius[young]
    radius_weight[old] += radius_weight[young]
    radius_reach[old] += radius_reach[young]
    radius_above[old] += radius_above[young]
    radii[old] += radii[young]


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
