"""Families of LiDARs, and the family of a topic. docs/sensors.md tells how their drivers write scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SensorFamily:
    """LiDARs of one maker or kind whose drivers write scans in one form.

    Attributes:
        name: Name of the family.
        messages: Message types of its packets and of its own scans.
        frames: Words in usual names of frames and topics.
    """

    name: str
    messages: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()


VELODYNE = SensorFamily(
    name="Velodyne",
    messages=("velodyne_msgs/msg/VelodyneScan",),
    frames=("velodyne",),
)
#: Messages with the packets of a sweep of Hesai.
HESAI_SCANS = ("pandar_msgs/msg/PandarScan", "hesai_lidar/msg/PandarScan")
#: Single packets of Ouster, of its LiDAR and its IMU; read with the extra `ouster`.
OUSTER_PACKETS = (
    "ouster_ros/msg/PacketMsg",
    "ouster_sensor_msgs/msg/PacketMsg",
    "ouster_msgs/msg/PacketMsg",
)
OUSTER = SensorFamily(
    name="Ouster",
    messages=OUSTER_PACKETS,
    frames=("os_sensor", "os_lidar", "os1", "os0", "os2", "ouster"),
)
HESAI = SensorFamily(
    name="Hesai",
    messages=HESAI_SCANS,
    frames=("hesai", "pandar"),
)
ROBOSENSE = SensorFamily(
    name="RoboSense",
    frames=("rslidar", "robosense", "helios"),
)
#: One layout under three names: livox_ros_driver (ROS 1), livox_ros_driver2 (ROS 1 and 2), livox_ros2_driver.
CUSTOM_TYPES = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
LIVOX = SensorFamily(
    name="Livox",
    messages=CUSTOM_TYPES,
    frames=("livox",),
)
DEPTH_CAMERA = SensorFamily(
    name="depth camera or solid-state LiDAR",
    frames=("camera", "depth"),
)
PLANAR = SensorFamily(
    name="planar laser",
    messages=("sensor_msgs/msg/LaserScan",),
)
FAMILIES = (VELODYNE, OUSTER, HESAI, ROBOSENSE, LIVOX, DEPTH_CAMERA, PLANAR)


def family_of_messages(msgtype: str) -> SensorFamily | None:
    """Return the family whose packets or scans have a message type; None for others, and for PointCloud2."""
    return next((f for f in FAMILIES if msgtype in f.messages), None)


def family_of(
    fields: Mapping[str, str] | Sequence[str],
    msgtype: str = "",
    *,
    names: Sequence[str] = (),
    organised: bool = False,
) -> SensorFamily | None:
    """Return the family of the scans of a topic; None if they may be of several, or of another.

    Hesai and RoboSense write the same fields: without a word of theirs in the names, an organised cloud is of
    RoboSense, another one of Hesai. Clouds without times and rings are of a depth camera if they are
    organised.

    Args:
        fields: Names of the fields of a PointCloud2; the types of a dict are not used.
        msgtype: Message type in the ROS 2 spelling.
        names: Frame and topic of the scans, and whatever else may name the sensor.
        organised: Whether the cloud has more than one row.
    """
    family = family_of_messages(msgtype)
    if family is not None:
        return family
    there = {name.lower() for name in fields}
    if not {"x", "y", "z"} <= there:
        return None
    if {"tag", "line"} & there or "offset_time" in there:
        return LIVOX
    # A recording of ours has both t and time.
    own = {"ring", "reflectivity", "range", "ambient", "near_ir", "noise"}
    if "t" in there and "time" not in there and own & there:
        return OUSTER
    named = [f for f in FAMILIES if any(word in name.lower() for word in f.frames for name in names)]
    timed = {"time", "timestamp", "time_stamp", "time_offset"} & there
    if {"ring", "timestamp"} <= there:
        makers = [family for family in named if family in (HESAI, ROBOSENSE)]
        return makers[0] if makers else ROBOSENSE if organised else HESAI
    if {"ring", "time"} <= there:
        return VELODYNE
    if not timed and "ring" not in there and (organised or {"rgb", "rgba"} & there):
        return DEPTH_CAMERA
    return named[0] if named and named[0] is not DEPTH_CAMERA else None
