"""Records and results (pose, path, trees as markers and as detections, and clearance) as standard ROS 2
messages in CDR, as Foxglove and ROS 2 read them, and the parts of such messages. A time that ROS cannot
represent raises the error of `header`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.io.readers.topics import standard_types
from pipeline.types.records import Clearance, Frame, Imu, Odometry, Path, Scan, Trees, Zone
from pipeline.types.units import SECOND_NS

ODOM, BASE, LIDAR, CAMERA = "odom", "base_link", "velodyne", "camera"

_FLOAT32, _UINT16, _INT32 = 7, 4, 5
Message = Any  # rosbags makes its message classes at run time


def make(name: str, /, **fields: Any) -> Message:  # noqa: ANN401
    """Return a message of a type, e.g. "std_msgs/Header", with all its fields.

    Raises:
        ValueError: The name does not have exactly one slash.
        KeyError: The type is unknown.
        TypeError: A field is missing or unknown.
    """
    package, short = name.split("/")
    return standard_types("cdr").types[f"{package}/msg/{short}"](**fields)


def encode(message: Message) -> bytes:
    """Return a message in CDR."""
    return bytes(standard_types("cdr").serialize_cdr(message, message.__msgtype__))


def definition(type_name: str) -> str:
    """Return the definition of a type, e.g. "sensor_msgs/msg/Imu", with those of all types in it, as in
    `ros2msg` schemas."""
    return str(standard_types("cdr").generate_msgdef(type_name, ros_version=2)[0])


def header(stamp_ns: int, frame: str) -> Message:
    """Return a std_msgs/Header with a time [ns] and the name of a frame.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    seconds, rest = divmod(int(stamp_ns), SECOND_NS)
    if not 0 <= seconds < 2**31:
        raise StemmapError(
            "a record's time cannot be written as a ROS time",
            where=f"stamp {stamp_ns} ns",
            remedy="ROS times are between 1970 and 2038",
        )
    return make(
        "std_msgs/Header", stamp=make("builtin_interfaces/Time", sec=seconds, nanosec=rest), frame_id=frame
    )


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Message:
    """Return a geometry_msgs/Vector3."""
    return make("geometry_msgs/Vector3", x=float(x), y=float(y), z=float(z))


def quaternion(wxyz: NDArray[np.float64]) -> Message:
    """Return a geometry_msgs/Quaternion of w, x, y, z, shape (4,)."""
    w, x, y, z = (float(value) for value in wxyz)
    return make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def pose(t: NDArray[np.float64], wxyz: NDArray[np.float64]) -> Message:
    """Return a geometry_msgs/Pose of a position [m], shape (3,), and a quaternion w, x, y, z, shape (4,)."""
    x, y, z = (float(value) for value in t)
    point = make("geometry_msgs/Point", x=x, y=y, z=z)
    return make("geometry_msgs/Pose", position=point, orientation=quaternion(wxyz))


