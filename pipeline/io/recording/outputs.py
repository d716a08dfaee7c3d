"""Results as standard ROS 2 messages: pose, path, trees as markers and as detections, and clearance.

All but the clearance are in the frame `map`, whose origin is the first pose of the run.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.geometry.poses import Pose2
from pipeline.io.readers.topics import standard_types
from pipeline.io.recording.messages import BASE, encode, header, make, odometry_of, pose, vector
from pipeline.types.records import Clearance, Frame, Path, Trees, Zone

MAP = "map"
#: A longer path is thinned evenly, because it is published every second.
MOST_POSES = 1000
#: Height of the marker of a stem, and its width without a known diameter [m].
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
#: Latched topics: late subscribers get the last message.
LATCHED = (PATH, TREES, DETECTIONS)
_LATEST_NS = (2**31 - 1) * 1_000_000_000  # of a ROS time
_INFRARED = 1
_CYLINDER, _TEXT, _ADD, _DELETE_ALL = 3, 9, 0, 3
_GREEN, _WHITE = (0.0, 0.62, 0.45, 0.9), (1.0, 1.0, 1.0, 1.0)


def type_hash(topic: str) -> str:
    """Return the hash of the type of a topic (REP 2016), by which ROS 2 nodes match topics."""
    return str(standard_types("cdr").hash_rihs01(TYPES[topic]))


def scan_messages(frame: Frame) -> dict[str, bytes]:
    """Return the messages of a scan by topic, in CDR: those of `pose_messages` and `clearance_messages`."""
    return pose_messages(frame) | clearance_messages(frame.clearance, frame.stamp_ns)


def clearance_messages(clearance: Clearance | None, stamp_ns: int) -> dict[str, bytes]:
    """Return the messages of a clearance by topic, in CDR: CLEARANCE (the distance ahead) and ZONE; empty for
    None, when obstacles are not detected.

    By REP 117 a range is infinite without an obstacle; it is NaN where the sensor has no view. A time [ns]
    that ROS cannot represent is limited.
    """
    if clearance is None:
        return {}
    seen = clearance.zone is not Zone.UNKNOWN
    distance = make(
        "sensor_msgs/Range",
        header=_header(stamp_ns, BASE),
        radiation_type=_INFRARED,
        field_of_view=0.0,
        min_range=0.0,
        max_range=clearance.within,
        range=clearance.ahead if seen else float("nan"),
        variance=0.0,
    )
    return {CLEARANCE: encode(distance), ZONE: encode(make("std_msgs/UInt8", data=int(clearance.zone)))}


def pose_messages(frame: Frame) -> dict[str, bytes]:
    """Return the pose at a scan by topic, in CDR: POSE, and ODOMETRY with its covariance. A time [ns] that
    ROS cannot represent is limited."""
    T, covariance = frame.estimate.T_map_base, np.zeros((6, 6))
    rows = np.array([0, 1, 5])  # x, y and yaw of x, y, z, roll, pitch, yaw
    covariance[np.ix_(rows, rows)] = frame.estimate.covariance
    head, at = _header(frame.stamp_ns), _pose(T)
    stamped = make("geometry_msgs/PoseStamped", header=head, pose=at)
    return {POSE: encode(stamped), ODOMETRY: encode(odometry_of(head, BASE, at, covariance.reshape(-1)))}


def map_messages(frame: Frame, path: Path) -> dict[str, bytes]:
    """Return the map at a scan by topic, in CDR: PATH (at most MOST_POSES poses), and the confirmed trees as
    TREES and DETECTIONS."""
    head = _header(frame.stamp_ns)
    return {PATH: encode(_path(path, head)), **tree_messages(frame.trees, head)}


def tree_messages(trees: Trees, head: Any) -> dict[str, bytes]:  # noqa: ANN401
    """Return the confirmed trees by topic, in CDR: TREES, markers of which the first deletes all earlier
    ones, and DETECTIONS.

    Args:
        trees: The map.
        head: Header of the messages.
    """
    rows = np.flatnonzero(trees.confirmed)
    clear = _marker(head, 0, _CYLINDER, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), _GREEN, action=_DELETE_ALL)
    markers = [clear, *(marker for row in rows for marker in _markers(trees, int(row), head))]
    detections = [_detection(trees, int(row), head) for row in rows]
    return {
        TREES: encode(make("visualization_msgs/MarkerArray", markers=markers)),
        DETECTIONS: encode(make("vision_msgs/Detection3DArray", header=head, detections=detections)),
    }


def _path(path: Path, head: Any) -> Any:  # noqa: ANN401
    """Return a nav_msgs/Path with at most MOST_POSES poses, evenly thinned, the last one included; empty for
    an empty path."""
    step = max(1, -(-len(path.x) // MOST_POSES))
    # Counted from the end, so that the pose of the robot is always included.
    rows = range((len(path.x) - 1) % step, len(path.x), step) if len(path.x) else range(0)
    poses = [
        make(
            "geometry_msgs/PoseStamped",
            header=_header(int(path.stamp_ns[k])),
            pose=_pose(Pose2(float(path.x[k]), float(path.y[k]), float(path.yaw[k]))),
        )
        for k in rows
    ]
    return make("nav_msgs/Path", header=head, poses=poses)


def _markers(trees: Trees, row: int, head: Any) -> list[Any]:  # noqa: ANN401
    """Return two visualization_msgs/Marker of the tree in a row: its stem, STEM_WIDTH wide if the diameter is
    unknown, and its number and diameter as text."""
    x, y = (float(value) for value in trees.position[row])
    dbh, number = float(trees.dbh[row]), int(trees.number[row])
    width = dbh if np.isfinite(dbh) else STEM_WIDTH
    text = f"{number}: {100.0 * dbh:.0f} cm" if np.isfinite(dbh) else str(number)
    middle, above = STEM_HEIGHT / 2.0, STEM_HEIGHT + 0.3
    return [
        _marker(head, number, _CYLINDER, x, y, middle, (width, width, STEM_HEIGHT), _GREEN),
        _marker(head, number, _TEXT, x, y, above, (0.0, 0.0, 0.25), _WHITE, text=text),
    ]


def _marker(
    head: Any,  # noqa: ANN401
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
    """Return a visualization_msgs/Marker in the frame of the header.

    Args:
        head: Header.
        number: Id, unique among markers of one kind.
        kind: Shape, e.g. _CYLINDER.
        x, y, z: Centre [m].
        scale: Size along x, y, z [m].
        colour: Red, green, blue, alpha, 0 to 1.
        text: Text of a text marker.
        action: _ADD or _DELETE_ALL.
    """
    red, green, blue, alpha = colour
    return make(
        "visualization_msgs/Marker",
        header=head,
        ns="numbers" if kind == _TEXT else "trees",
        id=number,
        type=kind,
        action=action,
        pose=_pose(Pose2(x, y, 0.0), z),
        scale=vector(*scale),
        color=make("std_msgs/ColorRGBA", r=red, g=green, b=blue, a=alpha),
        lifetime=make("builtin_interfaces/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=make("sensor_msgs/CompressedImage", header=head, format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


def _detection(trees: Trees, row: int, head: Any) -> Any:  # noqa: ANN401
    """Return a vision_msgs/Detection3D of the tree in a row, with the fixed height STEM_HEIGHT; an unknown
    diameter has the width 0."""
    x, y = (float(value) for value in trees.position[row])
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = trees.covariance[row]
    width = float(trees.dbh[row]) if np.isfinite(trees.dbh[row]) else 0.0
    centre = _pose(Pose2(x, y, 0.0), STEM_HEIGHT / 2.0)
    return make(
        "vision_msgs/Detection3D",
        header=head,
        results=[
            make(
                "vision_msgs/ObjectHypothesisWithPose",
                hypothesis=make("vision_msgs/ObjectHypothesis", class_id="tree", score=1.0),
                pose=make("geometry_msgs/PoseWithCovariance", pose=centre, covariance=covariance.reshape(-1)),
            )
        ],
        bbox=make("vision_msgs/BoundingBox3D", center=centre, size=vector(width, width, STEM_HEIGHT)),
        id=str(int(trees.number[row])),
    )


def _header(stamp_ns: int, frame_id: str = MAP) -> Any:  # noqa: ANN401
    """Return a header with a time [ns], limited to what ROS can represent."""
    return header(min(max(stamp_ns, 0), _LATEST_NS), frame_id)


def _pose(T: Pose2, z: float = 0.0) -> Any:  # noqa: ANN401
    """Return a geometry_msgs/Pose of a planar pose at a height z [m]."""
    return pose(np.array([T.x, T.y, z]), np.array([np.cos(T.yaw / 2), 0.0, 0.0, np.sin(T.yaw / 2)]))
