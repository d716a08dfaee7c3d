"""The parts of ROS messages that are read here, as rosbags' decoders give them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Stamp(Protocol):
    """builtin_interfaces/Time."""

    sec: int
    nanosec: int


class Header(Protocol):
    """std_msgs/Header."""

    stamp: Stamp
    frame_id: str


class Stamped(Protocol):
    """Any message that begins with a header."""

    header: Header


class Vector(Protocol):
    """geometry_msgs/Vector3 or Point."""

    x: float
    y: float
    z: float


class Quaternion(Vector, Protocol):
    """geometry_msgs/Quaternion."""

    w: float


class PointField(Protocol):
    """One column of a cloud, as its message describes it."""

    name: str
    offset: int
    datatype: int
    count: int


class PointCloud2(Stamped, Protocol):
    """sensor_msgs/PointCloud2."""

    height: int
    width: int
    fields: Sequence[PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8]


class LaserScan(Stamped, Protocol):
    """sensor_msgs/LaserScan."""

    angle_min: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]


class NavSatStatus(Protocol):
    """sensor_msgs/NavSatStatus."""

    status: int


class NavSatFix(Stamped, Protocol):
    """sensor_msgs/NavSatFix."""

    status: NavSatStatus
    latitude: float
    longitude: float
    altitude: float
    position_covariance: NDArray[np.float64]
    position_covariance_type: int


class CameraInfo(Stamped, Protocol):
    """sensor_msgs/CameraInfo; the matrix is `k` in ROS 2 and `K` in ROS 1."""

    width: int
    height: int
    k: NDArray[np.float64]
    K: NDArray[np.float64]


class CompressedImage(Stamped, Protocol):
    """sensor_msgs/CompressedImage."""

    format: str
    data: NDArray[np.uint8]


class Image(Stamped, Protocol):
    """sensor_msgs/Image."""

    height: int
    width: int
    encoding: str
    step: int
    data: NDArray[np.uint8]


class Packet(Protocol):
    """velodyne_msgs/VelodynePacket."""

    stamp: Stamp
    data: NDArray[np.uint8]


class VelodyneScan(Stamped, Protocol):
    """velodyne_msgs/VelodyneScan."""

    packets: Sequence[Packet]


class Pose(Protocol):
    """geometry_msgs/Pose."""

    position: Vector
    orientation: Quaternion


class PoseWithCovariance(Protocol):
    """geometry_msgs/PoseWithCovariance; about x, y, z and turns about them, row by row."""

    pose: Pose
    covariance: NDArray[np.float64]


class PoseWithCovarianceStamped(Stamped, Protocol):
    """geometry_msgs/PoseWithCovarianceStamped."""

    pose: PoseWithCovariance


class Odometry(Stamped, Protocol):
    """nav_msgs/Odometry."""

    child_frame_id: str
    pose: PoseWithCovariance


class Imu(Stamped, Protocol):
    """sensor_msgs/Imu."""

    orientation: Quaternion
    orientation_covariance: NDArray[np.float64]
    angular_velocity: Vector
    linear_acceleration: Vector


class Transform(Protocol):
    """geometry_msgs/Transform."""

    translation: Vector
    rotation: Quaternion


class TransformStamped(Stamped, Protocol):
    """geometry_msgs/TransformStamped."""

    child_frame_id: str
    transform: Transform


class Transforms(Protocol):
    """tf2_msgs/TFMessage."""

    transforms: Sequence[TransformStamped]
