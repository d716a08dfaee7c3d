"""What one scan tells of the pose: which known trees it shows, and how far off the odometry they lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.slam.motion import wrapped

# What a particle tells of a scan, columns of `told`.
INNOVATION, RECOGNISED, AMBIGUOUS, FOUND, MISSED, SHIFT = 0, 1, 2, 3, 4, slice(5, 8)
TOLD = 8
# Landmarks count by their hits, so that trees begun at a wrong place do not soon outvote the map.
MOST_HITS = 20.0

SIGMA_FLOOR = np.array([1e-3, 1e-3, 1e-4])  # m, m, rad


@dataclass(frozen=True, slots=True)
class ScanTold:
    """What one scan told, mean over the particles; see Health.

    Attributes:
        found, missed: Hits of the well known landmarks that were recognised, and of those in free view
            that were not.
    """

    detections: int = 0
    recognised: float = 0.0
    ambiguous: float = 0.0
    found: float = 0.0
    missed: float = 0.0
    innovation: float = float("nan")
    odometry: float = 0.0


def scan_told(told: Float, weights: Float, detections: int, motion_covariance: Float) -> ScanTold:
    """The mean of what the particles tell.

    Args:
        told: shape (P, TOLD); weights: shape (P,).
        detections: Their number.
        motion_covariance: Of the odometry since the scan before, shape (3, 3).
    """
    return scan_of(*mean_told(told, weights, motion_covariance), detections)


def scan_of(mean: Float, odometry: float, detections: int) -> ScanTold:
    """What `mean_told` gives, by name."""
    recognised = float(mean[RECOGNISED])
    return ScanTold(
        detections=detections,
        recognised=recognised,
        ambiguous=float(mean[AMBIGUOUS]),
        found=float(mean[FOUND]),
        missed=float(mean[MISSED]),
        innovation=float(mean[INNOVATION]) / (2.0 * recognised) if recognised > 0.5 else float("nan"),
        odometry=odometry,
    )


@compiled
def mean_told(told: Float, weights: Float, motion_covariance: Float) -> tuple[Float, float]:
    """The mean of what the particles tell, shape (TOLD,), and how far it lies from the odometry [sigma]."""
    mean = np.zeros(TOLD)
    for p in range(told.shape[0]):
        for i in range(TOLD):
            mean[i] += weights[p] * told[p, i]
    return mean, np.sqrt(_mahalanobis2(mean[SHIFT], motion_covariance))


@compiled
def disagreement(by_trees: Float, by_odometry: Float, covariance: Float) -> float:
    """How far two motions, shape (3,), lie apart [sigma]; covariance: of the odometry's, shape (3, 3)."""
    shift = by_trees - by_odometry
    shift[2] = wrapped(shift[2])
    return float(np.sqrt(_mahalanobis2(shift, covariance)))


@compiled
def _mahalanobis2(shift: Float, covariance: Float) -> float:
    """d^T P^-1 d of three numbers by elimination; P has no less than the floor on its diagonal, for an
    odometry that stands still has no sigma."""
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
