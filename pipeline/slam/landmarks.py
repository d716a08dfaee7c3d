"""Update and merging of the landmarks of one particle."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import Cells, holds_unseen
from pipeline.geometry.poses import Float
from pipeline.jit import compiled_within
from pipeline.types.records import Bool, Float32, Int, Int32

VARIANCE_MIN = 1e-4  # m^2 in each direction; all views of a trunk share an error of about one centimetre


@compiled_within
def kalman_update(
    m: Float, Sigma: Float, j: int, z0: float, z1: float, R0: float, R1: float, R2: float
) -> None:
    """Update a static landmark with a measured position, in place. The variance of the result is at least
    VARIANCE_MIN in every direction.

    Args:
        m: Positions of the landmarks, shape (L, 2) [m]; row j is updated.
        Sigma: Their covariances xx, xy, yy, shape (L, 3) [m^2]; row j is updated.
        j: Row of the landmark.
        z0, z1: Measured position [m].
        R0, R1, R2: Covariance xx, xy, yy of the measurement [m^2].
    """
    S0, S1, S2 = Sigma[j, 0], Sigma[j, 1], Sigma[j, 2]
    a, b, d = S0 + R0, S1 + R1, S2 + R2  # S = Sigma + R, H = I
    scale = 1.0 / (a * d - b * b)
    k00, k01 = (S0 * d - S1 * b) * scale, (S1 * a - S0 * b) * scale  # K = Sigma S^-1
    k10, k11 = (S1 * d - S2 * b) * scale, (S2 * a - S1 * b) * scale
    y0, y1 = z0 - m[j, 0], z1 - m[j, 1]
    m[j, 0] += k00 * y0 + k01 * y1
    m[j, 1] += k10 * y0 + k11 * y1
    # K R is (I - K) Sigma for K = Sigma S^-1, and stays positive in floating point.
    xx, yy = k00 * R0 + k01 * R1, k10 * R1 + k11 * R2
    xy = 0.5 * (k00 * R1 + k01 * R2 + k10 * R0 + k11 * R1)
    smallest = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)  # eigenvalue
    lacking = max(VARIANCE_MIN - smallest, 0.0)
    Sigma[j, 0], Sigma[j, 1], Sigma[j, 2] = xx + lacking, xy, yy + lacking


@compiled_within
def merge_duplicates(
    mean: Float,
    covariance: Float,
    hits: Int32,
    score: Float32,
    birth: Int,
    known: int,
    seen: Bool,
    gate: float,
    cells: Cells,
    scale: float,
) -> None:
    """Merge each landmark that was seen with those within the gate that were not seen, in place.

    The merged position is the Kalman update of both, the hits are added, and the better score and the lower
    birth number remain; the other row gets the score 0 and is removed later. Landmarks that are both seen in
    this scan are never merged.

    Args:
        mean, covariance, hits, score, birth: Landmarks, see Maps.
        known: Number of leading rows that are examined.
        seen: Whether a landmark was detected in this scan, shape (L,).
        gate: Maximum Mahalanobis distance [sigma].
        cells: Hash grid of these rows; the position of those that were not seen is up to date.
        scale: Cells per metre.
    """
    gate2 = gate * gate
    largest = 0.0
    for j in range(known):
        largest = max(largest, covariance[j, 0] + covariance[j, 2])
    reach2 = 2.0 * gate2 * largest
    narrow = 2.0 * scale * np.sqrt(reach2) < 1.0
    for j in range(known):
        if not seen[j]:
            continue
        if narrow and not holds_unseen(cells, mean, seen, mean[j, 0], mean[j, 1], reach2, scale):
            continue
        for k in range(known):
            y0, y1 = mean[k, 0] - mean[j, 0], mean[k, 1] - mean[j, 1]
            square = y0 * y0 + y1 * y1
            if square > reach2:
                continue
            # The trace bounds the larger eigenvalue.
            a, d = covariance[j, 0] + covariance[k, 0], covariance[j, 2] + covariance[k, 2]
            if square > gate2 * (a + d) or seen[k] or score[k] <= 0.0:
                continue
            b = covariance[j, 1] + covariance[k, 1]
            if d * y0 * y0 - 2.0 * b * y0 * y1 + a * y1 * y1 > gate2 * (a * d - b * b):
                continue
            kalman_update(
                mean, covariance, j, mean[k, 0], mean[k, 1],
                covariance[k, 0], covariance[k, 1], covariance[k, 2],
            )  # fmt: skip
            hits[j] += hits[k]
            score[j] = max(score[j], score[k])
            birth[j] = min(birth[j], birth[k])
            score[k] = 0.0
