"""Quality of the pose: the statistics of one scan (recognised and missed landmarks, and the deviation from
the odometry), and good, weak or lost, with the reason, by running statistics of the scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.slam.motion import Noise, OdometryTrust, wrapped
from pipeline.slam.rigid_shift_test import FAMILIAR, MANY
from pipeline.types.records import ALONE, SIGMA_XY_MAX, UNCERTAIN, UNDECIDED, Health, HealthState

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
    """Statistics of one scan, means over the particles. A landmark is well known if it has at least
    `slam.hits_to_weigh` hits.

    Attributes:
        detections: Number of detections.
        recognised: Number of detections of well-known landmarks.
        ambiguous: Number of detections whose two best pairs differ by less than `proposal.LIKELY`.
        found: Sum of the hits, each at most MOST_HITS, of the well-known landmarks that were detected.
        missed: Sum of the hits, each at most MOST_HITS, of the well-known landmarks in free view that were
            not detected.
        innovation: Normalised innovation squared per degree of freedom; NaN if no well-known landmark was
            detected.
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
    """Return the results of `mean_statistics` as a record. The sum of innovations is divided by two degrees
    of freedom per recognised landmark; it becomes NaN with 0.5 recognised landmarks or fewer.

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


def mean_statistics(statistics: Float, weights: Float, motion_covariance: Float) -> tuple[Float, float]:
    """Return the weighted mean of the columns over the particles, shape (STATISTICS,), and the Mahalanobis
    norm of the mean SHIFT [sigma], with SIGMA_FLOOR squared added to the variances of the motion.

    Args:
        statistics: Statistics by particle, shape (P, STATISTICS).
        weights: Weights with sum 1, shape (P,).
        motion_covariance: Covariance of the odometry since the last used scan, shape (3, 3).
    """
    mean = weights @ statistics
    return mean, math.sqrt(_mahalanobis2(mean[SHIFT], motion_covariance))


def disagreement(by_trees: Float, by_odometry: Float, covariance: Float) -> float:
    """Return the Mahalanobis distance of two motions [sigma]. The yaw difference is wrapped.

    Args:
        by_trees, by_odometry: Motions x, y [m], yaw [rad], shape (3,).
        covariance: Covariance of the odometry, shape (3, 3); SIGMA_FLOOR squared is added to its diagonal.
    """
    shift = by_trees - by_odometry
    shift[2] = wrapped(shift[2])
    return math.sqrt(_mahalanobis2(shift, covariance))


def _mahalanobis2(shift: Float, covariance: Float) -> float:
    """Return d^T (P + F)^-1 d where F is the diagonal of SIGMA_FLOOR squared, for d
    = `shift`, shape (3,), and P = `covariance`, shape (3, 3)."""
    return float(shift @ np.linalg.solve(covariance + np.diag(SIGMA_FLOOR**2), shift))


# A strange scan misses nearly all known trees in free view. After STRANGE_LOST of them in a row the robot is
# lost. The number exceeds the hits that make a tree well known, so that trees that were hidden by a bend or
# by leaves become known before. A scan is strange only if the trees it misses have at least STRANGE_MISSED
# hits together, so that a few new trees do not outvote the map.
STRANGE_LOST, STRANGE_MISSED = 5, 15.0  # scans; hits
FADING = 0.1  # weight of the newest scan in a running mean
FADING_FOUND = 0.2  # the same for shares of recognised trees
OVERRULED = 0.5  # distrust that remains 0.7 s after the trees contradicted the odometry
DISTRUST_TIME = 1.0  # s; in it, distrust decays to a share of 1 / e: wheels slip in the same place or mud
FEWEST = 2.0  # minimum number of trees for a share, and for a heading from trees
# In a known place, a scan is strange in spite of a few trees that are recognised by chance if it misses trees
# with EXPECTED hits and finds less than the share BY_CHANCE of the hits; STILL_BY_CHANCE after a strange
# scan.
EXPECTED = 100.0  # hits
BY_CHANCE, STILL_BY_CHANCE = 0.15, 0.4  # shares of the hits
NEARBY = 3.0  # m without two known trees, up to which the place counts as known
# Recognised trees that are needed to trust their motion without an odometry; MANY of them contradict one.
TREES_WITHOUT_ODOMETRY = 3.0
TREE_MOTION_SCANS = 20  # scans after which their motion is trusted
# Bound and increment of the counter of these scans. Scans without a doubt decrease it by one, so that an
# intermittent doubt does not restart it.
TREE_MOTION_MAX, TREE_MOTION_STEP = 60, 2


@dataclass(frozen=True, slots=True)
class RunningStatistics:
    """Running statistics after a scan. A landmark is well known if it has at least `slam.hits_to_weigh` hits.

    Attributes:
        innovation: Running mean of the normalised innovation squared per degree of freedom.
        found: Running mean of `ScanStatistics.found` as a share of `found` plus `missed`, the well-known
            landmarks in free view.
        ambiguous: Running mean of the share of detections that `ScanStatistics.ambiguous` counts.
        odometry: Largest deviation from an odometry without doubt [sigma], decaying by FADING per scan.
        alone: Distance driven since the last scan in which FEWEST well-known landmarks were detected [m].
        mapped: Whether a well-known landmark was ever detected.
        distrust: 1 when the trees contradict the odometry, decaying with the time since (`decayed_distrust`).
        strange: Number of strange scans in a row, see STRANGE_LOST.
        missed: Maximum of `ScanStatistics.missed` over the present strange scans.
        familiar: Running mean of the share of detections that belong to well-known landmarks.
        led: Counter of the scans in which trees determined the motion while the odometry was doubted: plus
            TREE_MOTION_STEP for each, minus one for each scan without doubt.
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
        """Whether the trees contradicted the odometry within the last 0.7 s."""
        return self.distrust >= OVERRULED

    @property
    def is_tree_motion_reliable(self) -> bool:
        """Whether the motion that trees determine is trusted without the odometry: `led` is at least its
        value after TREE_MOTION_SCANS successive scans, from 0, with a doubted odometry and enough detections
        of well-known landmarks. A doubted scan with too few trees sets `led` to 0; scans without doubt
        decrease it slowly."""
        return self.led >= TREE_MOTION_STEP * TREE_MOTION_SCANS

    def odometry_trust(self, noise: Noise) -> OdometryTrust:
        """Return the trust in an odometry with this noise, by `distrust`, `alone` and `familiar`."""
        return OdometryTrust(noise, self.distrust, self.alone, self.familiar)


