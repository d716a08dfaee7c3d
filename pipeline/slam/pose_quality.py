"""How far the pose can be trusted: one word for people, and its reason."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.slam.running_statistics import STRANGE_LOST, Recent
from pipeline.slam.scan_statistics import ScanTold
from pipeline.types.pose_health import Health, HealthState

# Position sigmas up to which a tree map stays usable, and beyond which trees get mixed up: a third of
# the usual distance between neighbouring trunks, and the whole of it.
SIGMA_GOOD, SIGMA_WEAK = 0.5, 1.5  # m
INNOVATION_WEAK = 3.0  # fading mean; the errors are 1.7 times as large as their covariances say
FOUND_WEAK, FOUND_LOST = 0.35, 0.2  # fading share of the known trees in free view that were found
ODOMETRY_WEAK = 5.0  # sigma
AMBIGUOUS_WEAK = 0.5  # fading share of the detections
ALONE_WEAK = 5.0  # m without two known trees: then the heading is the odometry's alone


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
    if doubt and not recent.trees_lead:
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


def is_astray(recent: Recent) -> bool:
    """Whether the known trees are not where they should be seen."""
    return recent.mapped and (recent.found < FOUND_LOST or recent.strange >= STRANGE_LOST)
