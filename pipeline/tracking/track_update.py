"""What one scan makes of the trees (Eq. 10, 12), in two halves: the filters themselves stand between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.tracking.assignment import assign
from pipeline.tracking.landmark_anchoring import anchor
from pipeline.tracking.merge import merge_near
from pipeline.tracking.observation import add_observations
from pipeline.tracking.split_covariance_intersection import split
from pipeline.tracking.track_table import Rows, begin, keep
from pipeline.tracking.tracking_inputs import Found, Limits, Sight
from pipeline.types.records import Bool, Int

SCORE_MAX = 20.0  # so that a tree that was felled vanishes in finite time
NANOSECONDS = 1e-9


class Recognised(NamedTuple):
    """What `recognise` found.

    Attributes:
        row: The tree of each detection, -1 for none, shape (D,); touched: which trees have one, shape (T,).
        position: Detections in the frame of the map, shape (D, 2) [m]; own: their own covariances; added: by
            the pose, shape (D, 2, 2).
        seen: Rows of the trees that the filter corrects, shape (K,); dt: since they were seen last [s], shape
            (K,); z: their positions now, shape (K, 2); R: covariances of these, shape (K, 2, 2).
    """

    row: Int
    touched: Bool
    position: Float
    own: Float
    added: Float
    seen: Int
    dt: Float
    z: Float
    R: Float


@compiled
def recognise(rows: Rows, count: int, sight: Sight, found: Found, limits: Limits) -> Recognised:
    """Which detection is which tree, and what the filter of each is to be told.

    Args:
        rows: The first `count` are trees, in place: what is not seen in free view loses of its score, and
            covariances are made ready for the filter's update.
    """
    row_of, touched, position, own, added = assign(rows, count, sight, found, limits)
    known = _places(row_of, True)
    z, R, B = _picked(known, position, own, added)
    seen, dt = np.empty(known.shape[0], np.int64), np.empty(known.shape[0])
    for k in range(known.shape[0]):
        seen[k] = row_of[known[k]]
        dt[k] = (sight.stamp_ns - rows.stamp_ns[seen[k]]) * NANOSECONDS
    R = split(rows.P, rows.shared, seen, R, B, dt, limits.acceleration_sigma)
    return Recognised(row_of, touched, position, own, added, seen, dt, z, R)


@compiled
def _places(row_of: Int, known: bool) -> Int:
    """The detections that have a tree, or those that have none."""
    places, n = np.empty(row_of.shape[0], np.int64), 0
    for d in range(row_of.shape[0]):
        if (row_of[d] >= 0) == known:
            places[n] = d
            n += 1
    return places[:n]


@compiled
def _picked(places: Int, position: Float, own: Float, added: Float) -> tuple[Float, Float, Float]:
    """The rows of some detections."""
    n = places.shape[0]
    z, R, B = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 2, 2))
    for k in range(n):
        for a in range(2):
            z[k, a] = position[places[k], a]
            for b in range(2):
                R[k, a, b], B[k, a, b] = own[places[k], a, b], added[places[k], a, b]
    return z, R, B


@compiled
def take(
    rows: Rows, count: int, number: int, sight: Sight, found: Found, of: Recognised, limits: Limits
) -> tuple[int, int]:
    """Trees once the filter was told what was recognised: the others begin, all are counted, what came to
    stand at one place is one, and what lost its score goes.

    Args:
        rows: The first `count` are trees, with room for one more a detection.
        number: Of the next new tree.

    Returns:
        The number of trees, and that of the next new one.
    """
    for k in range(of.seen.shape[0]):
        t = of.seen[k]
        rows.stamp_ns[t] = sight.stamp_ns
        rows.score[t] = min(rows.score[t] + 1.0, SCORE_MAX)
    fresh = _places(of.row, False)
    z, R, B = _picked(fresh, of.position, of.own, of.added)
    begin(rows, count, number, sight.stamp_ns, z, R, B, limits.velocity_sigma)
    row, touched = of.row.copy(), np.ones(count + fresh.shape[0], np.bool_)
    for k in range(fresh.shape[0]):
        row[fresh[k]] = count + k
    for t in range(count):
        touched[t] = of.touched[t]
    add_observations(
        row, of.position, sight.pose, found.eccentricity, found.radius, found.radius_sigma, found.arc,
        found.above_breast, rows.hits, rows.eccentricity, rows.eccentricities, rows.radius,
        rows.radius_weight, rows.radius_reach, rows.radius_above, rows.radii, rows.sides,
    )  # fmt: skip
    return _settled(rows, touched, limits.proximity_radius), number + fresh.shape[0]


@compiled
def hold(rows: Rows, count: int, sight: Sight, landmarks: Float, covariance: Float, limits: Limits) -> int:
    """Hold the trees in reach to SLAM's landmarks (see `anchor`); returns the number of trees."""
    anchor(rows, count, sight, landmarks, covariance, limits)
    return _settled(rows, np.ones(count, np.bool_), limits.proximity_radius)


@compiled
def _settled(rows: Rows, touched: Bool, radius: float) -> int:
    """Merge what stands at one place, and let go what lost its score."""
    kept = merge_near(rows, touched, radius)
    whole = True
    for t in range(kept.shape[0]):
        kept[t] = kept[t] and rows.score[t] > 0.0
        whole = whole and kept[t]
    return kept.shape[0] if whole else keep(rows, kept)