class OdometryDoubt(NamedTuple):
    """Reasons not to trust the odometry.

    Attributes:
        reported: The step came with a doubt, for example because the odometry was missing.
        contradicted: The trees contradict the odometry, in this scan or in one of the last scans.
    """

    reported: bool = False
    contradicted: bool = False


NO_DOUBT = OdometryDoubt()


def update_statistics(
    recent: RunningStatistics, scan: ScanStatistics, driven: float, doubted: OdometryDoubt = NO_DOUBT
) -> RunningStatistics:
    """Return the running statistics after one more scan.

    A mean is unchanged by a scan that does not measure it: `innovation` by NaN, `found` without well-known
    landmarks in free view, `ambiguous` and `familiar` below FEWEST detections. `distrust` is unchanged: the
    caller sets it to 1 when the trees contradict the odometry, and lets it decay (`decayed_distrust`).

    Args:
        recent: Statistics before the scan.
        scan: Statistics of the scan.
        driven: Distance since the last used scan [m], with 1 m per radian of rotation.
        doubted: Doubts about the odometry at this scan.
    """
    expected, is_measured = scan.found + scan.missed, math.isfinite(scan.innovation)
    strange = _strange_scans(recent, scan, any(doubted) or recent.alone + driven < NEARBY)
    return RunningStatistics(
        innovation=_exponential_mean(recent.innovation, scan.innovation, FADING if is_measured else 0),
        found=_exponential_mean(
            recent.found, scan.found / max(expected, 1e-9), FADING_FOUND if expected > 0 else 0
        ),
        ambiguous=_exponential_mean(
            recent.ambiguous,
            scan.ambiguous / max(scan.detections, 1),
            FADING if scan.detections >= FEWEST else 0,
        ),
        odometry=max(0.0 if any(doubted) else scan.odometry, (1.0 - FADING) * recent.odometry),
        alone=distance_without_trees(recent.alone, scan.recognised, driven),
        mapped=recent.mapped or scan.recognised > 0.5,
        distrust=recent.distrust,
        strange=strange,
        missed=max(recent.missed, scan.missed) if strange else 0.0,
        familiar=updated_familiar(recent.familiar, scan.recognised, scan.detections),
        led=_tree_motion_count(recent.led, scan, doubted),
    )


