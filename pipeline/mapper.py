"""The mapper: what becomes of one scan, from top to bottom. It reads as section 3 of the paper."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline import filters, ground
from pipeline.acquisition import acquire
from pipeline.clustering import cluster
from pipeline.detection import detections, judge
from pipeline.gathering import Forest, Gathering, GatheringState, View, steepest_by_direction
from pipeline.geometry import Float, Pose2, Pose3
from pipeline.growing_path import GrowingPath
from pipeline.height_map import HeightMapper, HeightMapState
from pipeline.parameters import Parameters
from pipeline.records import (
    Clusters,
    Detections,
    Float32,
    Frame,
    HeightMap,
    Int,
    Int32,
    Path,
    PoseEstimate,
    Sensor,
    Stems,
    Step,
    nothing_found,
)
from pipeline.recovery import Recovery, RecoveryState
from pipeline.shape import describe
from pipeline.slam import BackEnd, BackEndState, Motion
from pipeline.stems import take_stems
from pipeline.terrain import NO_GROUND, Terrain, height_above, heights_of_places, shows_ground
from pipeline.tracking import Tracker
from pipeline.tracking.table import TrackTable
from pipeline.turns import is_fused, is_gathered
from pipeline.visibility import BINS, clear_range

ASTRAY = (
    "the robot is lost: what was mapped since the known trees were last seen is taken back, and the map is "
    "searched for the stems around"
)
NOT_FOUND = "the stems around were not found in the map; it goes on where the odometry leads"
NOTHING_FREE: Float = np.zeros(BINS)

Watch = Callable[[str], AbstractContextManager[None]]


def no_watch(_stage: str) -> AbstractContextManager[None]:
    """Measures nothing; stands in where nobody asks for times."""
    return nullcontext()


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

        seen = self._perceive(step) if step.scan.stems is None else self._take_stems(step, step.scan.stems)
        found, free = seen.detections, seen.free

        with watch("slam"):
            motion, odometry = self._motion(step)
            moved = Motion(motion, step.slack, step.doubt, step.measured)
            estimate, told = self._locate(step.index, moved, found, free)
            known = not self._recovery.searching  # while it is lost, the map stays as it is

        with watch("tracking"):
            if known:
                self._tracker.process(
                    step.scan.stamp_ns,
                    estimate.T_map_base,
                    estimate.covariance,
                    found,
                    free,
                    p.slam.view_range,
                    seen.heights,
                )
                self._tracker.anchor(*self._slam.landmarks(), estimate.T_map_base, p.slam.view_range)

        columns = self._gathering.columns if p.gathering.method == "columns" else None
        every = p.gathering.every
        if known and columns is not None and is_gathered(step.index, every) and seen.above is not None:
            boxed, height, terrain = seen.above
            with watch("gathering"):
                steepest = steepest_by_direction(seen.raw, seen.sensor_offset, self._sensor.rings > 0)
                view = View(estimate.T_map_base, seen.sensor_offset, free, steepest, terrain.height)
                self._gathering.add(boxed, height, step.index, view)
                columns = self._gathering.columns
                self._tracker.judge(step.scan.stamp_ns, columns)
        elif self._gathering.is_unsettled:
            with watch("gathering"):
                self._gathering.settle()

        if known and seen.above is not None and is_fused(step.index, every):
            with watch("height map"):
                self._ground.add(seen.above[2], estimate.T_map_base, seen.sensor_offset)

        trees = self._tracker.trees()

        self._path.append(step.scan.stamp_ns, estimate)
        return Frame(
            index=step.index,
            stamp_ns=step.scan.stamp_ns,
            raw=seen.raw,
            filtered=seen.filtered,
            labels=seen.labels,
            clusters=seen.clusters,
            detections=found,
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
            columns=columns,
            ground=None if p.ground.method == "none" else self._ground.state.record,
            base_z=(self._ground.state.sensor_z or 0.0) - float(seen.sensor_offset[2])
            if self._ground.state.scans
            else 0.0,
        )

    def _locate(
        self, index: int, motion: Motion, found: Detections, free: Float
    ) -> tuple[PoseEstimate, tuple[str, ...]]:
        """The pose after a scan, and what a person should know of how it was found."""
        p, recovery = self._parameters, self._recovery
        if p.relocalisation.method == "none":
            recovery.end()
            return self._slam.process(index, motion, found, free), ()
        if not recovery.searching:
            recovery.remember(index, motion, self._known)
            estimate = self._slam.process(index, motion, found, free)
            if not self._slam.is_astray:
                return estimate, ()
            estimate = self._take_back(estimate, found)
            recovery.search(index, Motion(Pose2()), found, free, self._tracker.trees(), p)
            return estimate, (ASTRAY,)
        estimate = self._slam.process(index, motion, nothing_found(found), np.zeros_like(free))
        at = recovery.search(index, motion, found, free, self._tracker.trees(), p)
        if at is not None:
            self._slam.place(index, at.T_map_base, at.covariance)
            recovery.end()
            return self._slam.estimate(estimate), (f"found again in the map by {at.stems} stems that agree",)
        if recovery.is_over:
            self._slam.give_up()
            recovery.end()
            return estimate, (NOT_FOUND,)
        return estimate, ()

    def _take_back(self, estimate: PoseEstimate, found: Detections) -> PoseEstimate:
        """Go back to the map before the robot went astray, and follow the odometry from there."""
        before, motions = self._recovery.begin(self._parameters)
        recent = self._slam.state.recent
        self._slam.state = before.slam.copy()
        self._gathering.restore(before.gathering)
        self._ground.state = before.ground
        self._tracker.tracks = before.tracks.copy()
        for index, motion in motions:
            estimate = self._slam.process(index, motion, nothing_found(found), NOTHING_FREE)
        self._slam.state = replace(self._slam.state, recent=recent)
        return replace(estimate, health=self._slam.lost(estimate))

    def _known(self) -> MapperState:
        return replace(self.snapshot(), recovery=RecoveryState())

    def _perceive(self, step: Step) -> _Seen:
        """From the scan to detections: sections 3.1 to 3.3."""
        p, watch = self._parameters, self._watch

        with watch("acquisition"):
            raw, sensor_offset = acquire(step, self._T_base_lidar, p.acquisition)

        with watch("pass-through"):
            boxed = filters.pass_through(raw, p.filters)

        with watch("ground"):
            terrain = self._terrain(raw)
            height = height_above(boxed, terrain) if terrain else None
            band = boxed if height is None else ground.in_band(boxed, height, p.ground)

        with watch("voxel grid"):
            filtered = filters.voxel_grid(band, p.filters)

        with watch("clustering"):
            labels = cluster(filtered, self._sensor, p.clustering)

        with watch("shape"):
            described = describe(filtered, labels, self._sensor, p.shape)

        with watch("detection"):
            judged = judge(described, p.detection)
            found = detections(judged, sensor_offset, p.detection)
            free = clear_range(raw, filtered, sensor_offset)

        grounded = terrain is not None and shows_ground(terrain)
        return _Seen(
            raw=raw,
            filtered=filtered,
            labels=labels.label,
            clusters=judged,
            detections=found,
            free=free,
            sensor_offset=sensor_offset,
            above=(boxed, height, terrain) if terrain and height is not None else None,
            heights=heights_of_places(judged.centroid[found.cluster], terrain.height)
            if terrain is not None and grounded
            else None,
            warnings=(NO_GROUND,) if terrain is not None and len(raw) and not grounded else (),
            counts={
                "out of the box": len(raw) - len(boxed),
                "ground or too high": len(boxed) - len(band),
                "averaged in voxels": len(band) - len(filtered),
                "clustered": int(np.count_nonzero(labels.label >= 0)),
                "noise": int(np.count_nonzero(labels.label < 0)),
            },
        )

    def _take_stems(self, step: Step, stems: Stems) -> _Seen:
        """From stems that another program found to detections."""
        p, watch = self._parameters, self._watch

        with watch("acquisition"):
            places, sensor_offset, clusters = take_stems(step, stems, self._T_base_lidar, p.acquisition)

        with watch("detection"):
            judged = judge(clusters, p.detection)
            found = detections(judged, sensor_offset, p.detection)
            free = clear_range(places, places, sensor_offset)

        return _Seen(
            raw=places,
            filtered=places,
            labels=np.arange(len(places), dtype=np.int32),
            clusters=judged,
            detections=found,
            free=free,
            sensor_offset=sensor_offset,
            above=None,
            heights=None,
            warnings=(),
            counts={"clustered": len(places)},
        )

    def _terrain(self, raw: Float32) -> Terrain | None:
        if self._parameters.ground.method == "none":
            return None
        return ground.find_terrain(raw, self._parameters.ground)

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
        self._slam.state = state.slam.copy()
        self._gathering.restore(state.gathering)
        self._ground.state = state.ground
        self._tracker.tracks = state.tracks.copy()
        self._tracker.next_number = state.next_number
        self._odometry = state.odometry
        self._path.cut(state.path_length)
        self._recovery.state = state.recovery.copy()


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What one scan shows, before it is known where it was taken; see Frame.

    Attributes:
        free: How far the view is free by direction (see visibility).
        above: Points of the box, their heights above the ground, and the ground; None without a ground.
        heights: Mean height above the ground of what each detection is of, shape (D,) [m]; None where the
            scan shows no ground.
    """

    raw: Float32
    filtered: Float32
    labels: Int32
    clusters: Clusters
    detections: Detections
    free: Float
    sensor_offset: Float
    above: tuple[Float32, Float32, Terrain] | None
    heights: Float | None
    warnings: tuple[str, ...]
    counts: dict[str, int]
