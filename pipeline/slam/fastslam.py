"""FastSLAM (Montemerlo et al. 2002, 2003): particles of the path, each with its own map of landmarks.

p(x_1:t, m | z_1:t, u_1:t) = p(x_1:t | z_1:t, u_1:t) prod_l p(m_l | x_1:t, z_1:t)         (Eq. 5)

The path is carried by particles that move with the odometry and its noise (Eq. 6); given a path the
landmarks are independent, so each particle keeps a small Kalman filter a landmark (Eq. 7).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.geometry import Float, Pose2, mean_angle, wrap_angle
from pipeline.parameters.stages import Slam
from pipeline.records import Detections, Int, PoseEstimate
from pipeline.slam.health import TOLD, ScanTold, judged, remembered, scan_told
from pipeline.slam.motion import compound, moved_poses, step_covariance
from pipeline.slam.resampling import low_variance_ancestors, normalised, take_ancestors
from pipeline.slam.state import SlamState
from pipeline.slam.update import observe

PLACED = 1  # tells the draws of a placing from those of a scan
TURN_AS_DISTANCE = 1.0  # m/rad; a robot that turns on the spot sees the trees anew as well


class FastSlam:
    """The filter. Its random numbers depend on the seed and the number of the scan alone, so that a
    changed parameter shows its own effect and not that of other draws."""

    def __init__(self, parameters: Slam, seed: int) -> None:
        self.parameters = parameters
        self._seed = seed
        self.state = SlamState.at_origin(parameters.particles)

    def process(self, index: int, motion: Pose2, detections: Detections, clear_range: Float) -> PoseEstimate:
        """Move with the odometry, weigh by the detections, and resample when it is due.

        Args:
            index: Number of the scan.
            motion: T_base(t-1)_base(t) by the odometry.
            detections: Trees in the base frame.
            clear_range: shape (bins,) [m]: how far the view is free by direction (see visibility).
        """
        p = self.parameters
        rng = np.random.default_rng([self._seed, index])
        noise = rng.standard_normal((p.particles, 3))
        offset = float(rng.random())
        state = self._moved(self.state.with_particles(p.particles), motion)
        used = index == 0 or state.since_update >= p.update_distance
        told, driven, spread = np.zeros((p.particles, TOLD)), state.since_update, state.motion_covariance
        if used:
            state = self._observed(state, detections, clear_range, noise, told)
        weights = normalised(state.log_weight)
        scan = ScanTold()
        if used:
            scan = scan_told(told, weights, len(detections.cluster), spread)
            recent = remembered(state.recent, scan, driven)
            state = replace(state, best=int(np.argmax(weights)), recent=recent)
        estimate = _estimate(state, weights, p.hits_to_weigh)
        ancestors = None
        if used and estimate.n_eff < p.resample_below * p.particles:
            ancestors = low_variance_ancestors(weights, offset)
            _resample(state, ancestors)
            estimate = replace(estimate, resampled=True)
        genealogy = state.genealogy.with_scan(estimate.particles, ancestors, state.best)
        self.state = replace(state, genealogy=genealogy)
        return replace(
            estimate,
            health=judged(
                state.recent, scan, estimate.n_eff, genealogy.distinct_ancestors, estimate.covariance
            ),
        )

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Put all particles where another source says the base is now, with the map of the best one.

        Args:
            index: Number of the scan, for the draws.
            T_map_base: The pose; covariance: of x, y [m], yaw [rad], shape (3, 3).
        """
        rng = np.random.default_rng([self._seed, index, PLACED])
        noise = rng.standard_normal((self.parameters.particles, 3))
        values, axes = np.linalg.eigh(covariance)
        pose = T_map_base.as_array() + noise @ (axes * np.sqrt(np.maximum(values, 0.0))).T
        pose[:, 2] = wrap_angle(pose[:, 2])
        self.state = self.state.placed(pose)

    def path(self) -> Float:
        """x, y [m], yaw [rad] at every scan as the best particle has it behind it, shape (N, 3)."""
        return self.state.genealogy.path(self.state.best)

    def landmarks(self) -> tuple[Float, Float]:
        """All landmarks of the best particle: positions, shape (L, 2) [m], and covariances xx, xy, yy,
        shape (L, 3) [m^2]."""
        best, count = self.state.best, self.state.count[self.state.best]
        return self.state.mean[best, :count], self.state.covariance[best, :count]

    def _moved(self, state: SlamState, step: Pose2) -> SlamState:
        motion, covariance = compound(
            state.motion, state.motion_covariance, step, step_covariance(step, self.parameters)
        )
        turned = abs(float(wrap_angle(step.yaw)))
        driven = float(np.hypot(step.x, step.y)) + TURN_AS_DISTANCE * turned
        return replace(
            state, motion=motion, motion_covariance=covariance, since_update=state.since_update + driven
        )

    def _observed(
        self, state: SlamState, detections: Detections, clear_range: Float, noise: Float, told: Float
    ) -> SlamState:
        p = self.parameters
        state = state.with_room(len(detections.cluster))
        observe(
            state.pose,
            state.log_weight,
            state.mean,
            state.covariance,
            state.hits,
            state.score,
            state.birth,
            state.count,
            state.motion,
            state.motion_covariance,
            noise,
            detections.centre,
            detections.covariance,
            clear_range,
            state.detections,
            p.method == "fastslam2",
            p.gate,
            p.distance_max,
            p.hits_to_weigh,
            p.view_range,
            1.0 / p.misses_per_hit,
            p.looks,
            p.merge_gate,
            p.miss_weight,
            told,
        )
        state.log_weight[:] -= state.log_weight.max()
        return replace(
            state,
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            since_update=0.0,
            detections=state.detections + len(detections.cluster),
        )


def _resample(state: SlamState, ancestors: Int) -> None:
    take_ancestors(
        ancestors,
        state.pose,
        state.mean,
        state.covariance,
        state.hits,
        state.score,
        state.birth,
        state.count,
    )
    state.log_weight[:] = 0.0


def _estimate(state: SlamState, weights: Float, hits_to_show: int) -> PoseEstimate:
    pose = moved_poses(state.pose, state.motion)
    yaw = mean_angle(pose[:, 2], weights)
    mean = np.array([weights @ pose[:, 0], weights @ pose[:, 1], yaw])
    deviation = pose - mean
    deviation[:, 2] = wrap_angle(deviation[:, 2])
    best = state.best
    known = state.hits[best, : state.count[best]] >= hits_to_show
    heading = yaw - state.motion[2]  # of the frame in which the covariance of the motion is
    C = np.eye(3)
    C[:2, :2] = Pose2(yaw=heading).rotation()
    return PoseEstimate(
        T_map_base=Pose2(float(mean[0]), float(mean[1]), yaw),
        covariance=(deviation * weights[:, None]).T @ deviation + C @ state.motion_covariance @ C.T,
        particles=pose,
        weights=weights,
        n_eff=float(1.0 / np.sum(weights**2)),
        landmarks=state.mean[best, : state.count[best]][known],
        resampled=False,
    )
