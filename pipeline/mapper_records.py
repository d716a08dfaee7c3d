"""What a mapper knows between two scans, and what it tells of one."""

from __future__ import annotations

from dataclasses import dataclass, field

from pipeline.classification import GatheringState
from pipeline.front_end import Seen
from pipeline.geometry.poses import Float, Pose2
from pipeline.ground.terrain_map import HeightMapState
from pipeline.loop_closure.kidnapped_robot import RecoveryState
from pipeline.slam import BackEndState
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Columns, PoseEstimate, Step


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


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Where a scan was taken, before it is taken into the map.

    Attributes:
        step: With its number and time; seen: what it showed.
        estimate: The pose; T_odom_base: by the odometry.
        warnings: What a person should know of how the pose was found.
        landmarks: Of SLAM after the scan: positions, shape (L, 2) [m], and covariances xx, xy, yy, (L, 3).
        searching: Whether the robot is lost: then the map stays as it is.
        asked_trees: Whether the trees of the map were asked for the pose.
        may_close: Whether a loop is looked for once the scan is mapped: until then no other is located.
    """

    step: Step
    seen: Seen
    estimate: PoseEstimate
    T_odom_base: Pose2
    warnings: tuple[str, ...]
    landmarks: tuple[Float, Float]
    searching: bool
    asked_trees: bool
    may_close: bool
