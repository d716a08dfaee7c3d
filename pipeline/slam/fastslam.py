"""FastSLAM (Montemerlo et al. 2002, 2003): particles of the path, each with its own map of landmarks.

p(x_1:t, m | z_1:t, u_1:t) = p(x_1:t | z_1:t, u_1:t) prod_l p(m_l | x_1:t, z_1:t)         (Eq. 5)

The path is carried by particles that move with the odometry and its noise (Eq. 6); given a path the
landmarks are independent, so each particle keeps a small Kalman filter a landmark (Eq. 7).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pipeline.geometry import Float, Pose2, wrap_angle
from pipeline.health import Health
from pipeline.parameters.stages import Slam
from pipeline.records import Detections, PoseEstimate, PoseMeasurement
from pipeline.slam import slip
from pipeline.slam.frame import FrameMemory
from pipeline.slam.health import TOLD, Recent, ScanTold, is_astray, judged, remembered, scan_told
from pipeline.slam.maps import ROOM, blocks_in_reach, take_ancestors, with_room
from pipeline.slam.motion import Motion, accumulated, moved_poses, weighted_pose
from pipeline.slam.pairs import Room, room_for
from pipeline.slam.resampling import low_variance_ancestors, normalised
from pipeline.slam.state import SlamState
from pipeline.slam.update import Near, Rules, near_for, observe, predict

PLACED = 1  # tells the draws of a placing from those of a scan


class FastSlam:
    """The filter. Its random numbers depend on the seed and the number of the scan alone, so that a
    changed parameter shows its own effect and not that of other draws."""

    def __init__(self, parameters: Slam, seed: int) -> None:
        self.parameters = parameters
        self._seed = seed
        self.state = SlamState.at_origin(parameters.particles)
        self._near, self._room = near_for(0), room_for(0, 0)  # memory of the kernels, no state

    def process(
        self, index: int, motion: Pose2 | Motion, detections: Detections, clear_range: Float
    ) -> PoseEstimate:
        """Move with the odometry, weigh by the detections, and resample when it is due.

        Args:
            index: Number of the scan.
            motion: T_base(t-1)_base(t) by the odometry, alone or with what else is known of it.
            detections: Trees in the base frame.
            clear_range: shape (bins,) [m]: how far the view is free by direction (see visibility).
        """
        p = self.parameters
        rng = np.random.default_rng([self._seed, index])
        noise = rng.standard_normal((p.particles, 3))
        offset = float(rng.random())
        motion = Motion(motion) if isinstance(motion, Pose2) else motion
        state = self._moved(self.state.with_particles(p.particles), motion)
        scan, ancestors, doubt = ScanTold(), None, motion.doubt
        used = index == 0 or state.since_update >= p.update_distance
        if used:
            state, slipped = self._against_slip(state, detections)
            doubt = doubt or ("the trees contradict the odometry: corrected by them" if slipped else "")
            state, scan = self._observed(state, detections, clear_range, noise, motion.measured)
        weights = normalised(state.log_weight)
        estimate, frame = _estimate(state, weights, p, _farthest(detections) if used else 0.0)
        if used and len(detections.cluster):
            serial = state.detections - len(detections.cluster)
            frame = frame.marked(serial, estimate.T_map_base.as_array(), estimate.covariance)
        if used and estimate.n_eff < p.resample_below * p.particles:
            ancestors = low_variance_ancestors(weights, offset)
            take_ancestors(ancestors, state.pose, state.maps)
            state.log_weight[:] = 0.0
        genealogy = state.genealogy.with_scan(estimate.particles, ancestors, state.best)
        self.state = replace(state, genealogy=genealogy, frame=frame)
        health = judged(
            state.recent, scan, estimate.n_eff, genealogy.distinct_ancestors, _relative(estimate), doubt
        )
        return replace(estimate, resampled=ancestors is not None, health=health)

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

    @property
    def is_astray(self) -> bool:
        """Whether the known trees are not where they should be seen."""
        return is_astray(self.state.recent)

    def estimate(self, before: PoseEstimate) -> PoseEstimate:
        """After `place`: the pose, with the health of an estimate before it."""
        weights = normalised(self.state.log_weight)
        estimate, _ = _estimate(self.state, weights, self.parameters, 0.0)
        return replace(estimate, health=before.health)

    def lost(self, estimate: PoseEstimate) -> Health:
        """The health of an estimate that no tree has told anything of."""
        ancestors = self.state.genealogy.distinct_ancestors
        return judged(self.state.recent, ScanTold(), estimate.n_eff, ancestors, _relative(estimate))

    def give_up(self) -> None:
        """Judge the health anew: what the known trees said no longer counts."""
        self.state = replace(self.state, recent=Recent(mapped=self.state.recent.mapped))

    def path(self) -> Float:
        """x, y [m], yaw [rad] at every scan as the best particle has it behind it, shape (N, 3)."""
        return self.state.genealogy.path(self.state.best)

    def landmarks(self) -> tuple[Float, Float]:
        """All landmarks of the best particle: positions, shape (L, 2) [m], and covariances xx, xy, yy,
        shape (L, 3) [m^2]."""
        landmarks = self.state.map_of(self.state.best)
        return landmarks.mean, landmarks.covariance

    def _moved(self, state: SlamState, motion: Motion) -> SlamState:
        moved = accumulated(
            state.motion, state.motion_covariance, motion, state.recent.distrust, self.parameters
        )
        if moved is None:
            return state
        return replace(
            state,
            motion=moved[0],
            motion_covariance=moved[1],
            since_update=state.since_update + moved[2],
        )

    def _against_slip(self, state: SlamState, detections: Detections) -> tuple[SlamState, bool]:
        """Put the motion right where the scan contradicts the map that the best particle knows well."""
        if len(detections.cluster) < slip.FEWEST or not state.recent.mapped:
            return state, False
        p, known = self.parameters, state.map_of(state.best)
        landmarks = known.mean[known.hits >= p.hits_to_weigh]
        motion = slip.motion_by_trees(
            state.pose[state.best], state.motion, state.motion_covariance, detections, landmarks,
            p.view_range, p.gate,
        )  # fmt: skip
        if motion is None:
            return state, False
        covariance = state.motion_covariance + np.diag(slip.SIGMA**2)
        recent = replace(state.recent, distrust=1.0)
        return replace(state, motion=motion, motion_covariance=covariance, recent=recent), True

    def _observed(
        self,
        state: SlamState,
        detections: Detections,
        clear_range: Float,
        noise: Float,
        measured: PoseMeasurement | None,
    ) -> tuple[SlamState, ScanTold]:
        p, found = self.parameters, len(detections.cluster)
        centre = detections.centre
        reach = max(p.view_range, _farthest(detections) + p.distance_max) if found else p.view_range
        rules = _rules(p)
        moved = predict(state.pose, state.motion, state.motion_covariance, noise, rules.use_proposal)
        blocks, lengths, rows = blocks_in_reach(state.maps, moved, reach, found)
        maps = with_room(state.maps, found, rows)
        known = int(lengths.max()) * ROOM
        told = np.zeros((len(moved), TOLD))
        observe(
            state.pose, moved, state.log_weight, maps, blocks, lengths, state.motion,
            state.motion_covariance, noise, centre, detections.covariance.reshape(-1, 4)[:, [0, 1, 3]],
            clear_range, reach, state.detections, rules, *self._memory(known + found, found), told,
            *_arrays(measured),
        )  # fmt: skip
        state.log_weight[:] -= state.log_weight.max()
        scan = scan_told(told, normalised(state.log_weight), found, state.motion_covariance)
        state = replace(
            state,
            maps=maps,
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            since_update=0.0,
            detections=state.detections + found,
            best=int(np.argmax(state.log_weight)),
            recent=remembered(state.recent, scan, state.since_update),
        )
        return state, scan

    def _memory(self, landmarks: int, found: int) -> tuple[Near, Room]:
        """Memory for so many landmarks in reach of a particle and so many detections."""
        if landmarks > len(self._near.hits) or found > len(self._room.best):
            landmarks, found = 2 * landmarks, 2 * found
            self._near, self._room = near_for(landmarks), room_for(found, landmarks)
        return self._near, self._room


def _farthest(detections: Detections) -> float:
    """Distance of the farthest one [m], 0 where there is none."""
    centre = detections.centre
    return math.sqrt(float((centre * centre).sum(axis=1).max(initial=0.0)))


def _relative(estimate: PoseEstimate) -> Float:
    return estimate.covariance if estimate.relative is None else estimate.relative


def _arrays(measured: PoseMeasurement | None) -> tuple[Float, Float]:
    if measured is None:
        return np.zeros(0), np.eye(3)
    return measured.T_map_base.as_array(), measured.covariance


def _rules(p: Slam) -> Rules:
    return Rules(
        use_proposal=p.method != "fastslam1",
        gate=p.gate,
        distance_max=p.distance_max,
        hits_to_weigh=p.hits_to_weigh,
        view_range=p.view_range,
        miss=1.0 / p.misses_per_hit,
        miss_weight=p.miss_weight,
        weight_power=p.weight_power,
        looks=p.looks,
        merge_gate=p.merge_gate,
    )


def _estimate(state: SlamState, weights: Float, p: Slam, reach: float) -> tuple[PoseEstimate, FrameMemory]:
    pose = moved_poses(state.pose, state.motion)
    mean, spread = weighted_pose(pose, weights, state.motion, state.motion_covariance)
    landmarks = state.map_of(state.best)
    covariance, frame = state.frame.told(
        mean, spread, landmarks.mean, landmarks.birth, landmarks.hits, p.hits_to_weigh, reach
    )
    return PoseEstimate(
        T_map_base=Pose2(float(mean[0]), float(mean[1]), float(mean[2])),
        covariance=covariance,
        particles=pose,
        weights=weights,
        n_eff=1.0 / float(weights @ weights),
        landmarks=landmarks.mean[landmarks.hits >= p.hits_to_weigh],
        resampled=False,
        relative=spread,
    ), frame
