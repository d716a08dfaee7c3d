"""How far the pose can be trusted: what one scan tells of it, what the last ones told, and one word."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.health import Health, HealthState

# What a particle tells of a scan, columns of `told`.
INNOVATION, RECOGNISED, AMBIGUOUS, FOUND, MISSED, SHIFT = 0, 1, 2, 3, 4, slice(5, 8)
TOLD = 8
# Landmarks count by their hits, so that trees begun at a wrong place do not soon outvote the map.
MOST_HITS = 20.0

# Position sigmas up to which a tree map stays usable, and beyond which trees get mixed up: a third of
# the usual distance between neighbouring trunks, and the whole of it.
SIGMA_GOOD, SIGMA_WEAK = 0.5, 1.5  # m
INNOVATION_WEAK = 3.0  # fading mean; the errors are 1.7 times as large as their covariances say
FOUND_WEAK, FOUND_LOST = 0.35, 0.2  # fading share of the known trees in free view that were found
# A tree of three hits is well known: before those of another place are, the robot must be told lost.
STRANGE_LOST, STRANGE_MISSED = 3, 15.0  # scans; hits of the known trees that such a scan misses
ODOMETRY_WEAK = 5.0  # sigma
AMBIGUOUS_WEAK = 0.5  # fading share of the detections
ALONE_WEAK = 5.0  # m without two known trees: then the heading is the odometry's alone
FADING = 0.1  # of a fading mean is the newest scan
FADING_FOUND = 0.2
FEWEST = 2.0  # trees; fewer say nothing about shares
SIGMA_FLOOR = np.array([1e-3, 1e-3, 1e-4])  # m, m, rad


@dataclass(frozen=True, slots=True)
class Recent:
    """Fading means over the last scans.

    Attributes:
        innovation: Normalised innovation squared a degree of freedom.
        found: Share of the well known landmarks in free view that were found.
        ambiguous: Share of the detections that have two likely landmarks.
        odometry: Largest disagreement with the odometry, fading [sigma].
        alone: Distance driven since two known trees were recognised in a scan [m].
        mapped: Whether any landmark is well known.
        distrust: 1 when the trees overruled the odometry, fading.
        strange: Scans in a row of which every detection is new while known trees in free view are missed.
    """

    innovation: float = 1.0
    found: float = 1.0
    ambiguous: float = 0.0
    odometry: float = 0.0
    alone: float = 0.0
    mapped: bool = False
    distrust: float = 0.0
    strange: int = 0


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


def remembered(recent: Recent, scan: ScanTold, driven: float) -> Recent:
    """The fading means after one scan more, `driven` metres after the one before it."""
    expected, told = scan.found + scan.missed, math.isfinite(scan.innovation)
    return Recent(
        innovation=_faded(recent.innovation, scan.innovation, FADING if told else 0),
        found=_faded(recent.found, scan.found / max(expected, 1e-9), FADING_FOUND if expected > 0 else 0),
        ambiguous=_faded(
            recent.ambiguous,
            scan.ambiguous / max(scan.detections, 1),
            FADING if scan.detections >= FEWEST else 0,
        ),
        odometry=max(scan.odometry, (1.0 - FADING) * recent.odometry),
        alone=0.0 if scan.recognised >= FEWEST else recent.alone + driven,
        mapped=recent.mapped or scan.recognised > 0.5,
        distrust=fading_distrust(recent.distrust),
        strange=_strange(recent.strange, scan),
    )


@compiled
def fading_distrust(distrust: float) -> float:
    """The distrust after one scan more, see Recent."""
    return (1.0 - FADING) * distrust if distrust > 0.01 else 0.0


def is_astray(recent: Recent) -> bool:
    """Whether the known trees are not where they should be seen."""
    return recent.mapped and (recent.found < FOUND_LOST or recent.strange >= STRANGE_LOST)


def _strange(before: int, scan: ScanTold) -> int:
    """Counted until a known tree is recognised; a scan that misses none or sees nothing says nothing."""
    if scan.recognised >= 0.5 or scan.found > 0.0:
        return 0
    return before + 1 if scan.detections >= FEWEST and scan.missed >= STRANGE_MISSED else before


def judged(
    recent: Recent, scan: ScanTold, n_eff: float, ancestors: int, covariance: Float, doubt: str = ""
) -> Health:
    """The health after a scan.

    Args:
        recent, scan: What the last scans and this one told.
        n_eff, ancestors: See Health.
        covariance: Of the pose, shape (3, 3).
        doubt: What is wrong with the odometry, for people; empty when nothing is.
    """
    sigma_xy = float(np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1])))
    state, reason = _word(recent, sigma_xy, doubt)
    return Health(
        state=state,
        reason=reason,
        n_eff=n_eff,
        ancestors=ancestors,
        detections=scan.detections,
        recognised=scan.recognised,
        ambiguous=scan.ambiguous,
        innovation=scan.innovation,
        sigma_xy=sigma_xy,
        sigma_yaw=float(np.sqrt(covariance[2, 2])),
        odometry=scan.odometry,
    )


def _word(recent: Recent, sigma_xy: float, doubt: str) -> tuple[HealthState, str]:
    if not sigma_xy <= SIGMA_WEAK:
        return "lost", f"the position is uncertain by {sigma_xy:.1f} m, more than trees stand apart"
    if is_astray(recent):
        return "lost", "the known trees are not where they should be seen"
    if doubt:
        return "weak", doubt
    if sigma_xy > SIGMA_GOOD:
        return "weak", f"the position is uncertain by {sigma_xy:.1f} m"
    if recent.mapped and recent.found < FOUND_WEAK:
        return "weak", "most of the known trees are not seen where they should be"
    if recent.odometry > ODOMETRY_WEAK:
        return "weak", "the trees contradict the odometry: the wheels slip, or it jumped"
    if recent.innovation > INNOVATION_WEAK:
        return "weak", "the trees are seen farther from their places than their errors allow"
    if recent.ambiguous > AMBIGUOUS_WEAK:
        return "weak", "most detections could be one of two trees"
    if recent.mapped and recent.alone > ALONE_WEAK:
        return "weak", f"no two known trees in view for {recent.alone:.0f} m: the odometry leads alone"
    return "good", ""


def _faded(mean: float, value: float, newest: float) -> float:
    """The mean when the newest value has this part in it."""
    return mean + newest * (value - mean) if newest else mean
