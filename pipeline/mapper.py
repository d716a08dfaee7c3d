"""The mapper: one scan -> map, in the order and the words of section 3 of the paper.

`Mapper.process` is the main loop of the program. Everything else here is a stage of it, or its state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pipeline.classification import (
    ColumnClassifier,
    ColumnClassifierState,
    ColumnVotes,
    ForestOf,
    ScanView,
    package_alone,
)
from pipeline.classification.forest import is_seen_all_around
from pipeline.classification.voxel_map import VoxelMap
from pipeline.config import Parameters
from pipeline.detection.free_space import BINS
from pipeline.front_end import DetectionResult, SegmentedScan, StageTimer, detect, no_timer, segment
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.ground.scan_ground import NO_GROUND
from pipeline.ground.terrain_map import HeightMapper, HeightMapState
from pipeline.loop_closure import detection
from pipeline.loop_closure.correction import (
    DoubledTrees,
    LoopClosure,
    RelocalisedPose,
    Restart,
    SearchFailure,
    Smoothing,
)
from pipeline.loop_closure.kidnapped_robot import Relocaliser, RelocaliserState
from pipeline.map_faults import MapFaults, reasons_of
from pipeline.odometry.gyro import UNUSED, fused
from pipeline.slam import FastSlam, Motion, SlamState
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.slam.measured_pose import REJECTED, within_gate
from pipeline.slam.motion import noise_of, step_covariance
from pipeline.slam.particle_ancestry import TrajectoryBuffer
from pipeline.tracking import Tracker
from pipeline.tracking.track_table import TrackTable
from pipeline.tree_log import (
    LoopSearch,
    TreeCorrection,
    TreeInput,
    TreeLog,
    lean,
)
from pipeline.types.records import (
    Columns,
    Detections,
    Frame,
    HeightMap,
    Int,
    Landmarks,
    Path,
    PoseEstimate,
    Sensor,
    Step,
    no_detections,
)

NOTHING_FREE: Float = np.zeros(BINS)
# m; columns and terrain are grids with cells of 0.1 m and more, which a smaller correction does not change.
CORRECTION_MIN = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class MapperState:
    """An independent copy of all that the mapper knows between two scans, without its parameters.

    Attributes:
        slam: Particles, their path, and the graph of keyframes.
        gathering: Voxel columns.
        ground: Terrain map.
        tracks: Kalman filter of each tree.
        next_number: Number of the next new tree.
        odometry: Odometry pose of the last scan that had one.
        path_length: Number of scans.
        placed: First scan of the path that the robot has driven since it was last put somewhere.
        closed: Scan at which the last loop was closed.
        recovery: Search for a lost robot.
        last: Pose after the last scan, with its covariance.
        delayed: Correction of the path that columns and terrain do not have yet.
        faults: Faults during the run.
    """

    slam: SlamState
    gathering: ColumnClassifierState
    ground: HeightMapState
    tracks: TrackTable
    next_number: int
    odometry: Pose2 | None
    path_length: int
    placed: int = 0
    closed: int = 0
    recovery: RelocaliserState[MapperState] = field(default_factory=RelocaliserState)
    last: tuple[Pose2, Float] | None = None
    delayed: PathCorrection | None = None
    faults: MapFaults = field(default_factory=MapFaults)


Correction = Restart[MapperState] | RelocalisedPose | LoopClosure | DoubledTrees | Smoothing | SearchFailure


class Mapper:
    """Maps a run scan by scan. It reads no clock and no file and starts no thread.

    Args:
        parameters: Parameters of all stages; they may be replaced between two scans.
        sensor: The LiDAR.
        T_base_lidar: Pose of the LiDAR on the robot.
        seed: Random seed.
        timer: Entered around each stage with its name, so that the caller can measure the stages.
        forests: Finds the random forest that classifies the columns.

    Raises:
        StemmapError: The forest that the parameters name does not exist.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        sensor: Sensor,
        T_base_lidar: Pose3,
        seed: int,
        timer: StageTimer = no_timer,
        forests: ForestOf = package_alone,
    ) -> None:
        """Create a mapper with an empty map.

        Raises:
            StemmapError: The forest that the parameters name does not exist.
        """
        self._parameters = parameters
        self._sensor = sensor
        self._T_base_lidar = T_base_lidar
        self._timer = timer
        self._slam = FastSlam(parameters.slam, seed)
        self._columns = ColumnClassifier(
            parameters.classification, all_around=sensor.rings > 0, forests=forests
        )
        self._terrain = HeightMapper()
        self._tracker = Tracker(parameters.tracking, sensor.azimuth_step)
        self._relocaliser: Relocaliser[MapperState] = Relocaliser(seed)
        self._path = TrajectoryBuffer()
        self._odometry: Pose2 | None = None
        self._placed = self._closed = 0
        self._last: tuple[Pose2, Float] | None = None
        self._delayed: PathCorrection | None = None
        self._faults = MapFaults()
        #: Stores what each scan gives to the trees; None for no log.
        self.log: TreeLog | None = None
        self._inputs = _Inputs()

    def process(self, step: Step, scan: SegmentedScan | None = None) -> Frame:
        """Map one scan: update path, trees, voxel columns and terrain, correct the map where a loop is closed
        or a lost robot is found, and return the results. A lost robot maps nothing.

        Args:
            step: The scan with its odometry; numbers increase by 1 from 0.
            scan: Result of `segment` for this step where it is known already; of the step's own scan only the
                time is used then. None segments the scan.
        """
        p, timer, stamp_ns = self._parameters, self._timer, step.scan.stamp_ns
        self._inputs = inputs = _Inputs()

        # Sections 3.1 to 3.3: filters, ground, clusters, and a verdict for each cluster.
        scan = self.segment(step) if scan is None else scan
        found = detect(scan, p.detection, timer)

        # Section 3.4: predict the motion, update the particles; look for a robot that was carried away.
        with timer("slam"):
            motion, notices = self._predict_motion(step)
            self._remember(step.index, motion)
            self._path.append(stamp_ns, motion.step)
            estimate = self._update_slam(step.index, motion, found, scan)
            correction = self._check_lost(step.index, motion, found, scan, estimate)
            estimate, correction = self._apply(step.index, correction, estimate)
            self._path.set_sigma(estimate.covariance)

        # Section 3.5: one Kalman filter per tree; the columns classify the trees. A lost robot maps nothing.
        is_known, mapped_at = correction is None and not self._relocaliser.is_searching, estimate
        if self._relocaliser.is_searching:
            self._settle_columns()
        else:
            self._update_trees(step, scan, found, estimate)
            self._update_columns(step, scan, estimate)
            self._update_terrain(scan, estimate)

        # Back at a known place: close the loop.
        closure: Correction | None = self._check_loop(estimate)
        estimate, closure = self._apply(step.index, closure, estimate)

        self._last = (estimate.T_map_base, estimate.covariance)
        estimate, doubts = self._check_faults(step, scan, estimate)
        notices = (*notices, *doubts)
        if self.log is not None:
            given = inputs.of(self.log, stamp_ns, motion.step, mapped_at) if is_known else None
            self.log.put(step.index, given)
        return self._frame(step, scan, found, estimate, notices, correction, closure)

    def segment(self, step: Step) -> SegmentedScan:
        """Return a scan filtered and segmented into ground and clusters by the present parameters, see
        `front_end.segment`; the timer of the mapper encloses each stage. The map is unchanged."""
        return segment(step, self._sensor, self._T_base_lidar, self._parameters, self._timer)

    def segmenter(self) -> Callable[[Step], SegmentedScan]:
        """Return `segment` with the present parameters, without a timer, so that another thread can call it.
        Later changes of the parameters have no effect on it."""
        return partial(
            segment, sensor=self._sensor, T_base_lidar=self._T_base_lidar, parameters=self._parameters
        )

    # --- state ----------------------------------------------------------------------------------------

    @property
    def parameters(self) -> Parameters:
        """Parameters in force. New ones that are set apply from the next scan onwards; if their forest does
        not exist, setting raises StemmapError and changes nothing."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self._columns.parameters = parameters.classification  # first: its forest may not exist
        self._parameters = parameters
        self._slam.parameters = parameters.slam
        self._tracker.parameters = parameters.tracking

    @property
    def path(self) -> Path:
        """The estimated path so far, one row per scan. Later paths may have other earlier rows, because of
        corrections; a path that was returned never changes."""
        return self._path.path(self._slam.state.path)

    @property
    def graph(self) -> KeyframeGraph:
        """The graph of keyframes so far; immutable."""
        return self._slam.state.graph

    @property
    def tracker(self) -> Tracker:
        """The tracker; the next scan changes its trees."""
        return self._tracker

    @property
    def tree_landmarks(self) -> Int:
        """Birth number of the landmark of each tree of the last frame, int64, shape (T,), -1 for none; a
        copy."""
        return self._tracker.tracks.landmark.copy()

    @property
    def height_map(self) -> HeightMap:
        """The terrain map of all tiles so far: copies that are made at each access, in a time that grows with
        the map."""
        return self._terrain.record()

    @property
    def voxels(self) -> VoxelMap:
        """The voxels of all scans; empty without the column classifier. Not a copy: it changes with the next
        scan."""
        return self._columns.memory

    @property
    def motion(self) -> Float:
        """x, y [m], yaw [rad] by odometry from the scan before to each scan, shape (N, 3); a copy."""
        return self._path.motion.copy()

    def snapshot(self) -> MapperState:
        """Return a copy of all state except the parameters; later scans do not change it."""
        return MapperState(
            self._slam.state.copy(),
            self._columns.snapshot(),
            self._terrain.state,
            self._tracker.tracks.copy(),
            self._tracker.next_number,
            self._odometry,
            len(self._path),
            self._placed,
            self._closed,
            self._relocaliser.state.copy(),
            self._last,
            self._delayed,
            self._faults,
        )

    def restore(self, state: MapperState) -> None:
        """Return to an earlier snapshot of this mapper, or forward to a later one that it reached before with
        the same scans and parameters. Parameters stay; the snapshot is unchanged."""
        self._restore_map(state)
        self._tracker.next_number = state.next_number
        self._odometry = state.odometry
        self._path.return_to(state.path_length)
        self._placed, self._closed, self._last = state.placed, state.closed, state.last
        self._faults = state.faults
        self._relocaliser.state = state.recovery.copy()

    def load(self, state: MapperState, stamp_ns: Int, sigma_xy: Float, motion: Float) -> None:
        """Replace the state by a snapshot of another mapper, from which the run continues.

        Args:
            state: The snapshot; unchanged.
            stamp_ns: Time of each scan of its path [ns], int64, shape (N,); copied.
            sigma_xy: Standard deviation of each position [m], shape (N,).
            motion: Motion by odometry to each scan, shape (N, 3).
        """
        self._path = TrajectoryBuffer(stamp_ns, sigma_xy, motion)
        self.restore(state)

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Set the pose of the base before scan `index`: all particles are drawn from it, with the map and the
        path of the best one. The next scan has no motion by odometry, and loops do not begin before it. A
        search for a lost robot ends, and the states stored for it are discarded.

        Args:
            index: Number of the next scan.
            T_map_base: The pose.
            covariance: Covariance of x, y [m], yaw [rad], shape (3, 3).
        """
        self._slam.place(index, T_map_base, covariance)
        self._placed, self._last = index, (T_map_base, covariance)
        self._odometry = None
        self._relocaliser.reset()

    # --- stages ---------------------------------------------------------------------------------------

    def _predict_motion(self, step: Step) -> tuple[Motion, tuple[str, ...]]:
        """Return the motion since the last scan with its uncertainty, by odometry and gyroscope, and
        warnings. A scan without odometry, and the first one with it, has no motion. When a missing odometry
        returns, the motion since it was missing is left out if trees have determined it meanwhile, and else
        included without the gyroscope. Stores the odometry pose of the scan."""
        before, now = self._odometry, step.T_odom_base
        self._odometry = before if now is None else now
        driven = Pose2() if before is None or now is None else before.inverse() @ now
        interval = self._parameters.slam.update_interval
        due = interval > 0.0 and step.is_due(interval)
        period = step.period_ns * 1e-9
        motion = Motion(
            driven, step.slack, step.doubt, step.measured, step.covariance, due=due, is_view=step.is_view,
            period=period,
        )  # fmt: skip
        if before is not None and step.unreported is not None:
            if not self._slam.is_led_by_trees:
                return self._gated(motion)
            motion = motion._replace(step=step.unreported.inverse() @ driven)
        return self._gated(self._with_gyro(step, motion))

    def _with_gyro(self, step: Step, motion: Motion) -> Motion:
        """Return the motion of a step fused with the turn by the gyroscope; unchanged if the turn or the
        odometry is unknown or the parameter `acquisition.gyro` is off. A turn that contradicts LiDAR odometry
        is not used and makes a doubt."""
        driven = motion.step
        if step.turn is None or step.T_odom_base is None or not self._parameters.acquisition.gyro:
            return motion
        sigma = math.sqrt(step_covariance(motion, noise_of(self._parameters.slam))[2, 2])
        turned, turn_sigma, slack, doubt = fused(driven, sigma, step.slack, step.turn)
        if doubt and motion.covariance is not None:  # registered scans cannot slip
            return motion._replace(doubt=step.doubt or UNUSED)
        return motion._replace(step=turned, slack=slack, doubt=step.doubt or doubt, turn_sigma=turn_sigma)

    def _gated(self, motion: Motion) -> tuple[Motion, tuple[str, ...]]:
        """Return the motion without a measured pose that fails its gate, and the warning about it; unchanged,
        without warning, if there is no measured pose, the pose passes, or no pose was estimated before."""
        if self._last is None or motion.measured is None:
            return motion, ()
        expected = motion._replace(measured=self._slam.without_shared_error(motion.measured))
        if within_gate(*self._last, expected, noise_of(self._parameters.slam)):
            return motion, ()
        return motion._replace(measured=None), (REJECTED,)

    def _update_slam(
        self, index: int, motion: Motion, found: DetectionResult, scan: SegmentedScan
    ) -> PoseEstimate:
        """Sample, associate, weigh and resample the particles; return the pose. During the search of a lost
        robot no detections are used, so that the pose follows the odometry.

        Args:
            index: Number of the scan.
            motion: Motion since the last scan.
            found: Detections of the scan.
            scan: The segmented scan, for its free ranges.
        """
        if self._relocaliser.is_searching:
            return self._slam.process(index, motion, no_detections(), NOTHING_FREE)
        return self._slam.process(index, motion, found.detections, scan.free)

    def _update_trees(
        self, step: Step, scan: SegmentedScan, found: DetectionResult, estimate: PoseEstimate
    ) -> None:
        """Update the Kalman filters of the trees, and classify new ones by the present columns. A scan that
        is not a view, and the one that finds a lost robot again, which has no data association, update no
        filter.

        Args:
            step: The scan.
            scan: The segmented scan.
            found: Detections of the scan.
            estimate: Pose with the landmark of each detection.
        """
        tracker, stamp_ns = self._tracker, step.scan.stamp_ns
        with self._timer("tracking"):
            if step.is_view and len(estimate.landmark_of) == len(found.detections.cluster):
                self._inputs.seen = (found.detections, self._slam.landmarks(), found.heights)
                tracker.process(stamp_ns, estimate, *self._inputs.seen)
            # A scan that updates the columns classifies all tracks by them afterwards.
            if scan.column_input is None and self._parameters.classification.method == "columns":
                self._inputs.columns = self._columns.columns
                tracker.classify_new(self._columns.columns)

    def _update_columns(self, step: Step, scan: SegmentedScan, estimate: PoseEstimate) -> None:
        """Integrate the scan into the voxel columns at the estimated pose, and classify columns and trees. A
        scan without column input only settles the columns."""
        given = scan.column_input
        if given is None:
            self._settle_columns()
            return
        with self._timer("gathering"):
            pose, offset = estimate.T_map_base, scan.sensor_offset
            view = ScanView(pose, offset, scan.free, given.steepest, given.depth, given.terrain)
            rings = self._sensor.rings  # with rings, the path does not matter; it is long to copy
            path = np.zeros((0, 2)) if rings else self._slam.path()[:, :2]
            self._columns.all_around = is_seen_all_around(rings, path)
            self._columns.add(given.points, given.height, step.index, view)
            self._inputs.columns, self._inputs.votes = self._columns.columns, self._columns.votes
            self._columns.columns = self._tracker.classify(
                step.scan.stamp_ns, self._columns.columns, self._parameters.classification
            )

    def _settle_columns(self) -> None:
        """Finish what the last update of the columns left to the scan after it; nothing if the columns are
        settled."""
        if self._columns.is_unsettled:
            with self._timer("gathering"):
                self._columns.settle()

    def _update_terrain(self, scan: SegmentedScan, estimate: PoseEstimate) -> None:
        """Add the terrain of the scan to the terrain map at the estimated pose; nothing for a scan without
        terrain."""
        if scan.terrain is not None:
            with self._timer("height map"):
                self._terrain.add(scan.terrain, estimate.T_map_base, scan.sensor_offset)

    # --- corrections ----------------------------------------------------------------------------------

    def _remember(self, index: int, motion: Motion) -> None:
        """Store the motion and, where `Relocaliser.needs_state`, the state to which a robot that turns out to
        be lost returns; call it before the scan is mapped. Nothing is stored during a search, and all stored
        states are removed where the parameter `relocalisation.method` is "none"."""
        relocaliser = self._relocaliser
        if self._parameters.relocalisation.method == "none":
            relocaliser.reset()
        elif not relocaliser.is_searching:
            views = self._slam.state.views
            needs_state = relocaliser.needs_state(views, self._slam.is_supported)
            state = replace(self.snapshot(), recovery=RelocaliserState()) if needs_state else None
            relocaliser.remember(index, motion, views, state)
            self._inputs.keeps_state = needs_state

    def _check_lost(
        self,
        index: int,
        motion: Motion,
        found: DetectionResult,
        scan: SegmentedScan,
        estimate: PoseEstimate,
    ) -> Correction | None:
        """Begin a search if the robot is lost (`FastSlam.is_lost`), or continue the search. The map is
        unchanged: `_apply` changes it by the result.

        Returns:
            The restart with which a search begins; the pose, the loop or the failure with which it ends; None
            while nothing changes and if the parameter `relocalisation.method` is "none".
        """
        p, relocaliser = self._parameters, self._relocaliser
        if p.relocalisation.method == "none":
            return None
        if relocaliser.is_searching:
            run = self._history(self._known_history(estimate))
            return relocaliser.search(index, motion, found.detections, scan.free, p, run)
        return relocaliser.begin(index, found.detections, scan.free, p) if self._slam.is_lost else None

    def _check_faults(
        self, step: Step, scan: SegmentedScan, estimate: PoseEstimate
    ) -> tuple[PoseEstimate, tuple[str, ...]]:
        """Update the faults of the run. Return the estimate, whose pose quality is not good while a fault
        lasts, and the messages about new faults."""
        # By the counts, since a scan that was segmented before has no points.
        returns, lost = scan.counts.get("returns", 0), scan.counts.get("out of range", 0)
        is_empty = self._parameters.ground.method != "none" and 0 < returns == lost
        no_ground = NO_GROUND in scan.warnings
        reasons = reasons_of(estimate.health, is_ground_missing=no_ground, is_empty=is_empty)
        self._faults, messages = self._faults.after_scan(step.scan.stamp_ns, reasons)
        if estimate.health.state == "good" and self._faults.message:
            health = replace(estimate.health, state="weak", reason=self._faults.message)
            return replace(estimate, health=health), messages
        return estimate, messages

    def _check_loop(self, estimate: PoseEstimate) -> LoopClosure | Smoothing | None:
        """Return the loop that the robot has just closed, by a constellation or by doubled trees, or
        `Smoothing` if the graph is to be solved; None otherwise, at a scan that is no keyframe, and during
        the search of a lost robot. Loops are not searched for if the parameter `relocalisation.method` is
        "none"."""
        p = self._parameters.relocalisation
        if self._relocaliser.is_searching or not self._slam.is_keyframe:
            return None
        if p.method != "none" and len(self._path) > 1:
            with self._timer("slam"):
                is_due, known = self._is_search_due(), self._known_history(estimate)
                loop, displaced = found = detection.search_loops(self._history(known), p, is_due=is_due)
                self._inputs.search = LoopSearch(known, is_due, found)
            if loop is not None:
                return LoopClosure(loop)
            if displaced is not None:
                return LoopClosure(displaced, is_doubled=True)
        return Smoothing() if self._slam.is_smoothing_due else None

    def _is_search_due(self) -> bool:
        """Return whether a loop is to be searched for at a keyframe: while known places are contradicted, and
        each EVERY metres where the pose was uncertain (`detection.is_uncertain`)."""
        slam = self._slam
        if slam.state.places.contradicted:
            return True
        recent = self._path.sigma_xy[slam.first_scan_within(detection.LATELY) :]
        return slam.is_keyframe_every(detection.EVERY) and detection.is_uncertain(recent)

    def _known_history(self, estimate: PoseEstimate) -> Callable[..., detection.RunHistory]:
        """Return `_history` without path and trees, as a function of them."""
        return partial(
            detection.RunHistory, begun_since=self._slam.begun_since, T_map_particle=self._slam.best_pose,
            estimate=lean(estimate), noise=noise_of(self._parameters.slam), placed=self._placed,
            closed=self._closed, contradicted=self._slam.state.places.contradicted,
        )  # fmt: skip

    def _history(self, known: Callable[..., detection.RunHistory]) -> detection.RunHistory:
        """Return path and map for the search of loops, with the pose at the newest scan."""
        return known(
            stamp_ns=self._path.stamp_ns, path=self._slam.path(), trees=self._tracker.trees(),
            motion=self._path.motion,
        )  # fmt: skip

    def _apply(
        self, index: int, correction: Correction | None, estimate: PoseEstimate
    ) -> tuple[PoseEstimate, Correction | None]:
        """Correct SLAM, trees, columns and terrain by a decision. A loop, a located pose and a failed search
        end the search and discard the stored states of the relocaliser (`Relocaliser.reset`). A smoothing
        keeps them: where the robot was carried away before it, the smoothing is wrong as well, and a restart
        must revert it. Where it was carried away later, the graph of the stored state is solved again after
        the next revisit.

        Args:
            index: Number of the scan.
            correction: The decision; None changes nothing.
            estimate: Pose before the correction.

        Returns:
            The corrected pose, and the correction that was applied. A graph without solution changes nothing
            (None), and so does a loop that the graph contradicts, unless the robot was lost; then it is
            located by it.
        """
        slam = self._slam
        match correction:
            case None:
                return estimate, None
            case Restart(state=state, motions=motions):
                recent = slam.state.recent
                self._restore_map(state)
                for scan, motion in motions:
                    estimate = slam.process(scan, motion, no_detections(), NOTHING_FREE)
                slam.state = replace(slam.state, recent=recent)
                return replace(estimate, health=slam.health_without_detections(estimate)), correction
            case Smoothing():
                if not self._correct_map(slam.smooth(index), estimate):
                    return estimate, None
                return slam.estimate(estimate), correction
            case LoopClosure(loop=loop, stems=stems, is_doubled=is_doubled):
                if self._correct_map(slam.close(index, loop), estimate):
                    self._closed = index
                    estimate = slam.estimate(estimate)
                elif stems is None:
                    return estimate, DoubledTrees() if is_doubled else None
                else:  # the graph contradicts the path to the place, not the place itself
                    located = RelocalisedPose(loop.T_map_base, loop.covariance, stems)
                    return self._apply(index, located, estimate)
            case RelocalisedPose(T_map_base=pose, covariance=covariance):
                slam.place(index, pose, covariance)
                self._placed = index + 1
                estimate = slam.estimate(estimate)
            case SearchFailure():
                slam.reset_health()
            case DoubledTrees():
                return estimate, correction
        self._relocaliser.reset()
        return estimate, correction

    def _correct_map(self, correction: PathCorrection | None, before: PoseEstimate) -> bool:
        """Move trees, columns and terrain with the path; return whether there is a correction.

        Trees move with each correction. Columns and terrain move only when the corrections since they last
        moved can together displace a column within `range_max` by CORRECTION_MIN or more; the result is True
        also if they do not move yet.

        Args:
            correction: None changes nothing.
            before: The estimate before the correction; its health and associations are kept.
        """
        if correction is None:
            return False
        estimate = self._slam.estimate(before)
        landmarks = self._slam.landmarks()
        of_map = self._slam.map_error(landmarks)
        self._inputs.corrections += (TreeCorrection(correction, lean(estimate), landmarks, of_map),)
        self._tracker.correct(correction, self._path.stamp_ns, estimate, landmarks, of_map)
        self._delayed = correction if self._delayed is None else self._delayed.followed_by(correction)
        if self._delayed.largest(self.parameters.classification.range_max) >= CORRECTION_MIN:
            self._columns.correct(self._delayed)
            self._terrain.correct(self._delayed)
            self._delayed = None
        return True

    def _restore_map(self, before: MapperState) -> None:
        """Return to SLAM, columns, terrain and trees of an earlier state, which is unchanged; path, odometry
        and the numbers of trees continue."""
        self._slam.state = before.slam.copy()
        self._columns.restore(before.gathering)
        self._terrain.state = before.ground
        self._delayed = before.delayed
        self._tracker.tracks = before.tracks.copy()

    # --- result ---------------------------------------------------------------------------------------

    def _frame(
        self,
        step: Step,
        scan: SegmentedScan,
        found: DetectionResult,
        estimate: PoseEstimate,
        notices: tuple[str, ...],
        *corrections: Correction | None,
    ) -> Frame:
        """Return the results of a scan: its points, clusters and detections, the pose, and the present trees,
        columns and terrain.

        Args:
            step: The scan.
            scan: The segmented scan.
            found: Its clusters with verdicts, and its detections.
            estimate: Pose after all corrections.
            notices: Warnings of the motion.
            corrections: Corrections that were applied, whose messages become warnings; None for none.

        Returns:
            The frame. `columns` is None unless the classification method is "columns", `ground` is None if
            the ground method is "none"; `T_odom_base` is the last known odometry, the identity before it.
        """
        terrain, p = self._terrain.state, self._parameters
        base_z = (terrain.sensor_z or 0.0) - float(scan.sensor_offset[2]) if terrain.scans else 0.0
        messages = [text for c in corrections if c is not None for text in c.messages]
        health = estimate.health.warnings(step.doubt)
        return Frame(
            index=step.index,
            stamp_ns=step.scan.stamp_ns,
            raw=scan.raw,
            filtered=scan.filtered,
            labels=scan.labels,
            clusters=found.clusters,
            detections=found.detections,
            estimate=estimate,
            T_odom_base=self._odometry or Pose2(),
            sensor_offset=scan.sensor_offset,
            trees=self._tracker.trees(),
            counts=scan.counts,
            warnings=(*step.warnings, *scan.warnings, *notices, *health, *messages),
            columns=self._columns.columns if p.classification.method == "columns" else None,
            ground=None if p.ground.method == "none" else terrain.record,
            base_z=base_z,
            clearance=scan.clearance,
        )


@dataclass(slots=True)
class _Inputs:
    """What the present scan gives to the trees, see `TreeInput`."""

    keeps_state: bool = False
    seen: tuple[Detections, Landmarks, Float | None] | None = None
    columns: Columns | None = None
    votes: ColumnVotes | None = None
    search: LoopSearch | None = None
    corrections: tuple[TreeCorrection, ...] = ()

    def of(self, log: TreeLog, stamp_ns: int, step: Pose2, estimate: PoseEstimate) -> TreeInput:
        """Return the entry of a log."""
        columns = None if self.columns is None else log.lean(self.columns)
        return TreeInput(
            stamp_ns, step, lean(estimate), self.keeps_state, self.seen, columns, self.votes, self.search,
            self.corrections,
        )  # fmt: skip
