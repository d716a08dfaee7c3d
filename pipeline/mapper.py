"""The mapper: what becomes of one scan, from top to bottom. It reads as section 3 of the paper."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline import loops
from pipeline.gathering import ForestOf, Gathering, GatheringState, View, package_alone
from pipeline.geometry import Float, Pose2, Pose3
from pipeline.growing_path import GrowingPath
from pipeline.gyro import fused
from pipeline.height_map import HeightMapper, HeightMapState
from pipeline.innovation import REFUSED, within_gate
from pipeline.parameters import Parameters
from pipeline.perception import Looked, Seen, decide, look
from pipeline.records import Columns, Frame, HeightMap, Int, Path, PoseEstimate, Sensor, Step, Trees
from pipeline.recovery import Mapped, Recovery, RecoveryState
from pipeline.slam import BackEnd, BackEndState, Loop, Motion
from pipeline.slam.motion import noise_of, step_variances
from pipeline.tracking import Tracker
from pipeline.tracking.table import TrackTable
from pipeline.watch import Watch, no_watch

LOOP = "a loop is closed: path and map since the place was left are bent, so that the trees there stand once"


@dataclass(frozen=True, slots=True, eq=False)
class MapperState:
    """An independent copy of all that the mapper knows between two scans.

    `placed` is the scan since which the path is driven: no odometry leads to it, for the robot was put there;
    `closed` the one at which the last loop was closed; `last` the pose after the last scan, and how sure.
    """

    slam: BackEndState
    gathering: GatheringState
    ground: HeightMapState
    tracks: TrackTable
    next_number: int
    odometry: Pose2 | None
    path_length: int
    placed: int = 0
    closed: int = 0
    recovery: RecoveryState[MapperState] = field(default_factory=RecoveryState)
    last: tuple[Pose2, Float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Noted:
    """What the stages made of one scan, for who wants to begin again at a later one of them.

    Attributes:
        seen: What the scan showed; estimate: where that was.
        landmarks: Of SLAM after the scan: positions, shape (L, 2) [m], and covariances xx, xy, yy, (L, 3).
        columns: What is gathered, where the scan was; else None.
        is_usual: Whether neither the pose nor the map hung on the trees: the robot was not lost, and no loop
            was looked for among them.
    """

    index: int
    stamp_ns: int
    seen: Seen
    estimate: PoseEstimate
    landmarks: tuple[Float, Float]
    columns: Columns | None
    is_usual: bool


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
        self._gathering = Gathering(parameters.gathering, all_around=sensor.rings > 0, forests=forests)
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
        self._gathering.parameters = parameters.gathering  # first: it may not find its forest
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
                    self._known,
                    self._take_back,
                    self._trees,
                    lambda estimate: self._mapped(
                        estimate, np.concatenate([self._path.motion, [moved.step.as_array()]])
                    ),
                    lambda loop: self._bend(step.index, loop),
                    lambda pose, covariance: self._put(step.index, pose, covariance, step.index + 1),
                ),
            )

        if not self._recovery.searching:  # while it is lost, the map stays as it is
            self._track(step.scan.stamp_ns, seen, estimate)
            self._map(step, looked, estimate)
        elif self._gathering.is_unsettled:
            with self._watch("gathering"):
                self._gathering.settle()

        self._path.append(step.scan.stamp_ns, estimate, moved.step)
        closed = self._close_loop(step.index, estimate)
        if closed is not None:
            estimate, told = closed, (*told, LOOP)
        self._last = (estimate.T_map_base, estimate.covariance)
        trees = self._tracker.trees()
        if self.note is not None:
            self.note(self._noted(step, seen, estimate))
        return Frame(
            index=step.index,
            stamp_ns=step.scan.stamp_ns,
            raw=looked.raw,
            filtered=looked.filtered,
            labels=looked.labels,
            clusters=seen.clusters,
            detections=seen.detections,
            estimate=estimate,
            T_odom_base=odometry,
            sensor_offset=looked.sensor_offset,
            trees=trees,
            counts=looked.counts,
            warnings=(*step.warnings, *looked.warnings, *refused, *told),
            columns=self._gathering.columns if p.gathering.method == "columns" else None,
            ground=None if p.ground.method == "none" else self._ground.state.record,
            base_z=(self._ground.state.sensor_z or 0.0) - float(looked.sensor_offset[2])
            if self._ground.state.scans
            else 0.0,
            clearance=looked.clearance,
        )

    def _noted(self, step: Step, seen: Seen, estimate: PoseEstimate) -> Noted:
        gathered = seen.looked.overview is not None and not self._recovery.searching
        return Noted(
            step.index,
            step.scan.stamp_ns,
            seen,
            estimate,
            self._slam.landmarks(),
            self._gathering.columns if gathered else None,
            not self._asked_trees and not self._recovery.searching,
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
        noise = noise_of(self._parameters.slam)
        if self._last is None or within_gate(*self._last, moved, noise):
            return moved, ()
        return moved._replace(measured=None), (REFUSED,)

    def _track(self, stamp_ns: int, seen: Seen, estimate: PoseEstimate) -> None:
        """Each tree's own filter: section 3.5."""
        tracker, view_range = self._tracker, self._parameters.slam.view_range
        with self._watch("tracking"):
            tracker.process(
                stamp_ns,
                estimate.T_map_base,
                estimate.covariance,
                seen.detections,
                seen.looked.free,
                view_range,
                seen.heights,
                estimate.relative,
            )
            tracker.anchor(*self._slam.landmarks(), estimate.T_map_base, view_range)

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
                p = self._parameters.gathering
                columns = self._tracker.judge(step.scan.stamp_ns, self._gathering.columns, p)
                self._gathering.columns = columns
        elif self._gathering.is_unsettled:
            with watch("gathering"):
                self._gathering.settle()

        if looked.terrain is not None:
            with watch("height map"):
                self._ground.add(looked.terrain, estimate.T_map_base, looked.sensor_offset)

    def _close_loop(self, index: int, estimate: PoseEstimate) -> PoseEstimate | None:
        """The pose after a loop was closed, if this scan closes one: see `pipeline.loops`."""
        p = self._parameters.relocalisation
        if p.method == "none" or self._recovery.searching or not loops.is_due(index, self._path.sigma_xy):
            return None
        with self._watch("slam"):
            loop = loops.find_loop(self._mapped(estimate, self._path.motion), p)
            if loop is None:
                return None
            self._bend(index, loop)
            self._recovery.forget()
            return self._slam.estimate(estimate)

    def _mapped(self, estimate: PoseEstimate, motion: Float) -> loops.Mapped:
        path, noise = self._slam.path(), noise_of(self._parameters.slam)
        return loops.Mapped(
            self._path.stamp_ns,
            path,
            self._trees,
            self._slam.begun_since,
            estimate,
            noise,
            motion,
            self._placed,
            self._closed,
        )

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
        self._tracker.tracks = before.tracks.copy()

    def _known(self) -> MapperState:
        return replace(self.snapshot(), recovery=RecoveryState())
