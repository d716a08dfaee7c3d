"""What the pose graph knows between two scans, and how it is handed to particles and taken from them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.geometry.poses import Float, wrap_angle
from pipeline.slam.particle_ancestry import Genealogy
from pipeline.slam.particle_maps import MapColumns
from pipeline.slam.pose_graph.landmarks import Landmarks, Sightings, no_sightings
from pipeline.slam.pose_graph.smoother import Additions, Smoother
from pipeline.slam.poses import interpolated
from pipeline.slam.resampling import normalised
from pipeline.slam.running_statistics import Recent
from pipeline.slam.state import SlamState

HANDED_OVER = 2  # distinguishes these draws from those of a scan and of a placing
NOTHING = np.full(3, np.nan)  # the odometry to a keyframe that it does not lead to


@dataclass(slots=True, eq=False)
class GraphState:
    """A graph of K keyframes, and N scans.

    Attributes:
        smoother: Holds the factors.
        landmarks: All of them; sightings: of those that are not in the graph yet.
        pose: x, y [m], yaw [rad] of the last keyframe, shape (3,); covariance: shape (3, 3).
        motion, motion_covariance: By the odometry since then, in its frame.
        since_update: Distance driven, and a metre per radian turned, since then [m].
        driven: The same since the beginning [m].
        past: Path before the graph began, shape (M, 3).
        keyframe_motion: By the odometry to each keyframe, K rows of shape (3,).
        keyframe_of: The last keyframe of each scan; since: motion by odometry since then; N - M rows.
        detections: How many detections were seen so far.
        recent: What the health is judged by.
    """

    smoother: Smoother
    landmarks: Landmarks
    pose: Float
    covariance: Float
    motion: Float
    motion_covariance: Float
    past: Float
    since_update: float = np.inf  # so that the first scan is used
    driven: float = 0.0
    sightings: Sightings = field(default_factory=no_sightings)
    keyframe_motion: list[Float] = field(default_factory=lambda: [NOTHING])
    keyframe_of: list[int] = field(default_factory=list)
    since: list[Float] = field(default_factory=list)
    detections: int = 0
    recent: Recent = field(default_factory=Recent)

    def copy(self) -> GraphState:
        """An independent copy; its cost grows with the run (see Smoother.copy)."""
        return replace(
            self,
            smoother=self.smoother.copy(),
            keyframe_motion=self.keyframe_motion.copy(),
            keyframe_of=self.keyframe_of.copy(),
            since=self.since.copy(),
        )

    @property
    def keyframes(self) -> int:
        """How many there are."""
        return len(self.keyframe_motion)

    def path(self) -> Float:
        """x, y [m], yaw [rad] at every scan, shape (N, 3)."""
        if not self.keyframe_of:
            return self.past.copy()
        poses, _ = self.smoother.estimate()
        motions, since = np.array(self.keyframe_motion), np.array(self.since)
        rows = interpolated(poses, motions, np.array(self.keyframe_of, np.int64), since)
        return np.concatenate([self.past, rows])

    @classmethod
    def of(cls, slam: SlamState) -> GraphState:
        """A graph that goes on where particles are: the best one's map and pose, the spread of all.

        What the map's landmarks share of their errors is not known any more, and its past stays as it is.
        """
        pose = slam.pose[slam.best]
        weights = normalised(slam.log_weight)
        away = slam.pose - pose
        away[:, 2] = wrap_angle(away[:, 2])
        covariance = (weights[:, None] * away).T @ away
        known = slam.map_of(slam.best)
        full = known.covariance[:, [[0, 1], [1, 2]]]
        additions = Additions()
        additions.pose(0, pose)
        additions.pose_prior(0, pose, covariance)
        for j, (place, C) in enumerate(zip(known.mean, full, strict=True)):
            additions.point(j, place)
            additions.point_prior(j, place, C)
        smoother = Smoother()
        smoother.update(additions)
        L = len(known.hits)
        landmarks = Landmarks(
            np.arange(L), np.zeros(L, np.int64), np.zeros((L, 2)), known.mean, full,
            known.hits, known.score.astype(np.float64), known.birth, np.zeros(L), np.zeros(L, np.int64),
        )  # fmt: skip
        return cls(
            smoother, landmarks, pose.copy(), covariance,
            slam.motion.copy(), slam.motion_covariance.copy(), slam.genealogy.path(slam.best),
            detections=slam.detections, recent=slam.recent,
            since_update=slam.since_update if len(slam.genealogy) else np.inf,
        )  # fmt: skip

    def as_particles(self, particles: int, seed: int) -> SlamState:
        """Particles spread as the last keyframe is, all with the graph's map and path: what the graph
        knows of the errors that landmarks share is lost."""
        path = self.path()
        values, axes = np.linalg.eigh(self.covariance)
        rng = np.random.default_rng([seed, len(path), HANDED_OVER])
        noise = rng.standard_normal((particles, 3))
        pose = self.pose + noise @ (axes * np.sqrt(np.maximum(values, 0.0))).T
        pose[:, 2] = wrap_angle(pose[:, 2])
        known = self.landmarks
        flat = known.covariance.reshape(-1, 4)[:, [0, 1, 3]]
        columns = MapColumns(known.mean, flat, known.hits, known.score.astype(np.float32), known.birth)
        return replace(
            SlamState.in_map(pose, columns),
            motion=self.motion.copy(),
            motion_covariance=self.motion_covariance.copy(),
            since_update=float(min(self.since_update, 1e9)),
            detections=self.detections,
            genealogy=Genealogy.of_path(path, particles),
            recent=self.recent,
        )
