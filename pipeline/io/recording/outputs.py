"""Our results as standard ROS 2 messages: pose, path, the tree map as markers and as detections, and how far
the way is free.

All but the last are in the frame `map`, whose origin is the first pose of the run.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.geometry.poses import Pose2
from pipeline.types.clearance import Clearance, Zone
from pipeline.types.records import Frame, Path, Trees

MAP, BASE = "map", "base_link"
#: A longer path is thinned evenly: it is said anew each second.
MOST_POSES = 1000
#: What is drawn of a stem: to breast height, and as thick as this where no diameter is known [m].
STEM_HEIGHT, STEM_WIDTH = 1.3, 0.2

POSE, ODOMETRY, PATH, TREES, DETECTIONS = "pose", "odometry", "path", "trees", "detections"
CLEARANCE, ZONE = "clearance", "zone"
#: Type by topic, below `/stemmap/`.
TYPES = {
    POSE: "geometry_msgs/msg/PoseStamped",
    ODOMETRY: "nav_msgs/msg/Odometry",
    PATH: "nav_msgs/msg/Path",
    TREES: "visualization_msgs/msg/MarkerArray",
    DETECTIONS: "vision_msgs/msg/Detection3DArray",
    CLEARANCE: "sensor_msgs/msg/Range",
    ZONE: "std_msgs/msg/UInt8",
}
#: Said anew for who comes late; the others only as they change.
LATCHED = (PATH, TREES, DETECTIONS)
_VISION = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": ("std_msgs/Header header\nvision_msgs/Detection3D[] detections\n"),
}
_SECOND = 1_000_000_000
_INFRARED = 1
_CYLINDER, _TEXT, _ADD, _DELETE_ALL = 3, 9, 0, 3
_GREEN, _WHITE = (0.0, 0.62, 0.45, 0.9), (1.0, 1.0, 1.0, 1.0)


@cache
def store() -> Typestore:
    """The definitions of ROS 2 with those of vision_msgs 4."""
    types = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _VISION.items():
        types.register({name: get_types_from_msg(text, name)[name]})
    return types


def definition(topic: str) -> str:
    """The definition of a topic's type with those of all types in it."""
    return str(store().generate_msgdef(TYPES[topic], ros_version=2)[0])


def type_hash(topic: str) -> str:
    """The hash of a topic's type (REP 2016) by which ROS 2 nodes find one another."""
    return str(store().hash_rihs01(TYPES[topic]))


def scan_messages(frame: Frame) -> dict[str, bytes]:
    """What every scan tells anew by topic, in CDR: the pose, and how far the way is free."""
    return pose_messages(frame) | way_messages(frame.clearance, frame.stamp_ns)


def way_messages(clearance: Clearance | None, stamp_ns: int) -> dict[str, bytes]:
    """How far the way is free by topic, in CDR; nothing where nobody looks for obstacles.

    By REP 117 a range is infinite where nothing is in the way; it is not a number where the sensor does not
    look there.
    """
    if clearance is None:
        return {}
    seen = clearance.zone is not Zone.UNKNOWN
    way = _make(
        "sensor_msgs/Range",
        header=_header(stamp_ns, BASE),
        radiation_type=_INFRARED,
        field_of_view=0.0,
        min_range=0.0,
        max_range=clearance.within,
        range=clearance.ahead if seen else float("nan"),
        variance=0.0,
    )
    return {CLEARANCE: _cdr(way), ZONE: _cdr(_make("std_msgs/UInt8", data=int(clearance.zone)))}


def pose_messages(frame: Frame) -> dict[str, bytes]:
    """The pose at a scan by topic, in CDR."""
    T, covariance = frame.estimate.T_map_base, np.zeros((6, 6))
    rows = np.array([0, 1, 5])  # x, y and yaw of x, y, z, roll, pitch, yaw
    covariance[np.ix_(rows, rows)] = frame.estimate.covariance
    header, pose = _header(frame.stamp_ns), _pose(T)
    twist = _make("geometry_msgs/Twist", linear=_vector(), angular=_vector())
    odometry = _make(
        "nav_msgs/Odometry",
        header=header,
        child_frame_id=BASE,
        pose=_make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=covariance.reshape(-1)),
        twist=_make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    stamped = _make("geometry_msgs/PoseStamped", header=header, pose=pose)
    return {POSE: _cdr(stamped), ODOMETRY: _cdr(odometry)}


def map_messages(frame: Frame, path: Path) -> dict[str, bytes]:
    """Path and trees as they stand at a scan, by topic, in CDR."""
    header = _header(frame.stamp_ns)
    return {PATH: _cdr(_path(path, header)), **tree_messages(frame.trees, header)}


