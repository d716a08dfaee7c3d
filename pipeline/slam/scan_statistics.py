"""Statistics of one scan for the quality of the pose: recognised and missed landmarks, and the deviation from
the odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import wrapped

# Maximum hits by which a landmark is weighted. Weights by hits prevent new landmarks at a wrong pose from
# outvoting the map soon.
HITS_MAX = 20.0

# m, m, rad; added to the sigmas of the odometry, which are zero while the robot stands.
SIGMA_FLOOR = np.array([1e-3, 1e-3, 1e-4])


@dataclass(frozen=True, slots=True)
class ScanStatistics:
    """Statistics of one scan, means over the particles. "Well known" is a landmark with `slam.hits_to_weigh`
    hits.

    Attributes:
        detections: Number of detections.
        recognised: Number of detections of well-known landmarks.
        ambiguous: Number of detections with two likely landmarks.
        found: Hits of the recognised landmarks, each limited to HITS_MAX.
        missed: Hits of the well-known landmarks in free view that were not detected, limited likewise.
        innovation: Normalised innovation squared per degree of freedom; NaN without a recognised landmark.
        odometry: Mahalanobis distance between the motion by SLAM and the odometry [sigma].
    """

    detections: int = 0
    recognised: float = 0.0
    ambiguous: float = 0.0
    found: float = 0.0
    missed: float = 0.0
    innovation: float = float("nan")
    odometry: float = 0.0


@compiled
def disagreement(by_trees: Float, by_odometry: Float, covariance: Float) -> float:
    """Return the distance between two motions, shape (3,), in sigma of the odometry.

    Args:
        by_trees, by_odometry: x, y [m], yaw [rad].
        covariance: Covariance of the odometry, shape (3, 3); SIGMA_FLOOR squared is added to its diagonal.
    """
    P, d, square = covariance.copy(), by_trees - by_odometry, 0.0
    d[2] = wrapped(d[2])
    for i in range(3):
        P[i, i] += SIGMA_FLOOR[i] ** 2
    for i in range(3):  # d^T P^-1 d by elimination
        square += d[i] * d[i] / P[i, i]
        for j in range(i + 1, 3):
            factor = P[j, i] / P[i, i]
            d[j] -= factor * d[i]
            for k in range(i, 3):
                P[j, k] -= factor * P[i, k]
    return float(np.sqrt(square))
