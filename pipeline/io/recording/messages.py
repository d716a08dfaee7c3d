"""Records as standard ROS 2 messages in CDR, as Foxglove and ROS 2 read them, and the parts of such
messages. A time that ROS cannot represent raises the error of `header`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.topics import standard_types
from pipeline.types.records import Imu, Odometry, Scan

ODOM, BASE, LIDAR, CAMERA = "odom", "base_link", "velodyne", "camera"

_SECOND = 1_000_000_000
_FLOAT32, _UINT16, _INT32 = 7, 4, 5
Message = Any  # rosbags makes its message classes at run time


def make(name: str, /, **fields: Any) -> Message:  # noqa: ANN401
    """Return a message of a type, e.g. "std_msgs/Header", with all its fields.

    Raises:
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
    seconds, rest = divmod(int(stamp_ns), _SECOND)
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
        covariance: Covariance of the pose, 36 numbers.
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
        columns.append(("time", "<f4", _FLOAT32, scan.offset_ns / _SECOND))
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
    """Return a sensor_msgs/Imu in base_link; without an orientation its covariance begins with -1 and the
    orientation is the identity. Other covariances are zero.

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
        width, height: Size of its pictures [pixels].
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
    """Return a std_msgs/String with this content in CDR."""
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
