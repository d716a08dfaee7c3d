"""Quality of the pose: good, weak or lost, with the reason."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.slam.running_statistics import STRANGE_LOST, RunningStatistics
from pipeline.slam.scan_statistics import ScanStatistics
from pipeline.types.pose_health import Health, HealthState

# Standard deviations of the position up to which a pose is good, and weak: a third of the usual distance
# between neighbouring trunks, and that distance, beyond which associations become wrong.
SIGMA_GOOD, SIGMA_WEAK = 0.5, 1.5  # m
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

    The pose is lost if its sigma is too large or the known trees are not found, and weak if any figure
    exceeds its limit. A doubted odometry makes it weak until trees have determined the motion for long
    enough.

    Args:
        recent: Running statistics after the scan.
        scan: Statistics of the scan.
        n_eff: Effective number of particles.
        ancestors: Number of distinct ancestors, see Health.
        covariance: Covariance of x, y [m], yaw [rad] relative to the landmarks, shape (3, 3).
        doubt: Message why the odometry is doubted; empty without doubt.
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
    applies decides; `sigma_xy` is in metres. NaN counts as uncertain and gives "lost". `doubt` is the reason
    to doubt the odometry, "" for none; it gives "weak" unless the trees determine the motion reliably."""
    if not sigma_xy <= SIGMA_WEAK:
        return "lost", f"the position is uncertain by {sigma_xy:.1f} m, more than the distance between trees"
    if is_lost(recent):
        return "lost", "the known trees are not found where they should be visible"
    if doubt and not recent.is_tree_motion_reliable:
        return "weak", doubt
    if recent.strange:
        return "weak", "most detections are at places without a tree in the map"
    if sigma_xy > SIGMA_GOOD:
        return "weak", f"the position is uncertain by {sigma_xy:.1f} m"
    if recent.mapped and recent.found < FOUND_WEAK:
        return "weak", "most of the known trees are not found where they should be visible"
    if recent.odometry > ODOMETRY_WEAK:
        return "weak", "the trees contradict the odometry: wheel slip or a jump"
    if recent.innovation > INNOVATION_WEAK:
        return "weak", "the trees deviate from their map positions by more than their covariances allow"
    if recent.ambiguous > AMBIGUOUS_WEAK:
        return "weak", "most detections match two trees"
    if recent.mapped and recent.alone > ALONE_WEAK:
        return (
            "weak",
            f"fewer than two known trees in view for {recent.alone:.0f} m: only odometry is used",
        )
    return "good", ""


def is_lost(recent: RunningStatistics) -> bool:
    """Return whether less than FOUND_LOST of the known trees (running mean) are found where they should be
    visible, or whether nearly all of them were missed in STRANGE_LOST scans in a row. Before any tree is well
    known the result is False."""
    return recent.mapped and (recent.found < FOUND_LOST or recent.strange >= STRANGE_LOST)