def tree_messages(trees: Trees, header: Any) -> dict[str, bytes]:  # noqa: ANN401
    """The confirmed trees by topic, in CDR."""
    rows = np.flatnonzero(trees.confirmed)
    clear = _marker(header, 0, _CYLINDER, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), _GREEN, action=_DELETE_ALL)
    markers = [clear, *(marker for row in rows for marker in _markers(trees, int(row), header))]
    detections = [_detection(trees, int(row), header) for row in rows]
    return {
        TREES: _cdr(_make("visualization_msgs/MarkerArray", markers=markers)),
        DETECTIONS: _cdr(_make("vision_msgs/Detection3DArray", header=header, detections=detections)),
    }


def _path(path: Path, header: Any) -> Any:  # noqa: ANN401
    step = max(1, -(-len(path.x) // MOST_POSES))
    # Counted from the end, so that the robot's own place is always in it.
    rows = range((len(path.x) - 1) % step, len(path.x), step) if len(path.x) else range(0)
    poses = [
        _make(
            "geometry_msgs/PoseStamped",
            header=_header(int(path.stamp_ns[k])),
            pose=_pose(Pose2(float(path.x[k]), float(path.y[k]), float(path.yaw[k]))),
        )
        for k in rows
    ]
    return _make("nav_msgs/Path", header=header, poses=poses)


def _markers(trees: Trees, row: int, header: Any) -> list[Any]:  # noqa: ANN401
    x, y = (float(value) for value in trees.position[row])
    dbh, number = float(trees.dbh[row]), int(trees.number[row])
    width = dbh if np.isfinite(dbh) else STEM_WIDTH
    text = f"{number}: {100.0 * dbh:.0f} cm" if np.isfinite(dbh) else str(number)
    middle, above = STEM_HEIGHT / 2.0, STEM_HEIGHT + 0.3
    return [
        _marker(header, number, _CYLINDER, x, y, middle, (width, width, STEM_HEIGHT), _GREEN),
        _marker(header, number, _TEXT, x, y, above, (0.0, 0.0, 0.25), _WHITE, text=text),
    ]


def _marker(
    header: Any,  # noqa: ANN401
    number: int,
    kind: int,
    x: float,
    y: float,
    z: float,
    scale: tuple[float, float, float],
    colour: tuple[float, float, float, float],
    *,
    text: str = "",
    action: int = _ADD,
) -> Any:  # noqa: ANN401
    red, green, blue, alpha = colour
    return _make(
        "visualization_msgs/Marker",
        header=header,
        ns="numbers" if kind == _TEXT else "trees",
        id=number,
        type=kind,
        action=action,
        pose=_pose(Pose2(x, y, 0.0), z),
        scale=_vector(*scale),
        color=_make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        lifetime=_make("builtin_interfaces/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=_make("sensor_msgs/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=_make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _detection(trees: Trees, row: int, header: Any) -> Any:  # noqa: ANN401
    x, y = (float(value) for value in trees.position[row])
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = trees.covariance[row]
    width = float(trees.dbh[row]) if np.isfinite(trees.dbh[row]) else 0.0
    centre = _pose(Pose2(x, y, 0.0), STEM_HEIGHT / 2.0)
    return _make(
        "vision_msgs/Detection3D",
        header=header,
        results=[
            _make(
                "vision_msgs/ObjectHypothesisWithPose",
                hypothesis=_make("vision_msgs/ObjectHypothesis", class_id="tree", score=1.0),
                pose=_make(
                    "geometry_msgs/PoseWithCovariance", pose=centre, covariance=covariance.reshape(-1)
                ),
            )
        ],
        bbox=_make("vision_msgs/BoundingBox3D", center=centre, size=_vector(width, width, STEM_HEIGHT)),
        id=str(int(trees.number[row])),
    )


def _make(name: str, **fields: Any) -> Any:  # noqa: ANN401
    package, short = name.split("/")
    return store().types[f"{package}/msg/{short}"](**fields)


def _cdr(message: Any) -> bytes:  # noqa: ANN401
    return bytes(store().serialize_cdr(message, message.__msgtype__))


def _header(stamp_ns: int, frame_id: str = MAP) -> Any:  # noqa: ANN401
    seconds, rest = divmod(max(stamp_ns, 0), _SECOND)
    stamp = _make("builtin_interfaces/Time", sec=min(seconds, 2**31 - 1), nanosec=rest)
    return _make("std_msgs/Header", stamp=stamp, frame_id=frame_id)


def _pose(T: Pose2, z: float = 0.0) -> Any:  # noqa: ANN401
    point = _make("geometry_msgs/Point", x=T.x, y=T.y, z=z)
    turn = {"x": 0.0, "y": 0.0, "z": float(np.sin(T.yaw / 2)), "w": float(np.cos(T.yaw / 2))}
    return _make("geometry_msgs/Pose", position=point, orientation=_make("geometry_msgs/Quaternion", **turn))


def _vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Any:  # noqa: ANN401
    return _make("geometry_msgs/Vector3", x=x, y=y, z=z)
