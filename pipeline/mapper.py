"""The mapper: what becomes of one scan, from top to bottom. It reads as section 3 of the paper."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.classification import ForestOf, Gathering, View, package_alone
from pipeline.config import Parameters
from pipeline.front_end import Looked, decide, look
from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.ground.terrain_map import HeightMapper
from pipeline.late import after
from pipeline.loop_closure import detection
from pipeline.loop_closure.kidnapped_robot import Mapped, Recovery, RecoveryState
from pipeline.mapper_records import Located, MapperState, Noted
from pipeline.odometry.gyro import fused
from pipeline.slam import BackEnd, Loop, Motion
from pipeline.slam.motion import noise_of, step_variances
from pipeline.slam.pose_gate import REFUSED, within_gate
from pipeline.slam.trajectory_buffer import GrowingPath
from pipeline.stage_timer import Watch, no_watch
from pipeline.tracking import Tracker
from pipeline.types.records import Frame, HeightMap, Int, Path, PoseEstimate, Sensor, Step, Trees

LOOP = "a loop is closed: path and map since the place was left are bent, so that the trees there stand once"


class Mapper:
    """Maps a run scan by scan. Knows no clock, no thread and no file.

    Args:
        parameters: Of all stages; may be replaced between two scans.
        sensor: The LiDAR.
        T_base_lidar: Where it stands on the robot.
        seed: Of every random number.
        watch: Is entered around each stage with its name, so that the caller can measure it.
        forests: Where the forest is found that votes on what was gathered.

    Attributes:
        note: Is told of each scan once it is mapped; None where nobody listens.

    Raises:
        StemmapError: There is no such forest.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        sensor: Sensor,
        T_base_lidar: Pose3,
        seed: int,
        watch: Watch = no_watch,
        forests: ForestOf = package_alone,
    ) -> None:
        self._parameters = parameters
        self._sensor = sensor
        self._T_base_lidar = T_base_lidar
        self._watch = watch
        self._slam = BackEnd(parameters.slam, seed)
        self._gathering = Gathering(parameters.classification, all_around=sensor.rings > 0, forests=forests)
        self._ground = HeightMapper()
        self._tracker = Tracker(parameters.tracking)
        self._odometry: Pose2 | None = None
        self._path = GrowingPath()
        self._placed = self._closed = 0
        self._last: tuple[Pose2, Float] | None = None
        self._recovery: Recovery[MapperState] = Recovery(seed)
        self.note: Callable[[Noted], None] | None = None
        self._asked_trees = False

    @property
    def parameters(self) -> Parameters:
        """The parameters in force; new ones act from the next scan on."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self._gathering.parameters = parameters.classification  # first: it may not find its forest
        self._parameters = parameters
        self._slam.parameters = parameters.slam
        self._tracker.parameters = parameters.tracking

    @property
    def path(self) -> Path:
        """The path so far, one row a scan. A scan may change its past: it is that of the particle which
        explains the scans best now, as the trees are."""
        return self._path.columns(self._slam.path())

    @property
    def height_map(self) -> HeightMap:
        """The ground as all scans so far saw it."""
        return self._ground.record()

    def process(self, step: Step) -> Frame:
        """Map one scan."""
        return self.take(step, self.look(step))

    def look(self, step: Step) -> Looked:
        """What a scan shows; nothing of it is taken into the map yet."""
        return look(step, self._sensor, self._T_base_lidar, self._parameters, self._watch)

    def looker(self) -> Callable[[Step], Looked]:
        """The same with the parameters of now, unwatched: it knows nothing of the mapper, so that it may look
        at other scans meanwhile."""
        sensor, T_base_lidar, parameters = self._sensor, self._T_base_lidar, self._parameters
        return lambda step: look(step, sensor, T_base_lidar, parameters)

    def take(self, step: Step, looked: Looked) -> Frame:
        """Map a scan by what it shows: all of `process` that hangs on more than the scan itself. Of the
        step's scan only the time is asked."""
        return self.map(self.locate(step, looked))

    def locate(self, step: Step, looked: Looked, caught_up: Callable[[], None] = lambda: None) -> Located:
        """The first half of `take`: where the scan was taken.

        The next scan may be located, in another thread too, while this one is mapped, unless `may_close` says
        that it has to wait.

        Args:
            caught_up: Is called before anything is asked of the map, or done to it; returns once all scans
                before this one are mapped.
        """
        p = self._parameters
        self._asked_trees = False
        seen = decide(looked, p.detection, self._watch)

        with self._watch("slam"):
            motion, odometry = self._motion(step)
            moved, refused = self._gated(self._with_gyro(step, motion))
            estimate, told = self._recovery.locate(
                step.index,
                moved,
                seen.detections,
                looked.free,
                p,
                Mapped(
                    self._slam,
                    after(caught_up, self._known),
                    after(caught_up, self._take_back),
                    after(caught_up, self._trees),
                    after(
                        caught_up,
                        lambda estimate: self._mapped(
                            estimate, np.concatenate([self._path.motion, [moved.step.as_array()]])
                        ),
                    ),
                    after(caught_up, lambda loop: self._bend(step.index, loop)),
                    lambda pose, covariance: self._put(step.index, pose, covariance, step.index + 1),
                ),
            )
            landmarks = self._slam.landmarks()

        self._path.append(step.scan.stamp_ns, estimate, moved.step)
        self._last = (estimate.T_map_base, estimate.covariance)
        searching = self._recovery.searching
        sought = p.relocalisation.method != "none" and not searching
        return Located(
            step=step,
            seen=seen,
            estimate=estimate,
            T_odom_base=odometry,
            warnings=(*refused, *estimate.health.warnings(step.doubt), *told),
            landmarks=landmarks,
            searching=searching,
            asked_trees=self._asked_trees,
            may_close=sought and detection.is_due(step.index, self._path.sigma_xy),
        )

    def map(self, located: Located) -> Frame:
        """The second half of `take`: what the scan makes of the map."""
        p, step, looked = self._parameters, located.step, located.seen.looked
        estimate, told = located.estimate, located.warnings

        if not located.searching:  # while it is lost, the map stays as it is
            self._track(located)
            self._map(step, looked, estimate)
        elif self._gathering.is_unsettled:
            with self._watch("gathering"):
                self._gathering.settle()

        if located.may_close:
            located, closed = self._close_loop(located)
            if closed:
                estimate, told = located.estimate, (*told, LOOP)
        trees = self._tracker.trees()
        if self.note is not None:
            self.note(self._noted(located))
        return Frame(
            index=step.index,
            stamp_ns=step.scan.stamp_ns,
            raw=looked.raw,
            filtered=looked.filtered,
            labels=looked.labels,
            clusters=located.seen.clusters,
            detections=located.seen.detections,
            estimate=estimate,
            T_odom_base=located.T_odom_base,
            sensor_offset=looked.sensor_offset,
            trees=trees,
            counts=looked.counts,
            warnings=(*step.warnings, *looked.warnings, *told),
            columns=self._gathering.columns if p.classification.method == "columns" else None,
            ground=None if p.ground.method == "none" else self._ground.state.record,
            base_z=(self._ground.state.sensor_z or 0.0) - float(looked.sensor_offset[2])
            if self._ground.state.scans
            else 0.0,
            clearance=looked.clearance,
        )

    def _noted(self, located: Located) -> Noted:
        gathered = located.seen.looked.overview is not None and not located.searching
        return Noted(
            located.step.index,
            located.step.scan.stamp_ns,
            located.seen,
            located.estimate,
            located.landmarks,
            self._gathering.columns if gathered else None,
            not located.asked_trees and not located.searching,
        )

    def _trees(self) -> Trees:
        """For stages before the tracking."""
        self._asked_trees = True
        return self._tracker.trees()

    def _with_gyro(self, step: Step, motion: Pose2) -> Motion:
        moved = Motion(motion, step.slack, step.doubt, step.measured)
        if step.turn is None or step.T_odom_base is None or not self._parameters.acquisition.gyro:
            return moved
        _, variance = step_variances(motion.x, motion.y, motion.yaw, noise_of(self._parameters.slam))
        sigma = math.sqrt(variance)
        turned, turn_sigma, slack, doubt = fused(motion, sigma, step.slack, step.turn)
        return moved._replace(step=turned, slack=slack, doubt=step.doubt or doubt, turn_sigma=turn_sigma)

    def _gated(self, moved: Motion) -> tuple[Motion, tuple[str, ...]]:
        """The motion without a measured pose that cannot be, and what to say of that."""
        if self._last is None or moved.measured is None:
            return moved, ()
        expected = moved._replace(measured=self._slam.as_seen(moved.measured))
        if within_gate(*self._last, expected, noise_of(self._parameters.slam)):
            return moved, ()
        return moved._replace(measured=None), (REFUSED,)

    def _track(self, located: Located) -> None:
        """Each tree's own filter: section 3.5."""
        tracker, view_range = self._tracker, self._parameters.slam.view_range
        seen, estimate = located.seen, located.estimate
        with self._watch("tracking"):
            tracker.process(
                located.step.scan.stamp_ns,
                estimate.T_map_base,
                estimate.covariance,
                seen.detections,
                seen.looked.free,
                view_range,
                seen.heights,
                estimate.relative,
            )
            tracker.anchor(*located.landmarks, estimate.T_map_base, view_range)
            # Of a scan that is gathered the columns are judged anew, and all tracks by them.
            if seen.looked.overview is None and self._parameters.classification.method == "columns":
                tracker.learn_between(self._gathering.columns)

    def _map(self, step: Step, looked: Looked, estimate: PoseEstimate) -> None:
        """What is not taken from every scan (see turns): the columns that judge the trees, and the ground."""
        watch, over = self._watch, looked.overview
        if over is not None:
            with watch("gathering"):
                view = View(
                    estimate.T_map_base,
                    looked.sensor_offset,
                    looked.free,
                    over.steepest,
                    over.depth,
                    over.terrain,
                )
                self._gathering.add(over.points, over.height, step.index, view)
                p = self._parameters.classification
                columns = self._tracker.judge(step.scan.stamp_ns, self._gathering.columns, p)
                self._gathering.columns = columns
        elif self._gathering.is_unsettled:
            with watch("gathering"):
                self._gathering.settle()

        if looked.terrain is not None:
            with watch("height map"):
                self._ground.add(looked.terrain, estimate.T_map_base, looked.sensor_offset)

    def _close_loop(self, located: Located) -> tuple[Located, bool]:
        """What is known of the scan after a loop was looked for, and whether it closed one: see
        `pipeline.loop_closure.detection`."""
        index, estimate = located.step.index, located.estimate
        self._asked_trees = located.asked_trees
        with self._watch("slam"):
            run = self._mapped(estimate, self._path.motion)
            loop = detection.find_loop(run, self._parameters.relocalisation)
            if loop is not None:
                self._bend(index, loop)
                self._recovery.forget()
                estimate = self._slam.estimate(estimate)
                self._last = (estimate.T_map_base, estimate.covariance)
        known = replace(
            located, estimate=estimate, landmarks=self._slam.landmarks(), asked_trees=self._asked_trees
        )
        return known, loop is not None

    def _mapped(self, estimate: PoseEstimate, motion: Float) -> detection.Mapped:
        path, noise = self._slam.path(), noise_of(self._parameters.slam)
        return detection.Mapped(
            self._path.stamp_ns, path, self._trees, self._slam.begun_since, estimate, noise, motion,
            self._placed, self._closed,
        )  # fmt: skip

    def _bend(self, index: int, loop: Loop) -> None:
        """Close a loop: path and map are bent."""
        bend = self._slam.close(index, loop)
        self._tracker.bend(bend, self._path.stamp_ns)
        self._tracker.hold_to(self._slam.known(), bend, self._path.stamp_ns)
        self._gathering.bend(bend)
        self._ground.bend(bend)
        self._closed = index

    def _put(self, index: int, T_map_base: Pose2, covariance: Float, first: int) -> None:
        """Put the base somewhere; `first`: the scan from which on the path goes on there."""
        self._slam.place(index, T_map_base, covariance)
        self._placed, self._last = first, (T_map_base, covariance)

    def _motion(self, step: Step) -> tuple[Pose2, Pose2]:
        """The odometry's step since the last scan that had one, and its pose; without any the robot
        stands still."""
        before, now = self._odometry, step.T_odom_base
        if now is None:
            return Pose2(), before or Pose2()
        self._odometry = now
        return Pose2() if before is None else before.inverse() @ now, now

    def snapshot(self) -> MapperState:
        """All state, copied; parameters are not part of it."""
        return MapperState(
            self._slam.state.copy(),
            self._gathering.snapshot(),
            self._ground.state,
            self._tracker.tracks.copy(),
            self._tracker.next_number,
            self._odometry,
            len(self._path),
            self._placed,
            self._closed,
            self._recovery.state.copy(),
            self._last,
        )

    def load(self, state: MapperState, stamp_ns: Int, sigma_xy: Float, motion: Float) -> None:
        """Go on from a state of another mapper; `stamp_ns`, `sigma_xy` and `motion`, by the odometry to each
        scan from the one before, are its path's, one a scan."""
        self._path = GrowingPath(stamp_ns, sigma_xy, motion)
        self.restore(state)

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Say where the base stands before scan `index`; its odometry begins anew there.

        Args:
            covariance: Of x, y [m], yaw [rad], shape (3, 3).
        """
        self._put(index, T_map_base, covariance, index)
        self._odometry = None

    @property
    def motion(self) -> Float:
        """x, y [m], yaw [rad] by the odometry to each scan from the one before, shape (N, 3)."""
        return self._path.motion.copy()

    def restore(self, state: MapperState) -> None:
        """Go back to a snapshot of this mapper's own past; the state itself is left untouched."""
        self._take_back(state)
        self._tracker.next_number = state.next_number
        self._odometry = state.odometry
        self._path.cut(state.path_length)
        self._placed, self._closed, self._last = state.placed, state.closed, state.last
        self._recovery.state = state.recovery.copy()

    def _take_back(self, before: MapperState) -> None:
        """Leave the map as it was in a state; path, odometry and the numbers of trees go on."""
        self._slam.state = before.slam.copy()
        self._gathering.restore(before.gathering)
        self._ground.state = before.ground
        self._tracker.tracks = before.tracks

    def _known(self) -> MapperState:
        return replace(self.snapshot(), recovery=RecoveryState())
