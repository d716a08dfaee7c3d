"""State of FastSLAM between two scans, as arrays over particles and landmarks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.slam.frame_uncertainty import FrameUncertainty
from pipeline.slam.keyframe_graph import KeyframeGraph, ScanDetections
from pipeline.slam.measured_pose import SharedErrors
from pipeline.slam.particle_ancestry import EstimatedPath, Genealogy, normalised
from pipeline.slam.particle_maps import MapColumns, Maps, empty_maps, map_of, shared_map, taken
from pipeline.slam.places import Places
from pipeline.slam.pose_quality import RunningStatistics
from pipeline.types.records import NOT_SAVED


@dataclass(frozen=True, slots=True, eq=False)
class SlamState:
    """State of P particles with their maps.

    Attributes:
        pose: x, y [m], yaw [rad] at the last used scan in the frame of the map, shape (P, 3).
        log_weight: Log weights up to a constant, shape (P,).
        maps: Landmarks of all particles; the method `map_of` returns those of one.
        motion: Motion by odometry since the last used scan, shape (3,).
        motion_covariance: Covariance of `motion`, shape (3, 3).
        slack: Sum of the slack of position [m] and heading [rad] of the odometry since trees or a measured
            pose last determined the pose, shape (2,), see `motion.accumulated`.
        since_update: Distance driven since the last used scan [m], with 1 m per radian of rotation.
        detections: Number of detections in all scans so far; the next detection gets this birth number.
        views: Number of scans whose detections were used.
        best: Row of the best particle, whose map is reported.
        genealogy: Ancestors of the particles and their paths.
        path: Estimated pose of each scan.
        recent: Running statistics, from which the quality of the pose is derived.
        frame: Lower bound of the pose covariance in the frame of the map.
        graph: Graph of keyframes and landmarks.
        keyframe_motion: Motion by odometry since the last keyframe, shape (3,).
        keyframe_covariance: Covariance of `keyframe_motion`, shape (3, 3).
        distance: Distance driven [m], with 1 m per radian of rotation.
        since_keyframe: Detections of the scans since the last keyframe.
        places: Places of the path, and which of them are active.
        shared: Errors that the measured poses of one source share. They are not saved, because the source of
            a continued run has other errors.
    """

    pose: Float
    log_weight: Float
    maps: Maps
    motion: Float
    motion_covariance: Float
    slack: Float = field(default_factory=lambda: np.zeros(2))
    since_update: float = 0.0
    detections: int = 0
    views: int = 0
    best: int = 0
    genealogy: Genealogy = field(default_factory=Genealogy)
    path: EstimatedPath = field(default_factory=EstimatedPath)
    recent: RunningStatistics = field(default_factory=RunningStatistics)
    frame: FrameUncertainty = field(default_factory=FrameUncertainty)
    graph: KeyframeGraph = field(default_factory=KeyframeGraph)
    keyframe_motion: Float = field(default_factory=lambda: np.zeros(3))
    keyframe_covariance: Float = field(default_factory=lambda: np.zeros((3, 3)))
    distance: float = 0.0
    since_keyframe: tuple[ScanDetections, ...] = ()
    places: Places = field(default_factory=Places)
    shared: SharedErrors = field(default_factory=SharedErrors, metadata={NOT_SAVED: True})

    @classmethod
    def at_origin(cls, particles: int) -> SlamState:
        """Return the state of a new map: this number of particles at the origin (0, 0, 0), with zero log
        weights and without landmarks."""
        return cls(
            pose=np.zeros((particles, 3)),
            log_weight=np.zeros(particles),
            maps=empty_maps(particles),
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
        )

    @classmethod
    def in_map(cls, pose: Float, landmarks: MapColumns) -> SlamState:
        """Return a state in which all particles have the same known map. The next detection gets a birth
        number above all of theirs; path, graph and places are empty.

        Args:
            pose: Poses of the particles, shape (P, 3).
            landmarks: Landmarks of the map.
        """
        return replace(
            cls.at_origin(len(pose)),
            pose=pose.copy(),
            maps=shared_map(len(pose), landmarks),
            detections=int(landmarks.birth.max(initial=-1)) + 1,
        )

    def map_of(self, particle: int) -> MapColumns:
        """Return a copy of the landmarks of one particle. Removed landmarks are not among them."""
        return MapColumns(*map_of(self.maps, particle))

    def copy(self) -> SlamState:
        """Return an independent copy, without unused capacity. Immutable parts (ancestry, graph, places,
        statistics) are shared."""
        return self._drawn(np.arange(len(self.pose)))

    def placed(self, pose: Float) -> SlamState:
        """Return a state with the particles at new poses, all with the map and the path of the best particle.

        Weights, the motion since the last used scan, its slack, running statistics (except `mapped`), shared
        errors and the hidden covariance of the frame are reset; `since_update` is added to `distance`. All
        other attributes remain, also `path`, the graph, the motion since the last keyframe and the places.

        Args:
            pose: New poses, shape (P, 3), not copied; P may differ from the present number.
        """
        rows = np.full(len(pose), self.best)
        return replace(
            self,
            pose=pose,
            log_weight=np.zeros(len(pose)),
            maps=taken(self.maps, rows),
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            slack=np.zeros(2),
            since_update=0.0,
            distance=self.distance + self.since_update,
            best=0,
            genealogy=self.genealogy.redrawn(rows),
            recent=RunningStatistics(mapped=self.recent.mapped),
            frame=self.frame.without_hidden(),
            shared=SharedErrors(),
        )

    def with_particles(self, particles: int) -> SlamState:
        """Return the state resampled to another number of particles, systematically by their weights with the
        offset 1/2, with equal weights; the state itself if the number is unchanged. `best` is the first copy
        of the best particle, or the next selected particle if the best one is not selected."""
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
        """Return the state with copies of the poses, weights, maps and shared errors of the given rows,
        int64, shape (P,), which may repeat. The ancestry and the row `best` remain those of the state; the
        caller replaces them."""
        return replace(
            self,
            pose=self.pose[rows],
            log_weight=self.log_weight[rows],
            maps=taken(self.maps, rows),
            motion=self.motion.copy(),
            motion_covariance=self.motion_covariance.copy(),
            shared=self.shared.drawn(rows),
        )
