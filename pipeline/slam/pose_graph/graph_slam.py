"""SLAM by a pose graph: keyframes and landmarks in one least-squares problem that is solved as it grows.

x*, m* = argmin sum |f(x_k-1, u_k) - x_k|^2_Q + sum rho(|h(x_k, m_j) - z_kj|_R)

Where FastSLAM keeps hypotheses of the path and chooses among them, the graph keeps one and bends it: a loop
moves all keyframes behind it. What it took for the same tree it never unlearns.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.config.stages import Slam
from pipeline.geometry.gaussian import rows_of
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure.map_correction import Bend
from pipeline.slam import slip_detection
from pipeline.slam.association import births_of, hits_less_misses
from pipeline.slam.loop_correction import Loop
from pipeline.slam.motion import Motion, accumulated, compound, moved_pose, noise_of
from pipeline.slam.pose_graph.keyframe import observe, placed
from pipeline.slam.pose_graph.smoother import Additions
from pipeline.slam.pose_graph.state import NOTHING, GraphState
from pipeline.slam.pose_quality import is_astray, judged
from pipeline.slam.running_statistics import Doubted, Recent, remembered
from pipeline.slam.scan_statistics import ScanTold, disagreement
from pipeline.slam.state import SlamState
from pipeline.types.pose_health import Health
from pipeline.types.records import Detections, Int, Landmarks, PoseEstimate, PoseMeasurement

KEYFRAME = 0.25  # m; views from nearer places share their errors and cost as much


class GraphSlam:
    """The same face as FastSlam; its particles are the one pose that the graph has."""

    def __init__(self, parameters: Slam) -> None:
        self.parameters = parameters
        self.state = GraphState.of(SlamState.at_origin(1))

    def process(
        self, _index: int, motion: Pose2 | Motion, detections: Detections, clear_range: Float
    ) -> PoseEstimate:
        """See FastSlam.process."""
        motion = Motion(motion) if isinstance(motion, Pose2) else motion
        state, p, scan, doubt = self.state, self.parameters, ScanTold(), motion.doubt
        births: Int | None = None
        self._move(motion)
        due = state.since_update >= max(KEYFRAME, p.update_distance)
        due = due or motion.measured is not None or motion.slack != (0.0, 0.0)  # news that must not wait
        by_trees = self._by_trees(detections)
        slipped = by_trees.slipped or state.recent.slipped
        doubted = Doubted(bool(doubt), slipped)
        doubt = doubt or slip_detection.why(state.motion, slipped, by_trees.unsure)
        if by_trees.slipped or (due and (len(detections.cluster) or motion.measured is not None)):
            driven = state.since_update if np.isfinite(state.since_update) else 0.0
            away = disagreement(by_trees.motion, state.motion, state.motion_covariance)
            state.motion, state.motion_covariance = by_trees.motion, by_trees.covariance
            if by_trees.slipped:
                state.recent = replace(state.recent, distrust=1.0)
            scan, births = observe(state, p, motion, detections, clear_range)
            if by_trees.slipped:
                scan = replace(scan, odometry=away)
            state.recent = remembered(state.recent, scan, driven, doubted)
        state.keyframe_of.append(state.keyframes - 1)
        state.since.append(state.motion)
        estimate = self._estimate()
        health = judged(state.recent, scan, 1.0, 1, estimate.covariance, doubt)
        landmark_of = births_of(detections, estimate, self.landmarks()) if births is None else births
        return replace(estimate, health=health, landmark_of=landmark_of)

    def as_seen(self, pose: PoseMeasurement) -> PoseMeasurement:
        """See FastSlam.as_seen: the graph does not tell what poses of one source err by alike."""
        return pose

    def place(self, _index: int, T_map_base: Pose2, covariance: Float) -> None:
        """See FastSlam.place: a keyframe that no odometry leads to."""
        state = self.state
        additions = Additions()
        pose = T_map_base.as_array()
        additions.pose(state.keyframes, pose)
        additions.pose_prior(state.keyframes, pose, covariance)
        state.smoother.update(additions)
        state.keyframe_motion.append(NOTHING)
        state.pose, state.covariance = pose, covariance.copy()
        state.motion, state.motion_covariance = np.zeros(3), np.zeros((3, 3))
        state.since_update = np.inf
        state.recent = Recent(mapped=state.recent.mapped)

    def close(self, _index: int, loop: Loop) -> Bend:
        """See FastSlam.close: a keyframe where the loop ends, to which lead both the odometry and the
        keyframe that was taken near by before; the graph bends all between."""
        s, before, k = self.state, self.path(), self.state.keyframes
        pose, additions = loop.T_map_base.as_array(), Additions()
        additions.pose(k, pose)
        additions.odometry(k, s.motion, s.motion_covariance)
        scan = loop.anchor - len(s.past)
        if scan < 0:
            additions.pose_prior(k, pose, loop.covariance)
        else:
            i = s.keyframe_of[scan]
            known = s.smoother.estimate()[0][i]
            turn = np.eye(3)
            turn[:2, :2] = Pose2(*known).rotation()
            motion = (Pose2(*known).inverse() @ loop.T_map_base).as_array()
            additions.tie(i, k, motion, turn.T @ loop.covariance @ turn)
        poses, points = s.smoother.update(additions)
        s.keyframe_motion.append(s.motion)
        if s.keyframe_of:
            s.keyframe_of[-1], s.since[-1] = k, np.zeros(3)
        s.landmarks, s.pose = placed(s.landmarks, poses, points), poses[-1]
        s.covariance = s.smoother.joint_covariance(k, s.pose[2], [])
        s.motion, s.motion_covariance, s.since_update = np.zeros(3), np.zeros((3, 3)), np.inf
        s.recent = Recent(mapped=s.recent.mapped)
        return Bend(before, self.path(), loop.first, loop.last)

    @property
    def is_astray(self) -> bool:
        """Whether the known trees are not where they should be seen."""
        return is_astray(self.state.recent)

    def estimate(self, before: PoseEstimate) -> PoseEstimate:
        """See FastSlam.estimate."""
        return replace(self._estimate(), health=before.health, landmark_of=before.landmark_of)

    def lost(self, estimate: PoseEstimate) -> Health:
        """The health of an estimate that no tree has told anything of."""
        return judged(self.state.recent, ScanTold(), 1.0, 1, estimate.covariance)

    def give_up(self) -> None:
        """Judge the health anew: what the known trees said no longer counts."""
        self.state.recent = Recent(mapped=self.state.recent.mapped)

    def path(self) -> Float:
        """x, y [m], yaw [rad] at every scan as the graph has it now, shape (N, 3)."""
        return self.state.path()

    def landmarks(self) -> Landmarks:
        """Return all landmarks."""
        known, p = self.state.landmarks, self.parameters
        covariance = known.covariance.reshape(-1, 4)[:, [0, 1, 3]]
        score = hits_less_misses(known.hits, known.score, p.misses_per_hit)
        return Landmarks(known.birth, known.mean, covariance, score, p.gate, p.distance_max)

    def begun_since(self, scan: int) -> tuple[Float, Float]:
        """See FastSlam.begun_since."""
        s = self.state
        known, row = s.landmarks, max(scan - len(s.past), 0)
        k = s.keyframe_of[row] if row < len(s.keyframe_of) else s.keyframes
        rows = (known.begun >= k) & (known.hits >= self.parameters.hits_to_weigh)
        return known.mean[rows], known.covariance[rows].reshape(-1, 4)[:, [0, 1, 3]]

    def _move(self, motion: Motion) -> None:
        s = self.state
        moved = accumulated(s.motion, s.motion_covariance, motion, s.recent.distrust, self.parameters)
        if moved is not None:
            s.motion, s.motion_covariance = moved[0], moved[1]
            s.since_update += moved[2]
            s.driven += moved[2]

    def _by_trees(self, detections: Detections) -> slip_detection.ByTrees:
        """What the scan tells of the motion."""
        s, p = self.state, self.parameters
        known, pose = s.landmarks, moved_pose(s.pose, s.motion)
        away = known.mean - pose[:2]
        near = np.hypot(away[:, 0], away[:, 1]) < p.view_range + slip_detection.SEARCH
        return slip_detection.motion_by_trees(
            s.pose, s.motion, s.motion_covariance, s.since_update, s.recent.wheels(noise_of(p)),
            detections.centre, rows_of(detections.covariance), known.mean[near],
            rows_of(known.covariance[near]), known.hits[near], p.hits_to_weigh, p.gate,
        )  # fmt: skip

    def _estimate(self) -> PoseEstimate:
        s = self.state
        pose, covariance = compound(s.pose, s.covariance, Pose2(*s.motion), s.motion_covariance)
        known = s.landmarks
        return PoseEstimate(
            T_map_base=Pose2(*(float(value) for value in pose)),
            covariance=covariance,
            particles=pose[None],
            weights=np.ones(1),
            n_eff=1.0,
            landmarks=known.mean[known.hits >= self.parameters.hits_to_weigh],
            resampled=False,
        )
