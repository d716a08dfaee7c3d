"""How far the pose can be trusted: what one scan tells of it, what the last ones told, and one word."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.health import Health, HealthState
from pipeline.slam.motion import Noise, Wheels, wrapped
from pipeline.slam.together import FAMILIAR, MANY

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
# Scans in a row that show another place. More than make a tree well known: what a bend or an end of leaves
# hid is new as well, and must have the time to become known before the robot is told lost. Trees of another
# place become known as soon, so that from then on the hits count: a few new ones outvote no map.
STRANGE_LOST, STRANGE_MISSED = 5, 15.0  # scans; hits of the known trees in free view that such a scan misses
ODOMETRY_WEAK = 5.0  # sigma
AMBIGUOUS_WEAK = 0.5  # fading share of the detections
ALONE_WEAK = 5.0  # m without two known trees: then the heading is the odometry's alone
FADING = 0.1  # of a fading mean is the newest scan
FADING_FOUND = 0.2
OVERRULED = 0.5  # of the distrust is left for six scans
FEWEST = 2.0  # trees; fewer say nothing about shares
EXPECTED = 100.0  # hits in free view that are missed in a known place where few are recognised by chance:
BY_CHANCE, STILL_BY_CHANCE = 0.15, 0.4  # share of those found that is so; of the scans after such a one
NEARBY = 3.0  # m without a known tree, after which a place is a known one no more
LEADING = 3.0  # well known trees tell the motion where there is no odometry, MANY where there is one,
LED = 20  # and are believed in that after so many scans;
LED_MOST, LED_AGAIN = 60, 2  # what counts for more, so that a doubt that comes and goes does not begin anew
SIGMA_FLOOR = np.array([1e-3, 1e-3, 1e-4])  # m, m, rad


@dataclass(frozen=True, slots=True)
class Recent:
    """Fading means over the last scans.

    Attributes:
        innovation: Normalised innovation squared a degree of freedom.
        found: Share of the well known landmarks in free view that were found.
        ambiguous: Share of the detections that have two likely landmarks.
        odometry: Largest disagreement with the odometry where that was not doubted anyway, fading [sigma].
        alone: Distance driven since two known trees were recognised in a scan [m].
        mapped: Whether any landmark is well known.
        distrust: 1 when the trees overruled the odometry, fading.
        strange: Scans in a row that miss nearly all known trees in free view, and recognise none or, in a
            place that was well known, few.
        missed: Most hits of known trees in free view that one of these scans missed.
        familiar: Fading share of the detections that are well known.
        led: Of scans in which trees told the motion as the odometry was doubted, LED_AGAIN for each; one less
            for each scan since then.
    """

    innovation: float = 1.0
    found: float = 1.0
    ambiguous: float = 0.0
    odometry: float = 0.0
    alone: float = 0.0
    mapped: bool = False
    distrust: float = 0.0
    strange: int = 0
    missed: float = 0.0
    familiar: float = 0.0
    led: int = 0

    @property
    def slipped(self) -> bool:
        """Whether the trees overruled the odometry in one of the last scans."""
        return self.distrust >= OVERRULED

    def wheels(self, noise: Noise) -> Wheels:
        """How far an odometry of this noise may lie from what the trees say now."""
        return Wheels(noise, self.distrust, self.alone, self.familiar)


class Doubted(NamedTuple):
    """Whether the odometry is not believed: as it came, or by the trees, now or just before."""

    as_it_came: bool = False
    by_trees: bool = False


BELIEVED = Doubted()


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


def remembered(recent: Recent, scan: ScanTold, driven: float, doubted: Doubted = BELIEVED) -> Recent:
    """The fading means after one scan more, `driven` metres after the one before it."""
    expected, told = scan.found + scan.missed, math.isfinite(scan.innovation)
    strange = _strange(recent, scan, any(doubted) or recent.alone + driven < NEARBY)
    return Recent(
        innovation=_faded(recent.innovation, scan.innovation, FADING if told else 0),
        found=_faded(recent.found, scan.found / max(expected, 1e-9), FADING_FOUND if expected > 0 else 0),
        ambiguous=_faded(
            recent.ambiguous,
            scan.ambiguous / max(scan.detections, 1),
            FADING if scan.detections >= FEWEST else 0,
        ),
        odometry=max(0.0 if any(doubted) else scan.odometry, (1.0 - FADING) * recent.odometry),
        alone=driven_alone(recent.alone, scan.recognised, driven),
        mapped=recent.mapped or scan.recognised > 0.5,
        distrust=fading_distrust(recent.distrust),
        strange=strange,
        missed=max(recent.missed, scan.missed) if strange else 0.0,
        familiar=fading_familiar(recent.familiar, scan.recognised, scan.detections),
        led=_led(recent.led, scan, doubted),
    )


@compiled
def driven_alone(alone: float, recognised: float, driven: float) -> float:
    """The distance without two known trees after one scan more, see Recent."""
    return 0.0 if recognised >= FEWEST else alone + driven


@compiled
def fading_distrust(distrust: float) -> float:
    """The distrust after one scan more, see Recent."""
    return (1.0 - FADING) * distrust if distrust > 0.01 else 0.0


@compiled
def fading_familiar(familiar: float, recognised: float, detections: int) -> float:
    """The share of well known trees after one scan more, see Recent."""
    if detections < FEWEST:
        return familiar
    return familiar + FADING_FOUND * (recognised / detections - familiar)


def is_astray(recent: Recent) -> bool:
    """Whether the known trees are not where they should be seen."""
    return recent.mapped and (recent.found < FOUND_LOST or recent.strange >= STRANGE_LOST)


def _led(before: int, scan: ScanTold, doubted: Doubted) -> int:
    """Counted while trees tell what the odometry does not; forgotten when it is right for long."""
    if not any(doubted):
        return max(before - 1, 0)
    leading = LEADING if doubted.as_it_came else MANY
    return min(before + LED_AGAIN, LED_MOST) if scan.recognised >= leading else 0


def _strange(recent: Recent, scan: ScanTold, here: bool) -> int:
    """Counted until a known tree is recognised; a scan that misses none in free view or sees nothing says
    nothing. In a place that is `here`, where known trees were seen last, or may be, a few of many are
    recognised by chance, and those of the new place once they were seen for long enough."""
    before = recent.strange
    told = scan.detections >= FEWEST and scan.missed >= STRANGE_MISSED
    share = scan.found / max(scan.found + scan.missed, 1e-9)
    if scan.recognised < 0.5 and scan.found == 0.0:
        return before + 1 if told else before
    if before:
        # What was recognised has no more hits than what was begun since the first of these scans, and more
        # is missed than one tree, which may have fallen.
        young = scan.found <= (min(before, STRANGE_LOST) + 2) * scan.recognised
        young = young and max(recent.missed, scan.missed) >= FEWEST * STRANGE_MISSED
        return before + 1 if told and (young or share < STILL_BY_CHANCE) else 0
    return int(
        told and here and recent.familiar >= FAMILIAR and scan.missed >= EXPECTED and share < BY_CHANCE
    )


def judged(
    recent: Recent, scan: ScanTold, n_eff: float, ancestors: int, covariance: Float, doubt: str = ""
) -> Health:
    """The health after a scan. An odometry that is doubted makes it weak until the trees have led for long
    enough to be believed in that.

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
        doubt=doubt,
    )


def _word(recent: Recent, sigma_xy: float, doubt: str) -> tuple[HealthState, str]:
    if not sigma_xy <= SIGMA_WEAK:
        return "lost", f"the position is uncertain by {sigma_xy:.1f} m, more than trees stand apart"
    if is_astray(recent):
        return "lost", "the known trees are not where they should be seen"
    if doubt and recent.led < LED_AGAIN * LED:
        return "weak", doubt
    if recent.strange:
        return "weak", "most detections stand where the map has no tree"
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
