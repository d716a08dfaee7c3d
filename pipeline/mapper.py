"""The mapper: what becomes of one scan, from top to bottom. It reads as section 3 of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from pipeline.gathering import Forest, Gathering, GatheringState, View, steepest_by_direction
from pipeline.geometry import Float, Pose2, Pose3
from pipeline.growing_path import GrowingPath
from pipeline.gyro import fused
from pipeline.height_map import HeightMapper, HeightMapState
from pipeline.parameters import Parameters
from pipeline.perception import Seen, perceive
from pipeline.records import Frame, HeightMap, Int, Path, PoseEstimate, Sensor, Step
from pipeline.recovery import Mapped, Recovery, RecoveryState
from pipeline.slam import BackEnd, BackEndState, Motion
from pipeline.slam.motion import noise_of, step_variances
from pipeline.tracking import Tracker
from pipeline.tracking.table import TrackTable
from pipeline.turns import is_fused, is_gathered
from pipeline.watch import Watch, no_watch


@dataclass(frozen=True, slots=True, eq=False)
class MapperState:
    """An independent copy of all that the mapper knows between two scans."""

    slam: BackEndState
    gathering: GatheringState
    ground: HeightMapState
    tracks: TrackTable
    next_number: int
    odometry: Pose2 | None
    path_length: int
    recovery: RecoveryState[MapperState] = field(default_factory=RecoveryState)


class Mapper:
    """Maps a run scan by scan. Knows no clock, no thread and no file.

    Args:
        parameters: Of all stages; may be replaced between two scans.
        sensor: The LiDAR.
        T_base_lidar: Where it stands on the robot.
        seed: Of every random number.
        watch: Is entered around each stage with its name, so that the caller can measure it.
        forest: Votes on what was gathered; None takes the one that comes with the package.
    """

    def __init__(
        self,
        parameters: Parameters,
        *,
        sensor: Sensor,
        T_base_lidar: Pose3,
        seed: int,
        watch: Watch = no_watch,
        forest: Forest | None = None,
    ) -> None:
        self._parameters = parameters
        self._sensor = sensor
        self._T_base_lidar = T_base_lidar
        self._watch = watch
        self._slam = BackEnd(parameters.slam, seed)
        self._gathering = Gathering(parameters.gathering, all_around=sensor.rings > 0, forest=forest)
        self._ground = HeightMapper()
        self._tracker = Tracker(parameters.tracking)
        self._odometry: Pose2 | None = None
        self._path = GrowingPath()
        self._recovery: Recovery[MapperState] = Recovery(seed)

    @property
    def parameters(self) -> Parameters:
        """The parameters in force; new ones act from the next scan on."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self._slam.parameters = parameters.slam
        self._gathering.parameters = parameters.gathering
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
        p, watch = self._parameters, self._watch

        seen = perceive(step, self._sensor, self._T_base_lidar, p, watch)

        with watch("slam"):
            motion, odometry = self._motion(step)
            moved = self._with_gyro(step, motion)
            estimate, told = self._recovery.locate(
                step.index,
                moved,
                seen.detections,
                seen.free,
                p,
                Mapped(self._slam, self._known, self._take_back, self._tracker.trees),
            )

        if not self._recovery.searching:  # while it is lost, the map stays as it is
            self._track(step.scan.stamp_ns, seen, estimate)
            self._map(step, seen, estimate)
        elif self._gathering.is_unsettled:
            with watch("gathering"):
                self._gathering.settle()

        trees = self._tracker.trees()

        self._path.append(step.scan.stamp_ns, estimate)
        return Frame(
            index=step.index,
            stamp_ns=step.scan.stamp_ns,
            raw=seen.raw,
            filtered=seen.filtered,
            labels=seen.labels,
            clusters=seen.clusters,
            detections=seen.detections,
            estimate=estimate,
            T_odom_base=odometry,
            sensor_offset=seen.sensor_offset,
            trees=trees,
            counts={
                "returns": len(step.scan.points),
                "without a value": step.scan.dropped,
                "out of range": len(step.scan.points) - len(seen.raw),
                **seen.counts,
            },
            warnings=(*step.warnings, *seen.warnings, *told),
            columns=self._gathering.columns if p.gathering.method == "columns" else None,
            ground=None if p.ground.method == "none" else self._ground.state.record,
            base_z=(self._ground.state.sensor_z or 0.0) - float(seen.sensor_offset[2])
            if self._ground.state.scans
            else 0.0,
        )

    def _with_gyro(self, step: Step, motion: Pose2) -> Motion:
        moved = Motion(motion, step.slack, step.doubt, step.measured)
        if step.turn is None or step.T_odom_base is None or not self._parameters.acquisition.gyro:
            return moved
        _, variance = step_variances(motion.x, motion.y, motion.yaw, noise_of(self._parameters.slam))
        sigma = math.sqrt(variance)
        turned, turn_sigma, slack, doubt = fused(motion, sigma, step.slack, step.turn)
        return moved._replace(step=turned, slack=slack, doubt=step.doubt or doubt, turn_sigma=turn_sigma)

    def _track(self, stamp_ns: int, seen: Seen, estimate: PoseEstimate) -> None:
        """Each tree's own filter: section 3.5."""
        tracker, view_range = self._tracker, self._parameters.slam.view_range
        with self._watch("tracking"):
            tracker.process(
                stamp_ns,
                estimate.T_map_base,
                estimate.covariance,
                seen.detections,
                seen.free,
                view_range,
                seen.heights,
                estimate.relative,
            )
            tracker.anchor(*self._slam.landmarks(), estimate.T_map_base, view_range)

    def _map(self, step: Step, seen: Seen, estimate: PoseEstimate) -> None:
        """What is not taken from every scan (see turns): the columns that judge the trees, and the ground."""
        p, watch = self._parameters.gathering, self._watch
        if seen.above is not None and p.method == "columns" and is_gathered(step.index, p.every):
            boxed, height, terrain = seen.above
            with watch("gathering"):
                steepest = steepest_by_direction(seen.raw, seen.sensor_offset, self._sensor.rings > 0)
                view = View(estimate.T_map_base, seen.sensor_offset, seen.free, steepest, terrain.height)
                self._gathering.add(boxed, height, step.index, view)
                self._tracker.judge(step.scan.stamp_ns, self._gathering.columns)
        elif self._gathering.is_unsettled:
            with watch("gathering"):
                self._gathering.settle()

        if seen.above is not None and is_fused(step.index, p.every):
            with watch("height map"):
                self._ground.add(seen.above[2], estimate.T_map_base, seen.sensor_offset)

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
            self._recovery.state.copy(),
        )

    def load(self, state: MapperState, stamp_ns: Int, sigma_xy: Float) -> None:
        """Go on from a state of another mapper; `stamp_ns` and `sigma_xy` are its path's, one a scan."""
        self._path = GrowingPath(stamp_ns, sigma_xy)
        self.restore(state)

    def place(self, index: int, T_map_base: Pose2, covariance: Float) -> None:
        """Say where the base stands before scan `index`; its odometry begins anew there.

        Args:
            covariance: Of x, y [m], yaw [rad], shape (3, 3).
        """
        self._slam.place(index, T_map_base, covariance)
        self._odometry = None

    def restore(self, state: MapperState) -> None:
        """Go back to a snapshot of this mapper's own past; the state itself is left untouched."""
        self._take_back(state)
        self._tracker.next_number = state.next_number
        self._odometry = state.odometry
        self._path.cut(state.path_length)
        self._recovery.state = state.recovery.copy()

    def _take_back(self, before: MapperState) -> None:
        """Leave the map as it was in a state; path, odometry and the numbers of trees go on."""
        self._slam.state = before.slam.copy()
        self._gathering.restore(before.gathering)
        self._ground.state = before.ground
        self._tracker.tracks = before.tracks.copy()

    def _known(self) -> MapperState:
        return replace(self.snapshot(), recovery=RecoveryState())
