"""Families of LiDARs: how their drivers write scans, their beams, and the family of a topic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipeline.io.readers.livox import CUSTOM_TYPES


@dataclass(frozen=True, slots=True)
class SensorFamily:
    """LiDARs of one maker or kind whose drivers write scans in one form.

    Attributes:
        name: Name of the family.
        models: Models, for the user.
        fields: Fields of a point in a PointCloud2 of the makers' driver, in its order.
        times: Field of point times, its type and unit.
        rings: Field of ring numbers and what it counts, or "none".
        no_return: How a beam without a return is written.
        range_sigma: Standard deviations of a range by the data sheets, least and most [m].
        azimuth_step: Angle between neighbouring shots of a laser, least and most [degrees]; None for a
            pattern that does not repeat.
        ring_step: Angle between neighbouring rings, least and most [degrees]; None without rings.
        messages: Message types of packets and of the maker's own scans that are read.
        packets: Message types of packets that are not decoded.
        ports: UDP ports of raw data.
        driver: Driver that makes clouds of raw data, for refusals.
        simulated: Names of simulated sensors of the family (`sim:...?lidar=`).
        frames: Words in usual names of frames and topics.
    """

    name: str
    models: str
    fields: tuple[str, ...] = ()
    times: str = "none"
    rings: str = "none"
    no_return: str = "left out, NaN or (0, 0, 0)"
    range_sigma: tuple[float, float] = (0.01, 0.03)
    azimuth_step: tuple[float, float] | None = None
    ring_step: tuple[float, float] | None = None
    messages: tuple[str, ...] = ()
    packets: tuple[str, ...] = ()
    ports: tuple[int, ...] = ()
    driver: str = ""
    simulated: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()


VELODYNE = SensorFamily(
    name="Velodyne",
    models="VLP-16, Puck Hi-Res, VLP-32, HDL-32E, HDL-64E, VLS-128",
    fields=("x", "y", "z", "intensity", "ring", "time"),
    times="time: float32, seconds after (or before) the stamp",
    rings="ring: uint16, from below",
    no_return="left out, or NaN in an organised cloud",
    range_sigma=(0.01, 0.03),
    azimuth_step=(0.1, 0.4),
    ring_step=(0.11, 2.0),
    messages=("velodyne_msgs/msg/VelodyneScan",),
    ports=(2368,),
    driver="velodyne_driver",
    simulated=("vlp16", "vlp32"),
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
    models="OS0, OS1, OS2, OSDome",
    fields=("x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"),
    times="t: uint32, nanoseconds after the stamp",
    rings="ring: uint8 or uint16, from above; clouds are organised, one row per ring (64 x 1024)",
    no_return="(0, 0, 0), or range 0",
    range_sigma=(0.007, 0.05),
    azimuth_step=(0.18, 0.7),
    ring_step=(0.18, 2.8),
    messages=OUSTER_PACKETS,
    ports=(7502, 7503),
    driver="ouster_ros",
    simulated=("os1-64", "os0-128"),
    frames=("os_sensor", "os_lidar", "os1", "os0", "os2", "ouster"),
)
HESAI = SensorFamily(
    name="Hesai",
    models="Pandar40P, Pandar64, Pandar128, PandarQT, PandarXT (XT16, XT32, XT32M), AT128, QT128, OT128",
    fields=("x", "y", "z", "intensity", "timestamp", "ring"),
    times="timestamp: float64, seconds since 1970",
    rings="ring: uint16, from above",
    no_return="left out",
    range_sigma=(0.005, 0.02),
    azimuth_step=(0.1, 0.8),
    ring_step=(0.125, 1.45),
    messages=HESAI_SCANS,
    packets=("hesai_ros_driver/msg/UdpFrame", "hesai_ros_driver/msg/UdpPacket"),
    ports=(2368,),
    driver="hesai_ros_driver",
    simulated=("xt32",),
    frames=("hesai", "pandar"),
)
ROBOSENSE = SensorFamily(
    name="RoboSense",
    models="RS-LiDAR-16, RS-LiDAR-32, Helios, Bpearl, Ruby, M1, Airy",
    fields=("x", "y", "z", "intensity", "ring", "timestamp"),
    times="timestamp: float64, seconds since 1970",
    rings="ring: uint16, from below; clouds are organised",
    no_return="NaN",
    range_sigma=(0.01, 0.03),
    azimuth_step=(0.1, 0.4),
    ring_step=(0.1, 2.0),
    packets=(
        "rslidar_msgs/msg/RslidarPacket",
        "rslidar_msgs/msg/RslidarScan",
        "rslidar_msg/msg/RslidarPacket",
        "rslidar_msg/msg/RslidarScan",
        "rscamera_msg/msg/RslidarPacket",
    ),
    ports=(6699,),
    driver="rslidar_sdk",
    simulated=("helios",),
    frames=("rslidar", "robosense", "helios"),
)
LIVOX = SensorFamily(
    name="Livox",
    models="Mid-40, Mid-70, Mid-360, Avia, Horizon, HAP, Tele-15",
    fields=("x", "y", "z", "intensity", "tag", "line", "timestamp"),
    times="CustomMsg: offset_time, uint32, nanoseconds after timebase; PointCloud2: offset_time likewise, or "
    "timestamp, float64, nanoseconds since 1970",
    rings="none: line (0 to 5) is the laser, whose elevation changes; the pattern does not repeat",
    no_return="(0, 0, 0); points that their tag calls noise are left out",
    range_sigma=(0.01, 0.03),
    messages=CUSTOM_TYPES,
    ports=(56000, 56001, 56300, 56301, 57000),
    driver="livox_ros_driver2",
    simulated=("mid360", "avia"),
    frames=("livox",),
)
DEPTH_CAMERA = SensorFamily(
    name="depth camera or solid-state LiDAR",
    models="RealSense, ZED, Orbbec, Azure Kinect, and LiDARs with an image of ranges",
    fields=("x", "y", "z", "rgb"),
    rings="none: an organised image",
    no_return="NaN or (0, 0, 0)",
    range_sigma=(0.005, 0.05),
    azimuth_step=(0.05, 0.5),
    simulated=("solid",),
    frames=("camera", "depth"),
)
PLANAR = SensorFamily(
    name="planar laser",
    models="any with sensor_msgs/LaserScan",
    times="time_increment: float32, seconds per beam",
    rings="one",
    no_return="inf, NaN, or outside of range_min and range_max",
    range_sigma=(0.01, 0.03),
    azimuth_step=(0.1, 1.0),
    messages=("sensor_msgs/msg/LaserScan",),
)
FAMILIES = (VELODYNE, OUSTER, HESAI, ROBOSENSE, LIVOX, DEPTH_CAMERA, PLANAR)


def family_of_messages(msgtype: str) -> SensorFamily | None:
    """Return the family whose packets or scans have a message type; None for others, and for PointCloud2."""
    return next((f for f in FAMILIES if msgtype in (*f.messages, *f.packets)), None)


def family_of_packets(msgtype: str) -> SensorFamily | None:
    """Return the family whose packets, which are not decoded, have a message type; None for other types."""
    return next((family for family in FAMILIES if msgtype in family.packets), None)


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


def markdown_tables() -> str:
    """Return two tables of the families as Markdown, for docs/sensors.md: layouts and beams."""
    rows = ["| family | models | fields of a point | point times | rings | no return |", "|" + " --- |" * 6]
    for f in FAMILIES:
        fields = ", ".join(f"`{name}`" for name in f.fields) or "-"
        rows.append(f"| {f.name} | {f.models} | {fields} | {f.times} | {f.rings} | {f.no_return} |")
    rows += [
        "",
        "| family | range error [cm] | azimuth step [degrees] | ring step [degrees] | messages that are read "
        "| packets that are not decoded | driver | simulated |",
        "|" + " --- |" * 8,
    ]
    for f in FAMILIES:
        messages, packets = (
            ", ".join(f"`{name}`" for name in names) or "-" for names in (f.messages, f.packets)
        )
        rows.append(
            f"| {f.name} | {100 * f.range_sigma[0]:g} to {100 * f.range_sigma[1]:g} "
            f"| {_span(f.azimuth_step)} | {_span(f.ring_step)} | {messages} | {packets} | {f.driver or '-'} "
            f"| {', '.join(f.simulated) or '-'} |"
        )
    return "\n".join(rows) + "\n"


def _span(limits: tuple[float, float] | None) -> str:
    """Return two limits as text; "-" for None."""
    return "-" if limits is None else f"{limits[0]:g} to {limits[1]:g}"