def distance_without_trees(alone: float, recognised: float, driven: float) -> float:
    """Return the distance driven since the last scan with at least FEWEST recognised trees [m]: 0 after such
    a scan, else `alone` plus `driven`.

    Args:
        alone: The distance before [m].
        recognised: Number of recognised trees in the scan.
        driven: Distance since the scan before [m].
    """
    return 0.0 if recognised >= FEWEST else alone + driven


def decayed_distrust(distrust: float, period: float) -> float:
    """Return the distrust, 0 to 1, after the time `period` [s]: it decays exponentially (DISTRUST_TIME); 0.01
    or less becomes 0."""
    left = distrust * math.exp(-period / DISTRUST_TIME)
    return left if left > 0.01 else 0.0


def updated_familiar(familiar: float, recognised: float, detections: int) -> float:
    """Return the running mean of the share of detections of well-known landmarks after one more scan.

    Args:
        familiar: The mean before.
        recognised: Number of detections of well-known landmarks in the scan.
        detections: Number of detections; with fewer than FEWEST the mean is unchanged.
    """
    if detections < FEWEST:
        return familiar
    return familiar + FADING_FOUND * (recognised / detections - familiar)


def _tree_motion_count(before: int, scan: ScanStatistics, doubted: OdometryDoubt) -> int:
    """Return `RunningStatistics.led` after a scan; `before` is its value before.

    If the odometry is not doubted, it decreases by 1, at least to 0. A doubted scan with
    TREES_WITHOUT_ODOMETRY detections of well-known landmarks, or MANY if the doubt is not reported, increases
    it by TREE_MOTION_STEP, at most to TREE_MOTION_MAX; with fewer it becomes 0.
    """
    if not any(doubted):
        return max(before - 1, 0)
    leading = TREES_WITHOUT_ODOMETRY if doubted.reported else MANY
    return min(before + TREE_MOTION_STEP, TREE_MOTION_MAX) if scan.recognised >= leading else 0


def _strange_scans(recent: RunningStatistics, scan: ScanStatistics, here: bool) -> int:
    """Return the number of strange scans in a row after a scan.

    A scan is strange if it has FEWEST detections, misses enough known trees (STRANGE_MISSED) and finds none.
    A scan that finds none, but misses too few or detects too few, leaves the number unchanged. In a known
    place, a scan that finds a few of many known trees (see BY_CHANCE) is strange as well; later scans of such
    a row may also find young trees, which were begun after its start. Any other scan that finds known trees
    resets the number to 0.

    Args:
        recent: Statistics before the scan.
        scan: Statistics of the scan.
        here: Whether the robot may be elsewhere than estimated although the place is known: two known trees
            were seen within the last NEARBY metres, or the odometry is doubted.
    """
    before = recent.strange
    misses_trees = scan.detections >= FEWEST and scan.missed >= STRANGE_MISSED
    share = scan.found / max(scan.found + scan.missed, 1e-9)
    if scan.recognised < 0.5 and scan.found == 0.0:
        return before + 1 if misses_trees else before
    if before:
        # The recognised trees have no more hits than trees begun since the first strange scan, and more trees
        # than one are missed: a single one may have fallen.
        young = scan.found <= (min(before, STRANGE_LOST) + 2) * scan.recognised
        young = young and max(recent.missed, scan.missed) >= FEWEST * STRANGE_MISSED
        return before + 1 if misses_trees and (young or share < STILL_BY_CHANCE) else 0
    return int(
        misses_trees
        and here
        and recent.familiar >= FAMILIAR
        and scan.missed >= EXPECTED
        and share < BY_CHANCE
    )


def _exponential_mean(mean: float, value: float, newest: float) -> float:
    """Return the exponential running mean after a new value: mean + newest (value - mean). With the weight
    `newest` 0 the mean is unchanged, even if the value is NaN."""
    return mean + newest * (value - mean) if newest else mean


