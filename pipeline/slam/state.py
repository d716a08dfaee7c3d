"""What FastSLAM knows between two scans, as columns of particles and their landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.io.checkpoints.codec import ADDED, NOT_SAVED
from pipeline.slam.frame_uncertainty import FrameMemory
from pipeline.slam.keyframe_graph import KeyframeGraph, ScanDetections
from pipeline.slam.particle_ancestry import Genealogy
from pipeline.slam.particle_maps import MapColumns, Maps, empty_maps, map_of, shared_map, taken
from pipeline.slam.resampling import normalised
from pipeline.slam.running_statistics import Recent
from pipeline.slam.shared_errors import SharedErrors


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """Columns of P particles.

    Attributes:
        pose: shape (P, 3): x, y [m], yaw [rad] at the last scan that was used, frame of the map.
        log_weight: shape (P,), up to a constant.
        maps: The landmarks of all particles; `map_of` gives those of one.
        motion: shape (3,): motion by odometry since the last scan that was used.
        motion_covariance: shape (3, 3), of `motion`.
        since_update: Distance driven, and a metre per radian turned, since then [m].
        detections: How many detections were seen so far.
        best: The particle that explained the last scans best; its map and past are shown.
        genealogy: Where the particles came from.
        recent: What the health is judged by.
        frame: How well the frame was known where landmarks were begun.
        graph: Keyframes and the landmarks that they show.
        keyframe_motion: Motion since the last keyframe, shape (3,); keyframe_covariance: of it, shape (3, 3).
        distance: Distance driven, and a metre per radian turned [m].
        since_keyframe: Detections of the scans since the last keyframe.
        shared: Error that the measured poses of one source share; it is not saved, because another source has
            another error.
    """

    pose: Float
    log_weight: Float
    maps: Maps
    motion: Float
    motion_covariance: Float
    since_update: float = 0.0
    detections: int = 0
    best: int = 0
    genealogy: Genealogy = field(default_factory=Genealogy)
    recent: Recent = field(default_factory=Recent)
    frame: FrameMemory = field(default_factory=FrameMemory)
    graph: KeyframeGraph = field(default_factory=KeyframeGraph, metadata={ADDED: None})
    keyframe_motion: Float = field(default_factory=lambda: np.zeros(3), metadata={ADDED: None})
    keyframe_covariance: Float = field(default_factory=lambda: np.zeros((3, 3)), metadata={ADDED: None})
    distance: float = field(default=0.0, metadata={ADDED: None})
    since_keyframe: tuple[ScanDetections, ...] = field(default=(), metadata={ADDED: None})
    shared: SharedErrors = field(default_factory=SharedErrors, metadata={NOT_SAVED: True})

    @classmethod
    def at_origin(cls, particles: int) -> SlamState:
        """All particles at the origin, no landmark."""
        return cls(
            pose=np.zeros((particles, 3)),
            log_weight=np.zeros(particles),
            maps=empty_maps(particles),
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
        )

    @classmethod
    def in_map(cls, pose: Float, landmarks: MapColumns) -> SlamState:
        """Particles at poses of shape (P, 3), all with the same landmarks: to go on in a known map."""
        return replace(
            cls.at_origin(len(pose)),
            pose=pose.copy(),
            maps=shared_map(len(pose), landmarks),
            detections=int(landmarks.birth.max(initial=-1)) + 1,
        )

    def map_of(self, particle: int) -> MapColumns:
        """The landmarks of one particle, copied."""
        return MapColumns(*map_of(self.maps, particle))

    def copy(self) -> SlamState:
        """An independent copy, without the room that no landmark uses."""
        return self._drawn(np.arange(len(self.pose)))

    def placed(self, pose: Float) -> SlamState:
        """All particles with the map and the past of the best one, at new poses, shape (P, 3)."""
        rows = np.full(len(pose), self.best)
        return replace(
            self,
            pose=pose,
            log_weight=np.zeros(len(pose)),
            maps=taken(self.maps, rows),
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            best=0,
            genealogy=self.genealogy.redrawn(rows),
            recent=Recent(mapped=self.recent.mapped),
            frame=self.frame.forgotten(),
            shared=SharedErrors(),
        )

    def with_particles(self, particles: int) -> SlamState:
        """The same belief with another number of particles, drawn as low-variance resampling does."""
        if particles == len(self.pose):
            return self
        weights = normalised(self.log_weight)
        rows = np.searchsorted(np.cumsum(weights), (np.arange(particles) + 0.5) / particles)
        rows = np.minimum(rows, len(weights) - 1)
        return replace(
            self._drawn(rows),
            log_weight=np.zeros(len(rows)),
            best=min(int(np.searchsorted(rows, self.best)), particles - 1),
            genealogy=self.genealogy.redrawn(rows),
        )

    def _drawn(self, rows: np.ndarray[tuple[int], np.dtype[np.int64]]) -> SlamState:
        return replace(
            self,
            pose=self.pose[rows],
            log_weight=self.log_weight[rows],
            maps=taken(self.maps, rows),
            motion=self.motion.copy(),
            motion_covariance=self.motion_covariance.copy(),
            shared=self.shared.drawn(rows),
        )
