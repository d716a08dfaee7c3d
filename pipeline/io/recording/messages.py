"""From records to standard ROS 2 messages in CDR, as Foxglove and ROS 2 read them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose3
from pipeline.types.records import Imu, Odometry, Scan

ODOM, BASE, LIDAR, CAMERA = "odom", "base_link", "velodyne", "camera"

_STORE = get_typestore(Stores.ROS2_HUMBLE)
_TYPES = _STORE.types
_SECOND = 1_000_000_000
_FLOAT32, _UINT16, _INT32 = 7, 4, 5

Message = Any  # rosbags makes its message classes at run time


def encode(message: Message) -> bytes:
    """A message in CDR, as it is stored."""
    return bytes(_STORE.serialize_cdr(message, message.__msgtype__))


def definition(type_name: str) -> str:
    """The definition of a type with those of all types in it, as `ros2msg` schemas hold it."""
    return str(_STORE.generate_msgdef(type_name, ros_version=2)[0])


def point_cloud(scan: Scan) -> Message:
    """sensor_msgs/PointCloud2 in the layout of Velodyne's driver: x, y, z, intensity, ring, time.

    `time` [s after the stamp] is a float32, as the driver has it, and too coarse for nanoseconds; so
    `t` (int32) follows it, which is `offset_ns` itself. Columns that the scan lacks are left out.
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
    field_type = _TYPES["sensor_msgs/msg/PointField"]
    return _TYPES["sensor_msgs/msg/PointCloud2"](
        header=_header(scan.stamp_ns, LIDAR),
        height=1,
        width=len(table),
        fields=[
            field_type(name=name, offset=dtype.fields[name][1], datatype=number, count=1)  # type: ignore[index]
            for name, _, number, _ in columns
        ],
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(table),
        data=table.view(np.uint8).reshape(-1),
        is_dense=True,
    )


def odometry(record: Odometry) -> Message:
    """nav_msgs/Odometry: the pose of base_link in odom; the twist is not known and zero."""
    zero = _vector(np.zeros(3))
    pose_type, twist_type = (
        _TYPES[f"geometry_msgs/msg/{name}"] for name in ("PoseWithCovariance", "TwistWithCovariance")
    )
    pose = _TYPES["geometry_msgs/msg/Pose"](
        position=_point(record.T_odom_base.t), orientation=_quaternion(record.T_odom_base.quaternion())
    )
    return _TYPES["nav_msgs/msg/Odometry"](
        header=_header(record.stamp_ns, ODOM),
        child_frame_id=BASE,
        pose=pose_type(pose=pose, covariance=np.zeros(36)),
        twist=twist_type(
            twist=_TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
        ),
    )


def imu(record: Imu) -> Message:
    """sensor_msgs/Imu in base_link; without an orientation its covariance begins with -1."""
    unknown = np.zeros(9)
    if record.orientation is None:
        unknown[0] = -1.0
    wxyz = np.array([1.0, 0.0, 0.0, 0.0]) if record.orientation is None else record.orientation
    return _TYPES["sensor_msgs/msg/Imu"](
        header=_header(record.stamp_ns, BASE),
        orientation=_quaternion(wxyz),
        orientation_covariance=unknown,
        angular_velocity=_vector(record.angular_velocity),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(record.linear_acceleration),
        linear_acceleration_covariance=np.zeros(9),
    )


def compressed_image(stamp_ns: int, data: bytes) -> Message:
    """sensor_msgs/CompressedImage of a JPEG."""
    pixels = np.frombuffer(data, np.uint8)
    return _TYPES["sensor_msgs/msg/CompressedImage"](
        header=_header(stamp_ns, CAMERA), format="jpeg", data=pixels
    )


def camera_info(stamp_ns: int, width: int, height: int, K: NDArray[np.float64]) -> Message:
    """sensor_msgs/CameraInfo of a pinhole camera without distortion."""
    region = _TYPES["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return _TYPES["sensor_msgs/msg/CameraInfo"](
        header=_header(stamp_ns, CAMERA),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([K, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def text(content: str) -> bytes:
    """std_msgs/String in CDR."""
    return encode(_TYPES["std_msgs/msg/String"](data=content))


def transform(stamp_ns: int, parent: str, child: str, T_parent_child: Pose3) -> Message:
    """tf2_msgs/TFMessage with one transform."""
    moved = _TYPES["geometry_msgs/msg/Transform"](
        translation=_vector(T_parent_child.t), rotation=_quaternion(T_parent_child.quaternion())
    )
    stamped = _TYPES["geometry_msgs/msg/TransformStamped"](
        header=_header(stamp_ns, parent), child_frame_id=child, transform=moved
    )
    return _TYPES["tf2_msgs/msg/TFMessage"](transforms=[stamped])


def _header(stamp_ns: int, frame: str) -> Message:
    seconds, rest = divmod(int(stamp_ns), _SECOND)
    if not 0 <= seconds < 2**31:
        raise StemmapError(
            "a record's time cannot be written as a ROS time",
            where=f"stamp {stamp_ns} ns",
            remedy="ROS times lie between 1970 and 2038",
        )
    stamp = _TYPES["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    return _TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def _point(t: NDArray[np.float64]) -> Message:
    return _TYPES["geometry_msgs/msg/Point"](x=float(t[0]), y=float(t[1]), z=float(t[2]))


def _vector(t: NDArray[np.float64]) -> Message:
    return _TYPES["geometry_msgs/msg/Vector3"](x=float(t[0]), y=float(t[1]), z=float(t[2]))


def _quaternion(wxyz: NDArray[np.float64]) -> Message:
    w, x, y, z = (float(value) for value in wxyz)
    return _TYPES["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