# Standard deviation of the position up to which a pose is good: a third of the usual distance between
# neighbouring trunks.
SIGMA_GOOD = 0.5  # m
INNOVATION_WEAK = 3.0  # normalised innovation squared; errors are sqrt(3) = 1.7 times their sigma
FOUND_WEAK, FOUND_LOST = 0.35, 0.2  # minimum share of the known trees in free view that are found
ODOMETRY_WEAK = 5.0  # sigma; deviation from the odometry
AMBIGUOUS_WEAK = 0.5  # share of the detections with two likely landmarks
ALONE_WEAK = 5.0  # m without two known trees, which determine the heading


def pose_health(
    recent: RunningStatistics,
    scan: ScanStatistics,
    n_eff: float,
    ancestors: int,
    covariance: Float,
    doubt: str = "",
) -> Health:
    """Return the quality of the pose after a scan.

    The state is "lost" if the standard deviation of the position exceeds SIGMA_XY_MAX or `is_lost` is True,
    and "weak" if another rule of `_state_and_reason` applies, else "good".

    Args:
        recent: Running statistics after the scan.
        scan: Statistics of the scan.
        n_eff: Effective number of particles.
        ancestors: Number of distinct ancestors, see Health.
        covariance: Covariance of x, y [m], yaw [rad] relative to the landmarks, shape (3, 3).
        doubt: Message why the odometry is doubted; empty if there is no doubt.
    """
    sigma_xy = float(np.sqrt(0.5 * (covariance[0, 0] + covariance[1, 1])))
    state, reason = _state_and_reason(recent, sigma_xy, doubt)
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


def _state_and_reason(recent: RunningStatistics, sigma_xy: float, doubt: str) -> tuple[HealthState, str]:
    """Return the state and the message of its reason, which is empty for a good pose. The first rule that
    applies decides.

    "lost": `sigma_xy` is above SIGMA_XY_MAX or NaN; `is_lost`. "weak": a doubt, unless the trees determine
    the motion reliably; `strange` above 0; `found` below FOUND_WEAK; `odometry` above ODOMETRY_WEAK;
    `innovation` above INNOVATION_WEAK; and, where nothing contradicts the pose, `sigma_xy` above SIGMA_GOOD;
    `ambiguous` above AMBIGUOUS_WEAK; `alone` above ALONE_WEAK. The rules for `found` and `alone` apply only
    once a well-known landmark was detected.

    Args:
        recent: Running statistics after the scan.
        sigma_xy: Standard deviation of the position [m].
        doubt: Reason to doubt the odometry, "" for none.
    """
    if not sigma_xy <= SIGMA_XY_MAX:
        return "lost", f"{UNCERTAIN} by {sigma_xy:.1f} m, more than the distance between trees"
    if is_lost(recent):
        return "lost", "the known trees are not found where they should be visible"
    if doubt and not recent.is_tree_motion_reliable:
        return "weak", doubt
    if recent.strange:
        return "weak", "most detections are at places without a tree in the map"
    if recent.mapped and recent.found < FOUND_WEAK:
        return "weak", "most of the known trees are not found where they should be visible"
    if recent.odometry > ODOMETRY_WEAK:
        return "weak", "the trees contradict the odometry"
    if recent.innovation > INNOVATION_WEAK:
        return "weak", "the trees deviate from their map positions by more than their covariances allow"
    if sigma_xy > SIGMA_GOOD:
        return "weak", f"{UNCERTAIN} by {sigma_xy:.1f} m"
    if recent.ambiguous > AMBIGUOUS_WEAK:
        return "weak", UNDECIDED
    if recent.mapped and recent.alone > ALONE_WEAK:
        return (
            "weak",
            f"{ALONE} for {recent.alone:.0f} m: only odometry is used",
        )
    return "good", ""


def is_lost(recent: RunningStatistics) -> bool:
    """Return whether `recent.found`, the share of landmarks in free view that were detected (running mean),
    is below FOUND_LOST, or `recent.strange`, the number of strange scans in a row, is at least STRANGE_LOST.
    False before any landmark with `hits_to_weigh` hits was detected."""
    return recent.mapped and (recent.found < FOUND_LOST or recent.strange >= STRANGE_LOST)


def is_supported(recent: RunningStatistics) -> bool:
    """Return whether the last scan was not strange (`recent.strange` is 0) and `recent.found`, the share of
    landmarks in free view that were detected (running mean), is at least FOUND_WEAK. True for initial
    statistics."""
    return recent.strange == 0 and recent.found >= FOUND_WEAK
