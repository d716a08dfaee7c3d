"""The extension `formats`: readers of files that few have, and the folder of stems for other programs."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from app.extension import Extension

if TYPE_CHECKING:
    from pipeline.io.readers import AnyFormat

_PCAP = (
    b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d", b"\x0a\x0d\x0d\x0a"
)  # fmt: skip


#: Shortest and longest stretch of the drive for GNSS fixes [m].
FIX_STRETCH = 10.0, 100.0
#: Shortest and longest stretch for poses of another SLAM [m]; short, because odometry drifts and these poses
#: are much better than GNSS fixes.
POSE_STRETCH = 5.0, 20.0
#: Messages with packets that are not decoded.
_HESAI = ("hesai_ros_driver/msg/UdpFrame", "hesai_ros_driver/msg/UdpPacket")
_ROBOSENSE = (
    "rslidar_msgs/msg/RslidarPacket",
    "rslidar_msgs/msg/RslidarScan",
    "rslidar_msg/msg/RslidarPacket",
    "rslidar_msg/msg/RslidarScan",
    "rscamera_msg/msg/RslidarPacket",
)


def _later(module: str, name: str) -> Callable[..., Any]:
    """Return a function that imports a module of this extension and calls its member when it is called."""
    return lambda *given: getattr(import_module(f"{__name__}.{module}"), name)(*given)


def _is_tree_manager(names: Collection[str]) -> bool:
    """Return whether a folder with these files is one of TreeManager."""
    return any(name.startswith("TreeManagerState_") for name in names)


@cache
def _formats() -> tuple[AnyFormat, ...]:
    """Return the formats."""
    from pipeline.io.readers import Format, MessageFormat, ReadingFormat
    from pipeline.io.readers.sensor_families import CUSTOM_TYPES, HESAI_SCANS, OUSTER_PACKETS

    stems = "a folder of TreeManagerState_<i>.csv with trajectory.txt"
    return (
        Format("Velodyne, Hesai or Ouster .pcap", _PCAP, (".pcap",), _later("capture", "open_capture")),
        Format(
            "Victoria Park .zip (LASER.txt, DRS.txt)",
            (b"PK\x03\x04",),
            (".zip",),
            _later("victoria_park", "VictoriaParkSource"),
        ),
        Format(
            "whole cloud .e57",
            (b"ASTM-E57",),
            (".e57",),
            table=_later("e57", "open_e57"),
        ),
        Format(
            "whole cloud as text (.xyz, .txt, .asc, .csv, .pts, .ptx)",
            (),
            (".xyz", ".asc", ".pts", ".ptx", ".txt", ".csv"),
            table=_later("text_points", "open_text"),
            accepts=_later("text_points", "is_text_of_points"),
        ),
        Format(
            "nuScenes, Boreas or NCLT .bin",
            (),
            (".bin",),
            table=_later("bin_rows", "open_rows"),
            scans=".bin",
            accepts=_later("bin_rows", "is_of_other_data_set"),
        ),
        Format(stems, (), (), _later("tree_manager", "TreeManagerSource"), is_folder=_is_tree_manager),
        MessageFormat("messages of Livox", CUSTOM_TYPES, columns=_later("livox", "columns_of")),
        MessageFormat("raw packets of Hesai", HESAI_SCANS, sweeps=_later("hesai", "HesaiDecoder")),
        MessageFormat(
            "raw packets of Ouster",
            OUSTER_PACKETS,
            recording=_later("ouster", "with_packets_decoded"),
            driver="ouster_ros",
        ),
        MessageFormat("raw packets of Hesai", _HESAI, driver="hesai_ros_driver"),
        MessageFormat("raw packets of RoboSense", _ROBOSENSE, driver="rslidar_sdk"),
        ReadingFormat(
            role="gnss",
            field="gnss",
            messages="GNSS messages",
            title="GNSS",
            plural="GNSS fixes",
            short="fixes",
            unknown="the direction of north",
            read=_later("gnss", "read_fix"),
            align=_later("gnss", "align_fixes"),
            stretch=FIX_STRETCH,
            early=False,
        ),
        ReadingFormat(
            role="pose",
            field="other_slam",
            messages="poses of another SLAM",
            title="other SLAM",
            plural="Poses of another SLAM",
            short="poses",
            unknown="the pose of their frame",
            read=_later("other_slam", "read_pose"),
            align=_later("other_slam", "align_poses"),
            stretch=POSE_STRETCH,
            early=True,
        ),
    )


EXTENSION = Extension(
    help="readers of rare files: .e57, text clouds, packet captures, packets of Hesai and Ouster, ...",
    takes={"export": "app.extensions.formats.export_command"},
    formats=_formats,
)
