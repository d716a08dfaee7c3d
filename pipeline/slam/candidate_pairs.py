"""Candidate pairs of detections and landmarks, once for all particles, with their covariances.

Everything is in the body frame, where the covariance of the motion, of a detection and of an innovation are
the same for all particles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import Pose, expected_spread, rotated
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_within
from pipeline.slam.particle_maps import ABSENT, ROOM, Maps
from pipeline.types.records import Bool, Int


class Pairs(NamedTuple):
    """Pairs that at least one particle may associate, ordered by detection.

    Attributes:
        first: First pair of each detection, then the number of pairs, int64, shape (D + 1,).
        row: Row of the landmark among those near, int64, shape (K,).
        weighs: Whether the landmark is well known, shape (K,).
        spread: Covariance of the innovation without that of the pose, xx, xy, yy, shape (K, 3) [m^2].
        gate: Inverse of the covariance of the innovation, xx, xy, yy, shape (K, 3) [1/m^2].
        log_det: Logarithm of the determinant of this covariance, shape (K,).
    """

    first: Int
    row: Int
    weighs: Bool
    spread: Float
    gate: Float
    log_det: Float


@compiled
def relative_positions(maps: Maps, slots: Int, pose: Float, best: int) -> tuple[Float, Float]:
    """Return landmarks in the body frame of each particle, shape (P, L, 2) [m], and the largest distance of
    each one to its position by the particle `best`, shape (L,) [m]."""
    P, L = pose.shape[0], slots.shape[0]
    relative, apart = np.empty((P, L, 2)), np.zeros(L)
    for turn in range(P + 1):
        p = best if turn == 0 else turn - 1
        c, s = np.cos(pose[p, 2]), np.sin(pose[p, 2])
        for n in range(L):
            b, o = maps.block[p, slots[n] // ROOM], slots[n] % ROOM
            dx, dy = maps.mean[b, o, 0] - pose[p, 0], maps.mean[b, o, 1] - pose[p, 1]
            x, y = c * dx + s * dy, c * dy - s * dx
            relative[p, n, 0], relative[p, n, 1] = x, y
            x, y = x - relative[best, n, 0], y - relative[best, n, 1]
            if maps.mean[b, o, 0] < ABSENT:
                apart[n] = max(apart[n], x * x + y * y)
    return relative, np.sqrt(apart)


@compiled
def candidate_pairs(
    centre: Float,
    R: Float,
    relative: Float,
    apart: Float,
    covariance: Float,
    well_known: Bool,
    P: Float,
    distance_max: float,
) -> Pairs:
    """Return all pairs that are within the largest distance for at least one particle.

    Args:
        centre: Detections, shape (D, 2) [m]; R: their covariances xx, xy, yy, shape (D, 3).
        relative: Landmarks by one particle, shape (L, 2) [m].
        apart: Largest distance of each landmark to its position by another particle, shape (L,) [m].
        covariance: Of the landmarks, xx, xy, yy, shape (L, 3) [m^2].
        well_known: Which landmarks weigh, shape (L,).
        P: Covariance of the motion, shape (3, 3).
        distance_max: Largest distance of a pair [m].
    """
    D, L = centre.shape[0], relative.shape[0]
    first, n = np.zeros(D + 1, np.int64), 0
    for d in range(D):
        for j in range(L):
            n += _is_near(centre, d, relative, j, distance_max + apart[j])
        first[d + 1] = n
    pairs = Pairs(
        first, np.empty(n, np.int64), np.empty(n, np.bool_), np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    )
    pose = Pose(0.0, 0.0, 0.0, P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
    k = 0
    for d in range(D):
        xx, xy, yy = expected_spread(pose, 1.0, 0.0, centre[d, 0], centre[d, 1], R, d)
        for j in range(L):
            if not _is_near(centre, d, relative, j, distance_max + apart[j]):
                continue
            pairs.row[k], pairs.weighs[k] = j, well_known[j]
            for a in range(3):
                pairs.spread[k, a] = R[d, a] + covariance[j, a]
            S0, S1, S2 = xx + covariance[j, 0], xy + covariance[j, 1], yy + covariance[j, 2]
            det = S0 * S2 - S1 * S1
            pairs.gate[k, 0], pairs.gate[k, 1], pairs.gate[k, 2] = S2 / det, -S1 / det, S0 / det
            pairs.log_det[k] = np.log(det)
            k += 1
    return pairs


@compiled_within
def _is_near(centre: Float, d: int, relative: Float, j: int, distance: float) -> bool:
    x, y = relative[j, 0] - centre[d, 0], relative[j, 1] - centre[d, 1]
    return bool(x * x + y * y <= distance * distance)


@compiled
def rotated_rows(rows: Float, angle: float) -> Float:
    """Return covariances xx, xy, yy, shape (N, 3), rotated by an angle [rad]."""
    out, c, s = np.empty_like(rows), np.cos(angle), np.sin(angle)
    for n in range(rows.shape[0]):
        out[n, 0], out[n, 1], out[n, 2] = rotated(rows, n, c, s)
    return out
