"""Statistics of one scan for the quality of the pose: recognised and missed landmarks, and the deviation from
the odometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import wrapped

# Columns of the statistics of a scan by particle; SHIFT is the deviation x, y [m], yaw [rad] from the
# odometry.
INNOVATION, RECOGNISED, AMBIGUOUS, FOUND, MISSED, SHIFT = 0, 1, 2, 3, 4, slice(5, 8)
STATISTICS = 8  # number of columns
# Maximum hits by which a landmark is weighted. Weighting by hits prevents new landmarks at a wrong pose from
# outvoting the map soon.
MOST_HITS = 20.0

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
        found: Hits of the recognised landmarks, each limited to MOST_HITS.
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


def named_statistics(mean: Float, odometry: float, detections: int) -> ScanStatistics:
    """Return the results of `mean_statistics` as a record. The innovation becomes NaN below 0.5 recognised
    landmarks.

    Args:
        mean: Mean columns, shape (STATISTICS,).
        odometry: Deviation from the odometry [sigma].
        detections: Number of detections.
    """
    recognised = float(mean[RECOGNISED])
    return ScanStatistics(
        detections=detections,
        recognised=recognised,
        ambiguous=float(mean[AMBIGUOUS]),
        found=float(mean[FOUND]),
        missed=float(mean[MISSED]),
        innovation=float(mean[INNOVATION]) / (2.0 * recognised) if recognised > 0.5 else float("nan"),
        odometry=odometry,
    )


@compiled
def mean_statistics(statistics: Float, weights: Float, motion_covariance: Float) -> tuple[Float, float]:
    """Return the weighted mean of the columns, shape (STATISTICS,), and the Mahalanobis norm of its SHIFT
    [sigma].

    Args:
        statistics: Statistics by particle, shape (P, STATISTICS).
        weights: Weights with sum 1, shape (P,).
        motion_covariance: Covariance of the odometry since the last used scan, shape (3, 3).
    """
    mean = np.zeros(STATISTICS)
    for p in range(statistics.shape[0]):
        for i in range(STATISTICS):
            mean[i] += weights[p] * statistics[p, i]
    return mean, np.sqrt(_mahalanobis2(mean[SHIFT], motion_covariance))


@compiled
def disagreement(by_trees: Float, by_odometry: Float, covariance: Float) -> float:
    """Return the Mahalanobis distance of two motions [sigma].

    Args:
        by_trees, by_odometry: x, y [m], yaw [rad], shape (3,).
        covariance: Covariance of the odometry, shape (3, 3); SIGMA_FLOOR squared is added to its diagonal.
    """
    shift = by_trees - by_odometry
    shift[2] = wrapped(shift[2])
    return float(np.sqrt(_mahalanobis2(shift, covariance)))


@compiled
def _mahalanobis2(shift: Float, covariance: Float) -> float:
    """Return d^T (P + F)^-1 d by Gaussian elimination, where F is the diagonal of SIGMA_FLOOR squared, for d
    = `shift`, shape (3,), and P = `covariance`, shape (3, 3)."""
    P = covariance.copy()
    for i in range(3):
        P[i, i] += SIGMA_FLOOR[i] ** 2
    d = shift.copy()
    square = 0.0
    for i in range(3):
        square += d[i] * d[i] / P[i, i]
        for j in range(i + 1, 3):
            factor = P[j, i] / P[i, i]
            d[j] -= factor * d[i]
            for k in range(i, 3):
                P[j, k] -= factor * P[i, k]
    return square
