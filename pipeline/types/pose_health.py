"""How far a pose can be trusted, as people and programs are told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

HealthState = Literal["good", "weak", "lost"]


@dataclass(frozen=True, slots=True)
class Health:
    """How far the pose can be trusted after a scan.

    Attributes:
        state: "good"; "weak": the map may suffer; "lost": the pose means nothing.
        reason: Why, in words for people; empty when good.
        n_eff: Effective number of particles.
        ancestors: How many particles of 50 to 100 scans ago are ancestors of those of today.
        detections: Detections in the scan; recognised: those of them that are well known landmarks
            (mean over the particles); ambiguous: those with two likely landmarks (likewise).
        innovation: Normalised innovation squared a degree of freedom, mean over the scan: 1 where the
            errors are as large as their covariances say; NaN where no known landmark was recognised.
        sigma_xy: Standard deviation of the position [m]; sigma_yaw: of the heading [rad].
        odometry: How far the scan moved the pose away from what the odometry said [sigma].
        doubt: Why the odometry is not believed, for people; it may be good nevertheless, by the trees.
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

    def warnings(self, said: str) -> tuple[str, ...]:
        """Of what people are warned: of an odometry that is not believed, where that was not `said` yet."""
        return (self.doubt,) if self.doubt not in ("", said) else ()
