"""Merging: trees nearer to one another than `proximity_radius` are one tree."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Bool, Verdict
from pipeline.tracking.shared import split
from pipeline.tracking.table import TrackTable


def merge_near(tracks: TrackTable, touched: Bool, radius: float) -> TrackTable:
    """Join every touched tree with older ones within the radius; the older number stays.

    Args:
        tracks: Rows in the order of their numbers.
        touched: shape (T,): trees that moved; two that rest cannot come nearer.
        radius: [m].
    """
    if radius <= 0.0:
        return tracks
    alive = np.ones(len(tracks), np.bool_)
    while True:
        old, young = _first_pair(tracks.x, touched, alive, radius)
        if old < 0:
            return tracks if alive.all() else tracks.take(alive)
        join(tracks, old, young)
        alive[young] = False
        touched[old] = True


@compiled
def _first_pair(x: Float, touched: Bool, alive: Bool, radius: float) -> tuple[int, int]:
    """Rows of two trees nearer than the radius, one of which was touched; -1, -1 for none."""
    for i in range(x.shape[0]):
        if not (touched[i] and alive[i]):
            continue
        for j in range(x.shape[0]):
            dx, dy = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1]
            if j != i and alive[j] and dx * dx + dy * dy < radius * radius:
                return min(i, j), max(i, j)
    return -1, -1


def join(tracks: TrackTable, old: int, young: int) -> None:
    """Add to a tree, by its row, what is known of another row of the same tree, which is left as it is."""
    # Two halves of one trunk in one scan; a tree that only its column tells of has no view to take off.
    if tracks.stamp_ns[old] == tracks.stamp_ns[young] and min(tracks.hits[old], tracks.hits[young]) > 0:
        tracks.hits[old] -= 1
    other, row = tracks.P[young].copy(), np.array([old])
    own = other[None, :2, :2] - tracks.shared[young]
    other[:2, :2] = split(tracks.P, tracks.shared, row, own, tracks.shared[[young]], np.zeros(1), 0.0)[0]
    tracks.x[old], tracks.P[old] = fuse(tracks.x[old], tracks.P[old], tracks.x[young], other)
    tracks.stamp_ns[old] = max(tracks.stamp_ns[old], tracks.stamp_ns[young])
    tracks.first_ns[old] = min(tracks.first_ns[old], tracks.first_ns[young])
    tracks.score[old] = max(tracks.score[old], tracks.score[young])
    tracks.sides[old] |= tracks.sides[young]
    if tracks.verdict[old] != Verdict.TREE:
        tracks.verdict[old] = tracks.verdict[young]
    for column in (
        tracks.hits,
        tracks.eccentricity,
        tracks.eccentricities,
        tracks.radius,
        tracks.radius_weight,
        tracks.radius_reach,
        tracks.radii,
    ):
        column[old] += column[young]


def fuse(x: Float, P: Float, other_x: Float, other_P: Float) -> tuple[Float, Float]:
    """The best of two independent estimates of the measured part of the state (position).

    The velocity of the first is kept: two still trees say nothing new about it.
    """
    x, P = x.copy(), P.copy()
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + other_P[:2, :2])
    I_KH = np.eye(4)
    I_KH[:, :2] -= K
    return x + K @ (other_x[:2] - x[:2]), I_KH @ P @ I_KH.T + K @ other_P[:2, :2] @ K.T
