"""What FastSLAM knows between two scans, as columns of particles and their landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry import Float
from pipeline.records import Float32, Int, Int32
from pipeline.slam.genealogy import Genealogy
from pipeline.slam.health import Recent
from pipeline.slam.resampling import normalised

FIRST_CAPACITY = 32


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """Columns of P particles with room for M landmarks each.

    Attributes:
        pose: shape (P, 3): x, y [m], yaw [rad] at the last scan that was used, frame of the map.
        log_weight: shape (P,), up to a constant.
        mean: shape (P, M, 2) [m]; covariance: shape (P, M, 3) [m^2]: xx, xy, yy.
        hits: int32, shape (P, M); score: float32, shape (P, M): hits less misses, the existence.
        birth: int64, shape (P, M): serial number of the detection that began the landmark; landmarks
            of two particles with the same birth are the same tree.
        count: int32, shape (P,): how many of the M places are landmarks.
        motion: shape (3,): motion by odometry since the last scan that was used.
        motion_covariance: shape (3, 3), of `motion`.
        since_update: Distance driven, and a metre per radian turned, since then [m].
        detections: How many detections were seen so far.
        best: The particle that explained the last scans best; its map and past are shown.
        genealogy: Where the particles came from.
        recent: What the health is judged by.
    """

    pose: Float
    log_weight: Float
    mean: Float
    covariance: Float
    hits: Int32
    score: Float32
    birth: Int
    count: Int32
    motion: Float
    motion_covariance: Float
    since_update: float
    detections: int
    best: int = 0
    genealogy: Genealogy = field(default_factory=Genealogy)
    recent: Recent = field(default_factory=Recent)

    @classmethod
    def at_origin(cls, particles: int) -> SlamState:
        """All particles at the origin, no landmark."""
        m = FIRST_CAPACITY
        return cls(
            pose=np.zeros((particles, 3)),
            log_weight=np.zeros(particles),
            mean=np.zeros((particles, m, 2)),
            covariance=np.zeros((particles, m, 3)),
            hits=np.zeros((particles, m), np.int32),
            score=np.zeros((particles, m), np.float32),
            birth=np.zeros((particles, m), np.int64),
            count=np.zeros(particles, np.int32),
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            since_update=0.0,
            detections=0,
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
            birth=self.birth[:, :m].copy(),
            count=self.count.copy(),
            motion=self.motion.copy(),
            motion_covariance=self.motion_covariance.copy(),
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
            birth=np.pad(self.birth, ((0, 0), (0, extra))),
        )

    def placed(self, pose: Float) -> SlamState:
        """All particles with the map and the past of the best one, at new poses, shape (P, 3)."""
        rows = np.full(len(pose), self.best)
        return replace(
            self,
            pose=pose,
            log_weight=np.zeros(len(pose)),
            mean=self.mean[rows],
            covariance=self.covariance[rows],
            hits=self.hits[rows],
            score=self.score[rows],
            birth=self.birth[rows],
            count=self.count[rows],
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            best=0,
            genealogy=self.genealogy.redrawn(rows),
            recent=Recent(mapped=self.recent.mapped),
        )

    def with_particles(self, particles: int) -> SlamState:
        """The same belief with another number of particles, drawn as low-variance resampling does."""
        if particles == len(self.pose):
            return self
        weights = normalised(self.log_weight)
        rows = np.searchsorted(np.cumsum(weights), (np.arange(particles) + 0.5) / particles)
        rows = np.minimum(rows, len(weights) - 1)
        return replace(
            self,
            pose=self.pose[rows],
            log_weight=np.zeros(len(rows)),
            mean=self.mean[rows],
            covariance=self.covariance[rows],
            hits=self.hits[rows],
            score=self.score[rows],
            birth=self.birth[rows],
            count=self.count[rows],
            best=min(int(np.searchsorted(rows, self.best)), particles - 1),
            genealogy=self.genealogy.redrawn(rows),
        )
