"""FastSLAM (Montemerlo et al. 2002, 2003): particles of the path, each with its own map of landmarks.

p(x_1:t, m | z_1:t, u_1:t) = p(x_1:t | z_1:t, u_1:t) prod_l p(m_l | x_1:t, z_1:t)         (Eq. 5)

The path is represented by particles that move with the odometry and its noise (Eq. 6). Given a path, the
landmarks are independent, so each particle has a small Kalman filter per landmark (Eq. 7).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import attrgetter

import numpy as np

from pipeline.config.stages import Slam
from pipeline.geometry.gaussian import rows_of
from pipeline.geometry.pose_arrays import PathCorrection, composed, inverse
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.slam import slip_detection
from pipeline.slam.association import births_of, hits_less_misses
from pipeline.slam.frame_uncertainty import NOISE, FrameUncertainty, at_least
from pipeline.slam.keyframe_graph import (
    Keyframe,
    KeyframeGraph,
    Loop,
    ScanDetections,
    Solution,
    combined,
    corrected_landmarks,
    corrected_path,
    joined,
    same_trees,
)
from pipeline.slam.measured_pose import SharedErrors
from pipeline.slam.motion import Motion, accumulated, compounded, noise_of, wrapped
from pipeline.slam.particle_ancestry import (
    EstimatedPath,
    Genealogy,
    are_apart,
    best_after_resampling,
    draws,
    low_variance_ancestors,
    normalised,
    select_best,
)
from pipeline.slam.particle_maps import MapColumns, known_near, shared_map, take_ancestors
from pipeline.slam.particle_update import Rules, against_slip, estimated, use_scan
from pipeline.slam.places import NO_PLACES, ODDS, PlaceStates, agreement
from pipeline.slam.pose_quality import (
    FEWEST,
    OdometryDoubt,
    RunningStatistics,
    ScanStatistics,
    decayed_distrust,
    disagreement,
    is_lost,
    is_supported,
    named_statistics,
    pose_health,
    update_statistics,
)
from pipeline.slam.slip_detection import TreeMotion
from pipeline.slam.state import SlamState
from pipeline.types.records import Detections, Health, Int, Landmarks, PoseEstimate, PoseMeasurement

SCANS_MAX = 20  # scans between two keyframes whose detections the graph uses
REFERENCES = 1024  # at each multiple of it, reference poses without landmarks are dropped
PLACED = 1  # distinguishes the random numbers of `place` from those of a scan


class FastSlam:
    """The filter. Its random numbers depend only on the seed and the number of the scan, so that a changed
    parameter shows its own effect and not that of other random numbers."""

    def __init__(self, parameters: Slam, seed: int) -> None:
        self.parameters = parameters
        self.seed = seed
        self.state = SlamState.at_origin(parameters.particles)
        self._known = (self.state.maps, 0, 0, self.state.map_of(0))

    def process(
        self, index: int, motion: Pose2 | Motion, detections: Detections, clear_range: Float
    ) -> PoseEstimate:
        """Predict the particles by the odometry, weigh them by the detections, and resample if the effective
        number of particles is below the share `resample_below` of the particles; replaces `state`, and
        changes the arrays of the former state in place.

        Detections are used in the first scan, and in views and scans with a measured pose: after
        `update_distance`, when the motion is due, and when trees contradict the odometry or the last used
        scan was strange. In other scans the particles only move, the map is unchanged, and `landmark_of` of
        the result comes from an association with the unchanged map. A changed number of particles takes
        effect here.

        Args:
            index: Number of the scan; seeds the random numbers of the scan.
            motion: T_base(t-1)_base(t) by the odometry, or the same with its uncertainty and a measured pose.
            detections: Detected trees in the base frame; may be empty.
            clear_range: Free distance by azimuth in the base frame, shape (bins,) [m]; see
                `detection.free_space`.

        Returns:
            Pose after the scan with its health. Particles and weights are those before the resampling.
            `landmarks` contains only those of the best particle with at least `hits_to_weigh` hits.
            `landmark_of` is the birth number of the landmark of each detection, -1 for none; after a used
            scan each detection has one.
        """
        p = self.parameters
        motion = Motion(motion) if isinstance(motion, Pose2) else motion
        state = self._moved(self.state.with_particles(p.particles), motion)
        ancestors, doubt = None, motion.doubt
        R, rules = rows_of(detections.covariance), rules_of(p)
        places = self._places_in_reach(state, detections.centre)
        is_view = motion.is_view or motion.measured is not None
        if is_view:
            trees = self._by_trees(state, detections.centre, R, clear_range, places, rules)
        else:
            trees = TreeMotion(False, state.motion, state.motion_covariance, False)
        moved_on = state.since_update >= p.update_distance
        is_needed = moved_on or motion.due or trees.slipped or state.recent.strange > 0
        used = not state.views or (is_view and is_needed)
        slipped = trees.slipped or state.recent.slipped
        doubted = OdometryDoubt(bool(doubt), slipped)
        doubt = doubt or slip_detection.slip_message(
            state.motion, slipped, trees.unsure, registered=motion.covariance is not None
        )
        offset = 0.0
        if used:
            noise, offset = draws(self.seed, index, p.particles)
            state, scan, weights, births = self._observed(
                state,
                trees,
                detections.centre,
                R,
                clear_range,
                noise,
                motion.measured,
                doubted,
                places,
                rules,
            )
        else:
            scan, weights, births = ScanStatistics(), normalised(state.log_weight), None
        reach = _farthest(detections) if used else 0.0
        estimate, frame, by_trees = _estimate(state, self._best_map(state), weights, p, reach)
        if births is not None:
            state = self._with_places(state, births[state.best].copy(), detections.centre, R, estimate, reach)
        if used:
            at = estimate.T_map_base.as_array()
            corrected = state.shared.corrected(at, estimate.covariance if by_trees else None)
            state = state if corrected is state.shared else replace(state, shared=corrected)
        if used and len(detections.cluster):
            serial = state.detections - len(detections.cluster)
            at = estimate.T_map_base.as_array()
            frame = frame.with_reference(serial, len(state.genealogy), at, estimate.covariance)
            if len(frame.serial) % REFERENCES == 0:
                frame = frame.without_unused(state.maps.birth[state.maps.hits > 0])
        if used and estimate.n_eff < p.resample_below * p.particles:
            ancestors = low_variance_ancestors(weights, offset)
            take_ancestors(ancestors, state.pose, state.maps)
            shared = state.shared.drawn(ancestors)
            state = replace(state, best=best_after_resampling(state.best, ancestors, weights), shared=shared)
            state.log_weight[:] = 0.0
        genealogy = state.genealogy.with_scan(estimate.particles, ancestors, state.best)
        path = state.path.with_pose(estimate.T_map_base.as_array())
        self.state = state = replace(state, genealogy=genealogy, path=path, frame=frame)
        # A survivor of the resampling keeps its row, so that row `best` is still that of the best particle.
        if births is None:
            landmark_of = births_of(detections, estimate, self._usable_landmarks())
            scan = ScanStatistics(len(landmark_of), recognised=float(np.count_nonzero(landmark_of >= 0)))
        else:
            landmark_of = births[state.best].copy()  # a view would keep the births of all particles
            self.state = self._with_keyframe(state, detections, landmark_of)
        health = pose_health(
            state.recent, scan, estimate.n_eff, genealogy.distinct_ancestors, estimate.local_covariance, doubt
        )
        return replace(estimate, health=health, landmark_of=landmark_of)

    def without_shared_error(self, pose: PoseMeasurement) -> PoseMeasurement:
        """Return a measured pose corrected by the estimated error that all poses of its source share. It is
        unchanged if its source has no shared errors or no such pose was used before."""
        return self.state.shared.without_shared_error(pose, normalised(self.state.log_weight))

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Set the pose of all particles by another source; they keep the map and the path of the best
        particle. Weights, health statistics, shared errors and the motions since the last used scan and since
        the last keyframe are reset.

        If the graph has keyframes, it gets a keyframe at the newest scan, without detections and without
        odometry to the one before; a keyframe that this scan already has is replaced. If this is not the only
        keyframe, the graph also gets a loop from its first keyframe with this pose. `path` is unchanged.

        Args:
            index: Number of the scan, which seeds the random numbers.
            T_map_base: The pose.
            covariance: Covariance of x, y [m], yaw [rad], shape (3, 3), from which the particles are sampled.
        """
        self._put(index, T_map_base, covariance)
        graph = self.state.graph
        if graph.keyframes:
            keyframe = self._keyframe(self.state, (), self.state.detections)
            keyframe = replace(keyframe, covariance=np.full((3, 3), np.inf))
            graph = graph.with_keyframe(keyframe, T_map_base.as_array())
            graph = graph.with_loop(0, T_map_base, covariance, self.path())
        self.state = replace(
            self.state,
            graph=graph,
            keyframe_motion=np.zeros(3),
            keyframe_covariance=np.zeros((3, 3)),
            since_keyframe=(),
        )

    def _put(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Replace `state` by one whose particles are sampled from a Gaussian, all with the map and the path
        of the best particle, see `SlamState.placed`.

        Args:
            index: Number of the scan, which seeds the random numbers.
            T_map_base: Mean of the Gaussian.
            covariance: Covariance of x, y [m], yaw [rad], shape (3, 3); negative eigenvalues count as 0.
        """
        rng = np.random.default_rng([self.seed, index, PLACED])
        noise = rng.standard_normal((self.parameters.particles, 3))
        values, axes = np.linalg.eigh(covariance)
        pose = T_map_base.as_array() + noise @ (axes * np.sqrt(np.maximum(values, 0.0))).T
        pose[:, 2] = wrap_angle(pose[:, 2])
        self.state = self.state.placed(pose)

    @property
    def is_keyframe(self) -> bool:
        """Whether the newest scan is a keyframe of the graph."""
        graph = self.state.graph
        return bool(graph.keyframes) and graph.newest_scan == len(self.state.genealogy) - 1

    @property
    def is_smoothing_due(self) -> bool:
        """Whether the newest scan is a keyframe, the graph is due (`KeyframeGraph.is_due`), and no measured
        pose with shared errors was used."""
        return self.is_keyframe and self.state.graph.is_due and not self.state.shared.begun

    def is_keyframe_every(self, distance: float) -> bool:
        """Return whether the newest scan is a keyframe and a multiple of `distance` [m] of the driven path
        lies after the previous keyframe and not after this one. False for the first keyframe."""
        last = self.state.graph.keyframes[-2:]
        return self.is_keyframe and last[0].distance // distance < last[-1].distance // distance

    def first_scan_within(self, distance: float) -> int:
        """Return the scan number of the first keyframe of the last `distance` [m] of the driven path; the
        newest scan without a keyframe there."""
        keyframes, begin = self.state.graph.keyframes, self.state.distance - distance
        row = bisect_left(keyframes, begin, key=attrgetter("distance"))
        return keyframes[row].scan if row < len(keyframes) else len(self.state.genealogy) - 1

    def smooth(self, index: int) -> PathCorrection | None:
        """Solve the graph. All particles continue from its newest pose with its path and landmarks.

        Args:
            index: Number of the newest scan, which seeds the random numbers. This scan must be a keyframe,
                see `is_smoothing_due`.

        Returns:
            The correction. None where the graph has no solution (`KeyframeGraph.solve`); the particles are
            unchanged then, and the next smoothing waits for another revisit.
        """
        graph, solution = self.state.graph, self.state.graph.solve()
        if solution is None:
            self.state = replace(self.state, graph=replace(graph, revisits=0))
            return None
        return self._corrected(index, graph, solution, solution.conditional)

    def close(self, index: int, loop: Loop) -> PathCorrection | None:
        """Close a loop that ends at the newest scan: solve the graph with it, and correct path and landmarks.
        The newest scan becomes a keyframe. All particles continue from the corrected pose with the map of the
        best one, in which landmarks at the same place from before and after the loop are joined.

        Associations with old landmarks in the present revisit (`KeyframeGraph.revisit`) were made at the
        drifted pose. They are left out while the graph is solved with the loop, landmarks that the loop
        brings to the same position are joined, and these detections are then associated again
        (`KeyframeGraph.with_known`). The loop is taken if its solution has the larger support
        (`KeyframeGraph.support`).

        Args:
            index: Number of the scan, which seeds the random numbers.
            loop: The loop.

        Returns:
            The correction; None if the graph has no solution with the loop, or if it has no more support
            with the loop than without. The state is unchanged then.
        """
        state, graph = self.state, self.state.graph
        path = state.genealogy.path(state.best)
        if graph.newest_scan != len(path) - 1:
            # The scan may be one that was not used, after a motion that no keyframe contains.
            x, y, yaw = state.motion.tolist()
            motion, covariance = compounded(
                state.keyframe_motion, state.keyframe_covariance, x, y, yaw, state.motion_covariance
            )
            state = replace(state, keyframe_motion=motion, keyframe_covariance=covariance)
            graph = graph.with_keyframe(
                self._keyframe(state, state.since_keyframe, state.detections), path[-1]
            )
        revisit, without = graph.revisit(loop.first), graph.solve()
        support = 0.0 if without is None else graph.support(revisit, without)
        whole, graph = graph, graph.without(revisit)
        graph = graph.with_loop(loop.anchor, loop.T_map_base, loop.covariance, self.path())
        solution = graph.solve(added=1)
        if solution is None:
            return None
        moved = corrected_landmarks(state.map_of(state.best), graph, solution, path)
        names = same_trees(moved, graph.first_birth_after(loop.first))
        graph = replace(graph.renamed(*names), pose=solution.pose)
        solution = graph.solve()
        if solution is None:
            return None
        graph = replace(graph.with_known(whole, revisit, solution), pose=solution.pose)
        solution = graph.solve()
        if solution is None or whole.support(revisit, solution) <= support:
            return None
        return self._corrected(index, graph, solution, loop.covariance, names)

    def _corrected(
        self,
        index: int,
        graph: KeyframeGraph,
        solution: Solution,
        covariance: Float,
        names: tuple[Int, Int] | None = None,
    ) -> PathCorrection:
        """Set all particles to the newest pose of a solution, with path and landmarks corrected by it; return
        the correction of the path. The newest scan must be the newest keyframe of the graph.

        Args:
            index: Number of the newest scan.
            graph: The graph, with at least one keyframe.
            solution: Solution of the graph.
            covariance: Covariance of x, y [m], yaw [rad] from which the particles are sampled, shape (3, 3).
            names: Landmarks that are joined; see `joined`. None for none.
        """
        before = self.state
        path = before.genealogy.path(before.best)  # continuous, and that of the landmarks
        best = before.map_of(before.best)
        moved = corrected_landmarks(best, graph, solution, path)
        after = corrected_path(path, graph, solution)
        correction = PathCorrection(self.path(), after)
        self._put(index, Pose2(*after[-1].tolist()), covariance)
        particles = len(self.state.pose)
        frame = before.frame
        frame = frame.smoothed_by(correction, _at_scans(solution.of_map, graph, frame.scan))
        self.state = replace(
            self.state,
            maps=shared_map(particles, moved if names is None else joined(moved, *names)),
            places=before.places if names is None else before.places.with_seen(before.distance, names[1]),
            genealogy=Genealogy.of_path(after, particles),
            path=EstimatedPath.of(after),
            recent=before.recent,
            frame=frame.with_total(covariance, solution.covariance[-1], after[-1]),
            graph=graph.solved_by(solution),
            keyframe_motion=np.zeros(3),
            keyframe_covariance=np.zeros((3, 3)),
            since_keyframe=(),
        )
        return correction

    @property
    def is_lost(self) -> bool:
        """Whether too few landmarks are detected where they should be visible, see `pose_quality.is_lost`."""
        return is_lost(self.state.recent)

    @property
    def is_supported(self) -> bool:
        """Whether landmarks are detected where they should be visible, see `pose_quality.is_supported`. True
        before any landmark has `hits_to_weigh` hits."""
        return is_supported(self.state.recent)

    @property
    def is_led_by_trees(self) -> bool:
        """Whether `RunningStatistics.led` is above 0: trees determined the motion in the last scan with a
        doubted odometry, and fewer than `led` scans without doubt followed."""
        return self.state.recent.led > 0

    def estimate(self, before: PoseEstimate) -> PoseEstimate:
        """Return the pose of the present state, for example after `place`, with the health and the
        associations of an earlier estimate. The state is unchanged."""
        weights = normalised(self.state.log_weight)
        estimate, _, _ = _estimate(self.state, self._best_map(self.state), weights, self.parameters, 0.0)
        return replace(estimate, health=before.health, landmark_of=before.landmark_of)

    def health_without_detections(self, estimate: PoseEstimate) -> Health:
        """Return the health of an estimate for a scan that detected no tree and has no doubt about the
        odometry. Whether it is "lost" depends on the running statistics and on the covariance of the
        estimate."""
        ancestors = self.state.genealogy.distinct_ancestors
        return pose_health(
            self.state.recent, ScanStatistics(), estimate.n_eff, ancestors, estimate.local_covariance
        )

    def reset_health(self) -> None:
        """Set the running statistics that determine the health to their initial values, except `mapped`."""
        self.state = replace(self.state, recent=RunningStatistics(mapped=self.state.recent.mapped))

    def path(self) -> Float:
        """Return the estimated pose of each processed scan with all later corrections of the path, x, y [m],
        yaw [rad], shape (N, 3), a copy. `place` does not change it."""
        return self.state.path.poses()

    @property
    def best_pose(self) -> Pose2:
        """Pose of the best particle at the newest scan, in the frame of its landmarks."""
        state = self.state
        return Pose2(*state.pose[state.best].tolist()) @ Pose2(*state.motion.tolist())

    def landmarks(self) -> Landmarks:
        """Return all landmarks of the best particle, those with few hits and in inactive places as well, with
        the gate and the maximum distance of the parameters. Their scores are those of `hits_less_misses`."""
        known, p = self._best_map(self.state), self.parameters
        score = hits_less_misses(known.hits, known.score, p.misses_per_hit)
        return Landmarks(known.birth, known.mean, known.covariance, score, p.gate, p.distance_max)

    def _best_map(self, state: SlamState) -> MapColumns:
        """Return the landmarks of the best particle, which only a used scan changes in place."""
        maps, views, best, known = self._known
        if state.maps is not maps or state.views != views or state.best != best:
            known = state.map_of(state.best)
            self._known = (state.maps, state.views, state.best, known)
        return known

    def map_error(self, landmarks: Landmarks) -> Float:
        """Return the covariance of the error of the map at each landmark, which all particles share, shape
        (L, 2, 2) [m^2]; see `FrameUncertainty.at_landmarks`."""
        return self.state.frame.at_landmarks(landmarks.birth, landmarks.position)

    def _usable_landmarks(self) -> Landmarks:
        """Return `landmarks` without those of inactive places, which take no part in the data association."""
        known, places = self.landmarks(), self.state.places
        if not places.inactive.any():
            return known
        rows = places.is_usable(known.birth)
        return replace(
            known,
            birth=known.birth[rows],
            position=known.position[rows],
            covariance=known.covariance[rows],
            score=known.score[rows],
        )

    @property
    def begun_since(self) -> Callable[[int], tuple[Float, Float]]:
        """Function of a scan number that returns the landmarks of the best particle, as it is now, that were
        begun at this scan or later and have at least `hits_to_weigh` hits: positions, shape (L, 2) [m], and
        covariances xx, xy, yy, shape (L, 3) [m^2]. The scan of a landmark is that of its reference pose,
        which may be a little earlier than the scan that began it."""
        known, frame = self._best_map(self.state), self.state.frame
        return partial(_begun_since, known, frame, self.parameters.hits_to_weigh)

    def _moved(self, state: SlamState, motion: Motion) -> SlamState:
        """Return the state after one more odometry step: the motion since the last used scan, its covariance
        slack and `since_update` grow, and distrust decays. The state itself if nothing changes, see
        `accumulated`."""
        distrust = decayed_distrust(state.recent.distrust, motion.period)
        if distrust != state.recent.distrust:
            state = replace(state, recent=replace(state.recent, distrust=distrust))
        moved = accumulated(
            state.motion, state.motion_covariance, state.slack, motion, distrust, self.parameters
        )
        if moved is None:
            return state
        return replace(
            state,
            motion=moved[0],
            motion_covariance=moved[1],
            slack=moved[2],
            since_update=state.since_update + moved[3],
        )

    def _observed(
        self,
        state: SlamState,
        trees: TreeMotion,
        centre: Float,
        R: Float,
        clear_range: Float,
        noise: Float,
        measured: PoseMeasurement | None,
        doubted: OdometryDoubt,
        places: PlaceStates,
        rules: Rules,
    ) -> tuple[SlamState, ScanStatistics, Float, Int]:
        """Update all particles by the detections of a scan; their arrays change in place.

        Args:
            state: State after the motion.
            trees: Motion since the last used scan, by odometry or by trees.
            centre: Detections in the base frame, shape (D, 2) [m]; D may be 0.
            R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
            clear_range: Free distance by azimuth, shape (bins,) [m].
            noise: Standard normal numbers, shape (P, 3).
            measured: Pose that another source measured, if any.
            doubted: Doubts about the odometry, for the running statistics.
            places: States of the places in reach.
            rules: Parameters.

        Returns:
            State after the scan, with the motion reset to zero; statistics of the scan; normalised weights,
            shape (P,); and births of the landmarks that each particle associates with the detections, int64,
            shape (P, D). A detection without landmark begins one, so each has a birth.
        """
        found = len(centre)
        motion, covariance, recent = trees.motion, trees.covariance, state.recent
        if trees.slipped:
            recent = replace(recent, distrust=1.0)
        shared = self._shared(state, motion, covariance, measured)
        keyframe_motion, keyframe_covariance = compounded(
            state.keyframe_motion, state.keyframe_covariance, motion[0], motion[1], motion[2], covariance
        )
        maps, weights, mean, odometry, births = use_scan(
            state.pose, state.log_weight, state.maps, motion, covariance, noise, centre, R, clear_range,
            state.detections, places, rules, shared.for_particles(measured),
        )  # fmt: skip
        if trees.slipped:
            odometry = disagreement(motion, state.motion, state.motion_covariance)
        scan = named_statistics(mean, odometry, found)
        is_determined = measured is not None or scan.recognised >= FEWEST
        state = replace(
            state,
            maps=maps,
            motion=np.zeros(3),
            motion_covariance=np.zeros((3, 3)),
            slack=np.zeros(2) if is_determined else state.slack,
            keyframe_motion=keyframe_motion,
            keyframe_covariance=keyframe_covariance,
            distance=state.distance + state.since_update,
            since_update=0.0,
            detections=state.detections + found,
            views=state.views + 1,
            best=select_best(weights, state.best, state.pose, rules.distance_max),
            recent=update_statistics(recent, scan, state.since_update, doubted),
            shared=shared,
        )
        return state, scan, weights, births

    def _places_in_reach(self, state: SlamState, centre: Float) -> PlaceStates:
        """Return the states of the places whose landmarks any particle may associate with detections after
        the motion of the state; an empty table if all of them are active. `centre` contains the detections in
        the base frame, shape (D, 2) [m]."""
        places = state.places
        if not (places.inactive.any() or places.is_old(state.distance).any()):
            return NO_PLACES
        x, y, _ = state.pose[state.best].tolist()
        apart = np.hypot(state.pose[:, 0] - x, state.pose[:, 1] - y).max()
        reach = self.parameters.view_range + self.parameters.distance_max + float(apart)
        reach += math.hypot(*state.motion[:2].tolist()) + float(np.hypot(*centre.T).max(initial=0.0))
        _, _, _, birth = known_near(state.maps, state.best, x, y, reach)
        return state.places.in_reach(birth, state.distance)

    def _with_places(
        self, state: SlamState, births: Int, centre: Float, R: Float, estimate: PoseEstimate, reach: float
    ) -> SlamState:
        """Return the state with the place of a scan, and with the old places that the scan confirms or
        contradicts, see `agreement`. Without detections, or without old places, no place is confirmed or
        contradicted.

        Args:
            state: State after the scan.
            births: Birth numbers of the landmarks of the detections in the best particle, shape (D,).
            centre, R: Detections in the base frame, shape (D, 2) [m], and covariances xx, xy, yy, shape (D,
                3) [m^2].
            estimate: Pose after the scan.
            reach: Distance of the farthest detection [m].
        """
        distance = state.distance
        places = state.places.with_scan(distance, state.detections - len(centre), births)
        if len(centre) and places.is_old(distance).any():
            x, y, _ = state.pose[state.best].tolist()
            mean, covariance, hits, birth = known_near(state.maps, state.best, x, y, reach)
            rows = (hits >= self.parameters.hits_to_weigh) & places.of_old(birth, distance)
            odds, agrees, near = agreement(
                state.pose[state.best], estimate.local_covariance, centre, R, mean[rows], covariance[rows]
            )
            if odds > ODDS:
                places = places.with_seen(distance, birth[rows][agrees])
            elif odds < -ODDS:
                places = places.with_contradiction(birth[rows][near])
        return replace(state, places=places)

    def _with_keyframe(self, state: SlamState, detections: Detections, birth: Int) -> SlamState:
        """Return the state with the detections of this scan, and with a keyframe if none exists or the last
        one is at least `keyframe_distance` of driven path behind.

        The detections of a scan, if there are any, are kept only if it is the first one since the last
        keyframe or at least `keyframe_distance` / SCANS_MAX after the last kept one.

        Args:
            state: State after the scan.
            detections: Detections of the scan.
            birth: Birth number of the landmark of each detection, int64, shape (D,).
        """
        graph, scans, spacing = state.graph, state.since_keyframe, self.parameters.keyframe_distance
        # Scans from the same place share their errors.
        if len(detections.cluster) and (
            not scans or state.distance - scans[-1].distance >= spacing / SCANS_MAX
        ):
            scan = len(state.genealogy) - 1
            R = rows_of(detections.covariance)
            shown = ScanDetections(scan, state.distance, birth, detections.centre, R)
            scans = (*scans, shown)
        if graph.keyframes and state.distance - graph.keyframes[-1].distance < spacing:
            return state if scans is state.since_keyframe else replace(state, since_keyframe=scans)
        if len(graph.keyframes) == 1:
            graph, scans = self._with_first_views(state, scans)
        keyframe = self._keyframe(state, scans, state.detections - len(detections.cluster))
        return replace(
            state,
            graph=graph.with_keyframe(keyframe, state.pose[state.best]),
            keyframe_motion=np.zeros(3),
            keyframe_covariance=np.zeros((3, 3)),
            since_keyframe=(),
        )

    def _with_first_views(
        self, state: SlamState, scans: tuple[ScanDetections, ...]
    ) -> tuple[KeyframeGraph, tuple[ScanDetections, ...]]:
        """Return the graph with the scans near its only keyframe added to it, and the other scans."""
        # This keyframe fixes the frame of the map: errors of one scan would move and rotate the whole map.
        # The last scan is left to the second keyframe.
        first = state.graph.keyframes[0]
        near = tuple(s for s in scans[:-1] if s.distance - first.distance < state.distance - s.distance)
        shown = np.array([first.scan, *(s.scan for s in near)])
        T_newest_base = state.genealogy.mean_motion_from(shown, normalised(state.log_weight))
        T_first_base = composed(np.tile(inverse(T_newest_base[:1]), (len(shown), 1)), T_newest_base)
        birth, centre, R = combined((first, *near), T_first_base)
        graph = replace(state.graph, keyframes=(replace(first, birth=birth, centre=centre, R=R),))
        return graph, scans[len(near) :]

    def _keyframe(self, state: SlamState, scans: tuple[ScanDetections, ...], first_birth: int) -> Keyframe:
        """Return the keyframe at the newest scan with the combined detections of `scans` since the last
        keyframe, without any if `scans` is empty; see Keyframe for `first_birth`."""
        birth, centre, R = np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 3))
        if scans:
            weights = normalised(state.log_weight)
            T_keyframe_base = state.genealogy.mean_motion_from(np.array([s.scan for s in scans]), weights)
            birth, centre, R = combined(scans, T_keyframe_base)
        return Keyframe(
            max(len(state.genealogy) - 1, 0), first_birth, state.distance, state.keyframe_motion,
            state.keyframe_covariance, birth, centre, R,
        )  # fmt: skip

    def _by_trees(
        self,
        state: SlamState,
        centre: Float,
        R: Float,
        clear_range: Float,
        places: PlaceStates,
        rules: Rules,
    ) -> TreeMotion:
        """Return the motion since the last used scan by `against_slip`: that of the odometry, or that of the
        trees where they contradict it.

        Args:
            state: State after the motion.
            centre: Detections in the base frame, shape (D, 2) [m].
            R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
            clear_range: Free distance by azimuth, shape (bins,) [m].
            places: States of the places in reach.
            rules: Parameters.
        """
        return against_slip(
            state.pose, state.maps, state.best, state.motion, state.motion_covariance, state.since_update,
            state.recent.odometry_trust(noise_of(self.parameters)), centre, R, clear_range, places, rules,
        )  # fmt: skip

    def _shared(
        self, state: SlamState, motion: Float, covariance: Float, measured: PoseMeasurement | None
    ) -> SharedErrors:
        """Return the shared errors after a motion and a measured pose. The first measured pose with shared
        errors begins them at the present estimate; the means and covariances of the particles are not updated
        here.

        Args:
            state: State with the shared errors before the motion.
            motion: x, y [m], yaw [rad] since the last used scan, shape (3,).
            covariance: Covariance of the motion, shape (3, 3).
            measured: The measured pose, if any.
        """
        shared = state.shared.moved(motion, covariance)
        if measured is None or (measured.shared is None and not shared.begun):
            return shared
        if not shared.begun:
            moved = replace(state, motion=motion, motion_covariance=covariance)
            weights = normalised(state.log_weight)
            now, _, _ = _estimate(moved, self._best_map(moved), weights, self.parameters, 0.0)
            shared = SharedErrors.begun_at(len(state.pose), now.T_map_base.as_array(), now.covariance)
        return shared.measured(measured)


def _begun_since(known: MapColumns, frame: FrameUncertainty, hits: int, scan: int) -> tuple[Float, Float]:
    """Return positions and covariances of the landmarks with at least `hits` hits that were begun at a scan
    or later."""
    rows = (frame.scan_of(known.birth) >= scan) & (known.hits >= hits)
    return known.mean[rows], known.covariance[rows]


def _at_scans(covariance: Float, graph: KeyframeGraph, scans: Int) -> Float:
    """Return the covariance at some scans, shape (N, 3, 3): that of the last keyframe before or at the scan,
    or of the first keyframe for earlier scans.

    Args:
        covariance: Covariance of each keyframe, shape (K, 3, 3), K > 0.
        graph: Graph with these keyframes.
        scans: Numbers of the scans, int64, shape (N,).
    """
    keyframe = np.searchsorted(graph.scans, scans, side="right") - 1
    rows: Float = covariance[np.maximum(keyframe, 0)]
    return rows


def _farthest(detections: Detections) -> float:
    """Return the distance of the farthest detection from the base [m]; 0 if there are no detections."""
    centre = detections.centre
    return math.sqrt(float((centre * centre).sum(axis=1).max(initial=0.0)))


def rules_of(p: Slam) -> Rules:
    """Return the parameters that the compiled measurement update needs. `use_proposal` is False for the
    method "fastslam1" only; `miss` is 1 / `misses_per_hit`."""
    return Rules(
        use_proposal=p.method != "fastslam1",
        gate=p.gate,
        distance_max=p.distance_max,
        hits_to_weigh=p.hits_to_weigh,
        view_range=p.view_range,
        miss=1.0 / p.misses_per_hit,
        miss_weight=p.miss_weight,
        weight_power=p.weight_power,
        merge_gate=p.merge_gate,
    )


def _estimate(
    state: SlamState, landmarks: MapColumns, weights: Float, p: Slam, reach: float
) -> tuple[PoseEstimate, FrameUncertainty, bool]:
    """Return the pose, the uncertainty of the frame after it, and whether known landmarks within `reach`
    determine it (always False before a measured pose with shared errors was used). The state is unchanged.

    The pose is the weighted mean of the particles after the motion of the state. If the particles are apart
    (`are_apart`), it is that of the best particle, and the covariance is enlarged by the square of the
    difference to the mean.

    Args:
        state: State with the motion since the last used scan.
        landmarks: Landmarks of its best particle.
        weights: Weights with sum 1, shape (P,).
        p: Parameters.
        reach: Maximum distance of landmarks that determine the pose [m]; 0 for a scan without detections.
    """
    pose, mean, spread, n_eff = estimated(state.pose, weights, state.motion, state.motion_covariance)
    known = landmarks
    if state.places.inactive.any():
        known = landmarks.take(state.places.is_usable(landmarks.birth))
    covariance, frame = state.frame.with_pose(
        mean, spread, n_eff, known.mean, known.birth, known.hits, p.hits_to_weigh, reach
    )
    by_trees = False
    if state.shared.begun:
        by_trees = frame.observes_known(mean, known.mean, known.birth, known.hits, p.hits_to_weigh, reach)
        shared = state.shared.moved(state.motion, state.motion_covariance)
        by_landmarks = covariance if by_trees else None
        if not by_trees and len(shared.by_trees):
            # Without trees in view, the covariance by the last trees is used, enlarged by the odometry since
            # then.
            by_landmarks = at_least(spread, shared.by_trees, NOISE / np.sqrt(n_eff))
        covariance, frame = frame.with_measured_pose(spread, n_eff, shared.joint[:3, :3], by_landmarks)
    reported = mean
    # The scatter of the particles is a part of `spread`.
    limit = 2.0 * p.distance_max * p.distance_max
    if spread[0, 0] + spread[1, 1] > limit and are_apart(pose, weights, p.distance_max):
        # The mean of separate hypotheses agrees with no map, so the best particle is reported. The second
        # moment about it is larger than the covariance by the square of its distance from the mean (Steiner).
        reported = pose[state.best]
        away = reported - mean
        away[2] = wrapped(away[2])
        steiner = np.outer(away, away)
        covariance, spread = covariance + steiner, spread + steiner
    estimate = PoseEstimate(
        T_map_base=Pose2(float(reported[0]), float(reported[1]), float(reported[2])),
        covariance=covariance,
        particles=pose,
        weights=weights,
        n_eff=n_eff,
        landmarks=landmarks.mean[landmarks.hits >= p.hits_to_weigh],
        relative=spread,
    )
    return estimate, frame, by_trees
