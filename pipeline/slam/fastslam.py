"""FastSLAM 1.0 (Montemerlo et al. 2002): particles of the path, each with its own map of landmarks.

p(x_1:t, m | z_1:t, u_1:t) = p(x_1:t | z_1:t, u_1:t) prod_l p(m_l | x_1:t, z_1:t)         (Eq. 5)

The path is carried by particles that move with the odometry and its noise (Eq. 6); given a path the
landmarks are independent, so each particle keeps a small Kalman filter a landmark (Eq. 7).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry import Float, Pose2, mean_angle, wrap_angle
from pipeline.parameters.stages import Slam
from pipeline.records import Detections, Float32, Int32, PoseEstimate
from pipeline.slam.resampling import low_variance_ancestors, normalised, take_ancestors
from pipeline.slam.update import observe

FIRST_CAPACITY = 32


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """Everything FastSLAM knows; columns of P particles with room for M landmarks each.

    Attributes:
        pose: shape (P, 3): x, y [m], yaw [rad], in the frame of the map.
        log_weight: shape (P,), up to a constant.
        mean: shape (P, M, 2) [m]; covariance: shape (P, M, 3) [m^2]: xx, xy, yy.
        hits: int32, shape (P, M); score: float32, shape (P, M): hits less misses, the existence.
        count: int32, shape (P,): how many of the M places are landmarks.
        since_update: Distance driven since a scan was used [m].
    """

    pose: Float
    log_weight: Float
    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    count: Int32
    since_update: float

    @classmethod
    def at_origin(cls, particles: int) -> SlamState:
        """All particles at the origin, no landmark."""
        m = FIRST_CAPACITY
        return cls(
            np.zeros((particles, 3)),
            np.zeros(particles),
            np.zeros((particles, m, 2)),
            np.zeros((particles, m, 3)),
            np.zeros((particles, m), np.int32),
            np.zeros((particles, m), np.float32),
            np.zeros(particles, np.int32),
            0.0,
        )

    def copy(self) -> SlamState:
        """An independent copy, without the room that no landmark uses."""
        m = max(int(self.count.max()), 1)
        return replace(
            self,
            pose=self.pose.copy(),
            log_weight=self.log_weight.copy(),
            mean=self.mean[:, :m].copy(),
            covariance=self.covariance[:, :m].copy(),
            hits=self.hits[:, :m].copy(),
            score=self.score[:, :m].copy(),
            count=self.count.copy(),
        )

    def with_room(self, landmarks: int) -> SlamState:
        """The same state with room for so many landmarks more in every particle."""
        need = int(self.count.max()) + landmarks
        if need <= self.mean.shape[1]:
            return self
        extra = max(need, 2 * self.mean.shape[1]) - self.mean.shape[1]
        return replace(
            self,
            mean=np.pad(self.mean, ((0, 0), (0, extra), (0, 0))),
            covariance=np.pad(self.covariance, ((0, 0), (0, extra), (0, 0))),
            hits=np.pad(self.hits, ((0, 0), (0, extra))),
            score=np.pad(self.score, ((0, 0), (0, extra))),
        )

    def with_particles(self, particles: int) -> SlamState:
        """The same belief with another number of particles, drawn as low-variance resampling does."""
        if particles == len(self.pose):
            return self
        weights = normalised(self.log_weight)
        rows = np.searchsorted(np.cumsum(weights), (np.arange(particles) + 0.5) / particles)
        rows = np.minimum(rows, len(weights) - 1)
        return SlamState(
            self.pose[rows],
            np.zeros(particles),
            self.mean[rows],
            self.covariance[rows],
            self.hits[rows],
            self.score[rows],
            self.count[rows],
            self.since_update,
        )


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
        state = self.state.with_particles(p.particles).with_room(len(detections.cluster))
        _move(state.pose, motion, noise, p)
        since = state.since_update + float(np.hypot(motion.x, motion.y))
        resampled = False
        if index == 0 or since >= p.update_distance:
            since = 0.0
            self._observe(state, detections, clear_range)
        weights = normalised(state.log_weight)
        n_eff = float(1.0 / np.sum(weights**2))
        estimate = _estimate(state, weights, n_eff, p.hits_to_weigh)
        if n_eff < p.resample_below * p.particles:
            ancestors = low_variance_ancestors(weights, offset)
            take_ancestors(
                ancestors, state.pose, state.mean, state.covariance, state.hits, state.score, state.count
            )
            state.log_weight[:] = 0.0
            resampled = True
        self.state = replace(state, since_update=since)
        return replace(estimate, resampled=resampled)

    def _observe(self, state: SlamState, detections: Detections, clear_range: Float) -> None:
        p = self.parameters
        observe(
            state.pose,
            state.log_weight,
            state.mean,
            state.covariance,
            state.hits,
            state.score,
            state.count,
            detections.centre,
            detections.covariance,
            clear_range,
            p.gate,
            p.distance_max,
            p.hits_to_weigh,
            p.view_range,
            1.0 / p.misses_per_hit,
        )
        state.log_weight[:] -= state.log_weight.max()


def _move(pose: Float, motion: Pose2, noise: Float, p: Slam) -> None:
    """Motion model (Eq. 6): the odometry's step in the frame of each particle, with its noise.

    Variances grow with the distance and the turn, so many short steps scatter as one long step does.
    """
    distance = float(np.hypot(motion.x, motion.y))
    sigma_position = p.noise_distance * np.sqrt(distance)
    sigma_yaw = np.radians(np.sqrt(p.noise_turn_distance**2 * distance + p.noise_turn**2 * abs(motion.yaw)))
    dx = motion.x + sigma_position * noise[:, 0]
    dy = motion.y + sigma_position * noise[:, 1]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    pose[:, 0] += c * dx - s * dy
    pose[:, 1] += s * dx + c * dy
    pose[:, 2] = wrap_angle(pose[:, 2] + motion.yaw + sigma_yaw * noise[:, 2])


def _estimate(state: SlamState, weights: Float, n_eff: float, hits_to_show: int) -> PoseEstimate:
    yaw = mean_angle(state.pose[:, 2], weights)
    mean = np.array([weights @ state.pose[:, 0], weights @ state.pose[:, 1], yaw])
    deviation = state.pose - mean
    deviation[:, 2] = wrap_angle(deviation[:, 2])
    best = int(np.argmax(weights))
    known = state.hits[best, : state.count[best]] >= hits_to_show
    return PoseEstimate(
        T_map_base=Pose2(float(mean[0]), float(mean[1]), yaw),
        covariance=(deviation * weights[:, None]).T @ deviation,
        particles=state.pose.copy(),
        weights=weights,
        n_eff=n_eff,
        landmarks=state.mean[best, : state.count[best]][known],
        resampled=False,
    )
