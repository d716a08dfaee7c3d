"""ROS message types that are read, and their decoder."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from pipeline.io.readers.container import Channel

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
VELODYNE_SCAN = "velodyne_msgs/msg/VelodyneScan"
ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ROS1_TRANSFORMS = "tf/msg/tfMessage"
READ_TYPES = (
    POINT_CLOUD,
    VELODYNE_SCAN,
    LASER_SCAN,
    ODOMETRY,
    IMU,
    NAV_SAT_FIX,
    POSE_WITH_COVARIANCE,
    COMPRESSED_IMAGE,
    IMAGE,
    CAMERA_INFO,
    TRANSFORMS,
    ROS1_TRANSFORMS,
)

_EXTRA = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
    VELODYNE_SCAN: "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets\n",
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
    ROS1_TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
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
_ROS1_TIME = {"velodyne_msgs/msg/VelodynePacket": "time stamp\nuint8[1206] data\n"}


def decode(channel: Channel, payload: bytes) -> Any:  # noqa: ANN401
    """Return one message decoded as the standard type of its channel; `rosbags.typesys.stores.ros2_jazzy`
    declares the fields. A definition in the recording is not used.

    Raises:
        Exception: Of many kinds, when the bytes do not match the type. Callers count a loss.
    """
    store = standard_types(channel.encoding)
    if channel.encoding == "ros1":
        return store.deserialize_ros1(payload, channel.msgtype)
    return store.deserialize_cdr(payload, channel.msgtype)


@cache
def standard_types(encoding: str) -> Typestore:
    """Return the definitions of ROS 1 for "ros1" and of ROS 2 for any other encoding, with those of Velodyne,
    tf and vision_msgs 4; the same object at each call."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    for name, text in _EXTRA.items():
        if name not in store.fielddefs:
            chosen = _ROS1_TIME.get(name, text) if encoding == "ros1" else text
            store.register({name: get_types_from_msg(chosen, name)[name]})
    return store