def odometry_of(head: Message, child: str, at: Message, covariance: NDArray[np.float64]) -> Message:
    """Return a nav_msgs/Odometry; its twist is unknown and zero.

    Args:
        head: Header with the parent frame.
        child: Name of the child frame.
        at: geometry_msgs/Pose of the child.
        covariance: Covariance of x, y, z [m], roll, pitch, yaw [rad], 36 numbers row by row.
    """
    twist = make("geometry_msgs/Twist", linear=vector(), angular=vector())
    return make(
        "nav_msgs/Odometry",
        header=head,
        child_frame_id=child,
        pose=make("geometry_msgs/PoseWithCovariance", pose=at, covariance=covariance),
        twist=make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def point_cloud(scan: Scan) -> Message:
    """Return a sensor_msgs/PointCloud2 in the layout of the Velodyne driver: x, y, z, intensity, ring, time.

    `time` [s after the stamp] is a float32, as in the driver, and too coarse for nanoseconds; so `t` (int32)
    follows it, which is `offset_ns`. Columns that the scan does not have are left out. The frame is LIDAR.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    columns: list[tuple[str, str, int, NDArray[Any]]] = [
        (name, "<f4", _FLOAT32, scan.points[:, axis]) for axis, name in enumerate("xyz")
    ]
    if scan.reflectance is not None:
        columns.append(("intensity", "<f4", _FLOAT32, scan.reflectance))
    if scan.ring is not None:
        columns.append(("ring", "<u2", _UINT16, scan.ring))
    if scan.offset_ns is not None:
        columns.append(("time", "<f4", _FLOAT32, scan.offset_ns / SECOND_NS))
        columns.append(("t", "<i4", _INT32, scan.offset_ns))
    dtype = np.dtype([(name, code) for name, code, _, _ in columns])
    table = np.empty(len(scan.points), dtype=dtype)
    for name, _, _, column in columns:
        table[name] = column
    offsets = {name: int(place[1]) for name, place in (dtype.fields or {}).items()}
    return make(
        "sensor_msgs/PointCloud2",
        header=header(scan.stamp_ns, LIDAR),
        height=1,
        width=len(table),
        fields=[
            make("sensor_msgs/PointField", name=name, offset=offsets[name], datatype=number, count=1)
            for name, _, number, _ in columns
        ],
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(table),
        data=table.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def odometry(record: Odometry) -> Message:
    """Return a nav_msgs/Odometry: the pose of base_link in odom. Covariances and twist are zero.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    T = record.T_odom_base
    return odometry_of(header(record.stamp_ns, ODOM), BASE, pose(T.t, T.quaternion()), np.zeros(36))


def imu(record: Imu) -> Message:
    """Return a sensor_msgs/Imu in base_link; if the orientation is None, it is the identity and its
    covariance begins with -1. Other covariances are zero.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    unknown = np.zeros(9)
    if record.orientation is None:
        unknown[0] = -1.0
    wxyz = np.array([1.0, 0.0, 0.0, 0.0]) if record.orientation is None else record.orientation
    return make(
        "sensor_msgs/Imu",
        header=header(record.stamp_ns, BASE),
        orientation=quaternion(wxyz),
        orientation_covariance=unknown,
        angular_velocity=vector(*record.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*record.linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def compressed_image(stamp_ns: int, data: bytes) -> Message:
    """Return a sensor_msgs/CompressedImage of the bytes of a JPEG, frame CAMERA.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    pixels = np.frombuffer(data, np.uint8)
    return make("sensor_msgs/CompressedImage", header=header(stamp_ns, CAMERA), format="jpeg", data=pixels)


def camera_info(stamp_ns: int, width: int, height: int, K: NDArray[np.float64]) -> Message:
    """Return a sensor_msgs/CameraInfo of a pinhole camera without distortion, frame CAMERA.

    Args:
        stamp_ns: Time [ns].
        width, height: Size of the pictures of the camera [pixels].
        K: Camera matrix, shape (3, 3) [pixels].

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    return make(
        "sensor_msgs/CameraInfo",
        header=header(stamp_ns, CAMERA),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([K, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def text(content: str) -> bytes:
    """Return a std_msgs/String with the string `content` in CDR."""
    return encode(make("std_msgs/String", data=content))


def transform(stamp_ns: int, parent: str, child: str, T_parent_child: Pose3) -> Message:
    """Return a tf2_msgs/TFMessage with one transform, that of the frame `child` in the frame `parent`.

    Raises:
        StemmapError: ROS cannot represent the time.
    """
    moved = make(
        "geometry_msgs/Transform",
        translation=vector(*T_parent_child.t),
        rotation=quaternion(T_parent_child.quaternion()),
    )
    stamped = make(
        "geometry_msgs/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=moved,
    )
    return make("tf2_msgs/TFMessage", transforms=[stamped])


MAP = "map"
#: A longer path is thinned evenly, because it is published every second.
MOST_POSES = 1000
#: Height of the marker of a stem, and its width without a known diameter [m].
STEM_HEIGHT, STEM_WIDTH = 1.3, 0.2

POSE, ODOMETRY, PATH, TREES, DETECTIONS = "pose", "odometry", "path", "trees", "detections"
CLEARANCE, ZONE = "clearance", "zone"
MAP_ODOM = "map_odom"
#: Type by topic, below `/stemmap/`.
TYPES = {
    POSE: "geometry_msgs/msg/PoseStamped",
    ODOMETRY: "nav_msgs/msg/Odometry",
    PATH: "nav_msgs/msg/Path",
    TREES: "visualization_msgs/msg/MarkerArray",
    DETECTIONS: "vision_msgs/msg/Detection3DArray",
    CLEARANCE: "sensor_msgs/msg/Range",
    ZONE: "std_msgs/msg/UInt8",
    MAP_ODOM: "nav_msgs/msg/Odometry",
}
#: Latched topics: late subscribers get the last message.
LATCHED = (PATH, TREES, DETECTIONS)
_LATEST_NS = (2**31 - 1) * 1_000_000_000  # of a ROS time
_INFRARED = 1
_CYLINDER, _TEXT, _ADD, _DELETE_ALL = 3, 9, 0, 3
_GREEN, _WHITE = (0.0, 0.62, 0.45, 0.9), (1.0, 1.0, 1.0, 1.0)


def type_hash(topic: str) -> str:
    """Return the hash of the type of a topic (REP 2016), by which ROS 2 nodes match topics; KeyError for a
    topic that is not in TYPES."""
    return str(standard_types("cdr").hash_rihs01(TYPES[topic]))


def scan_messages(frame: Frame) -> dict[str, bytes]:
    """Return a dict from topics to messages of a scan in CDR: those of `pose_messages` and
    `clearance_messages`, i.e. POSE and ODOMETRY, and with a clearance CLEARANCE and ZONE."""
    return pose_messages(frame) | clearance_messages(frame.clearance, frame.stamp_ns)


def clearance_messages(clearance: Clearance | None, stamp_ns: int) -> dict[str, bytes]:
    """Return a dict from topics to messages of a clearance in CDR: CLEARANCE (the distance ahead) and ZONE;
    empty if `clearance` is None.

    By REP 117 a range is infinite without an obstacle; it is NaN in the zone UNKNOWN. A time [ns] that ROS
    cannot represent is clipped.
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
    """Return a dict from topics to messages of the pose at a scan in CDR: POSE, and ODOMETRY with the
    covariance of the pose. A time [ns] that ROS cannot represent is clipped."""
    T, covariance = frame.estimate.T_map_base, np.zeros((6, 6))
    rows = np.array([0, 1, 5])  # x, y and yaw of x, y, z, roll, pitch, yaw
    covariance[np.ix_(rows, rows)] = frame.estimate.covariance
    head, at = _header(frame.stamp_ns), _pose(T)
    stamped = make("geometry_msgs/PoseStamped", header=head, pose=at)
    return {POSE: encode(stamped), ODOMETRY: encode(odometry_of(head, BASE, at, covariance.reshape(-1)))}


def map_odom_messages(stamp_ns: int, T_map_odom: Pose3, covariance: NDArray[np.float64]) -> dict[str, bytes]:
    """Return a dict from MAP_ODOM to a message in CDR: the pose of the frame ODOM in a stored map, with its
    covariance. A time [ns] that ROS cannot represent is clipped.

    Args:
        stamp_ns: Time of the scan [ns].
        T_map_odom: The pose.
        covariance: Covariance of x, y [m], yaw [rad], shape (3, 3).
    """
    full, rows = np.zeros((6, 6)), np.array([0, 1, 5])
    full[np.ix_(rows, rows)] = covariance
    at = pose(T_map_odom.t, T_map_odom.quaternion())
    return {MAP_ODOM: encode(odometry_of(_header(stamp_ns), ODOM, at, full.reshape(-1)))}


def map_messages(frame: Frame, path: Path) -> dict[str, bytes]:
    """Return a dict from topics to messages of the map at a scan in CDR: PATH (at most MOST_POSES poses), and
    the confirmed trees as TREES and DETECTIONS. A time that ROS cannot represent is clipped."""
    head = _header(frame.stamp_ns)
    return {PATH: encode(_path(path, head)), **tree_messages(frame.trees, head)}


def tree_messages(trees: Trees, head: Any) -> dict[str, bytes]:  # noqa: ANN401
    """Return a dict from topics to messages of the confirmed trees in CDR: TREES, markers of which the first
    deletes all earlier ones, and DETECTIONS.

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
    an empty path. Each pose has its own time, clipped to ROS times, and the frame MAP."""
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
    """Return a vision_msgs/Detection3D of the tree in a row, class "tree" with the score 1, with the
    covariance of its position and the fixed height STEM_HEIGHT; an unknown diameter has the width 0."""
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
    """Return a header with a time [ns], clipped to the times that ROS can represent."""
    return header(min(max(stamp_ns, 0), _LATEST_NS), frame_id)


def _pose(T: Pose2, z: float = 0.0) -> Any:  # noqa: ANN401
    """Return a geometry_msgs/Pose of a planar pose at a height z [m]."""
    return pose(np.array([T.x, T.y, z]), np.array([np.cos(T.yaw / 2), 0.0, 0.0, np.sin(T.yaw / 2)]))
