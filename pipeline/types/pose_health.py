"""Quality of a pose, for the page and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

HealthState = Literal["good", "weak", "lost"]


@dataclass(frozen=True, slots=True)
class Health:
    """Quality of the pose after a scan.

    Attributes:
        state: "good"; "weak": the map may be wrong; "lost": the pose is not usable.
        reason: Message with the reason; empty if good.
        n_eff: Effective number of particles.
        ancestors: Number of particles of 50 to 100 scans ago that have descendants.
        detections: Number of detections in the scan.
        recognised: Number of detections of well known landmarks, mean over the particles.
        ambiguous: Number of detections with two likely landmarks, mean over the particles.
        innovation: Normalised innovation squared per degree of freedom, mean over the scan: 1 if the errors
            agree with their covariances; NaN without a known landmark.
        sigma_xy: Standard deviation of the position [m].
        sigma_yaw: Standard deviation of the heading [rad].
        odometry: Difference between the pose and the prediction by odometry [sigma].
        doubt: Message why the odometry may be wrong; the pose may be good nevertheless.
    """

    state: HealthState = "good"
    reason: str = ""
    n_eff: float = 0.0
    ancestors: int = 0
    detections: int = 0
    recognised: float = 0.0
    ambiguous: float = 0.0
    innovation: float = float("nan")
    sigma_xy: float = 0.0
    sigma_yaw: float = 0.0
    odometry: float = 0.0
    doubt: str = ""

    def warnings(self, reported: str) -> tuple[str, ...]:
        """Return the doubt about the odometry as a tuple of one warning; empty without a doubt, or if the
        doubt equals the text `reported`, which was reported before."""
        return (self.doubt,) if self.doubt not in ("", reported) else ()
