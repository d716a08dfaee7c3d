"""ROS message types that are read, and the decoder of their definitions."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
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
}
_ROS1_TIME = {"velodyne_msgs/msg/VelodynePacket": "time stamp\nuint8[1206] data\n"}
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,127}")
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,127}(/[A-Za-z][A-Za-z0-9_]{0,127}){1,3}")
_DEFINITION_LIMIT = 64 << 10
_ARRAY_LIMIT = 1 << 20
#: As rosbags describes a type: its constants, and its fields with their kinds.
Fields = tuple[list[Any], list[tuple[str, Any]]]


class MessageDecoder:
    """Decodes the messages of one recording.

    A definition in the file is untrusted: it is used only where it differs from the standard one, and after a
    check of its names, sizes and nesting.

    Args:
        channels: Channels of the recording with their definitions.

    Attributes:
        refused: Topics with definitions that are not valid.
    """

    def __init__(self, channels: Iterable[Channel]) -> None:
        """Check the definitions of the types that are read; other channels are ignored."""
        self._stores: dict[str, Typestore] = {}
        self.refused: list[str] = []
        for channel in channels:
            if channel.msgtype in READ_TYPES and channel.definition:
                self._adopt(channel)

    def decode(self, channel: Channel, payload: bytes) -> Any:  # noqa: ANN401
        """Return one message decoded as the type of its channel; `rosbags.typesys.stores.ros2_jazzy` declares
        the fields.

        Raises:
            Exception: Of many kinds, when the bytes do not match the type. Callers count a loss.
        """
        store = self._store(channel)
        if channel.encoding == "ros1":
            return store.deserialize_ros1(payload, channel.msgtype)
        return store.deserialize_cdr(payload, channel.msgtype)

    def _store(self, channel: Channel) -> Typestore:
        """Return the types by which messages of a channel are decoded: those of the recording where they are
        used, else the standard ones."""
        own = self._stores.get(channel.msgtype)
        if own is not None:
            return own
        if channel.encoding not in self._stores:
            self._stores[channel.encoding] = standard_types(channel.encoding)
        return self._stores[channel.encoding]

    def _adopt(self, channel: Channel) -> None:
        """Use the definition of a type in the recording where it differs from the standard one. The topic of
        an invalid one is added to `refused`, and the standard one is used."""
        standard = self._store(channel)
        try:
            found = _parse(channel)
            if all(
                standard.fielddefs.get(name, ([], None))[1] == fields for name, (_, fields) in found.items()
            ):
                return
            store = get_typestore(Stores.EMPTY)
            store.register(_closed(found, channel.msgtype, standard))
        except Exception:
            self.refused.append(channel.topic)
            return
        self._stores[channel.msgtype] = store


@cache
def standard_types(encoding: str) -> Typestore:
    """Return the definitions of ROS 1 for "ros1" and of ROS 2 for any other encoding, with those of Velodyne
    and tf; the same object at each call."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    for name, text in _EXTRA.items():
        if name not in store.fielddefs:
            chosen = _ROS1_TIME.get(name, text) if encoding == "ros1" else text
            store.register({name: get_types_from_msg(chosen, name)[name]})
    return store


def _parse(channel: Channel) -> dict[str, Fields]:
    """Return the types in the definition of a channel, by name.

    Raises:
        ValueError: The definition is too long. A damaged one raises exceptions of many kinds.
    """
    if len(channel.definition) > _DEFINITION_LIMIT:
        raise ValueError("the definition is too long")
    if channel.definition_format == "ros2idl":
        return dict(get_types_from_idl(channel.definition))
    return dict(get_types_from_msg(channel.definition, channel.msgtype))


def _closed(found: dict[str, Fields], root: str, standard: Typestore) -> dict[str, Fields]:
    """Return a type with the types of all its fields, by name.

    Args:
        found: Types in the file.
        root: Name of the type.
        standard: Standard types, which are used where the file has none.

    Raises:
        ValueError: A type is not defined, or is too large.
    """
    closed: dict[str, Fields] = {}
    open_names = [root]
    while open_names:
        name = open_names.pop()
        if name in closed:
            continue
        fields = found[name][1] if name in found else standard.fielddefs.get(name, ([], []))[1]
        _check(name, fields)
        # Constants are not needed and are not trusted.
        closed[name] = ([], fields)
        open_names += [part for _, kind in fields for part in _parts(kind)]
    return closed


def _parts(kind: tuple[Any, Any]) -> list[str]:
    """Return the names of the types in the description of a field."""
    nodetype, detail = kind
    if nodetype == Nodetype.NAME:
        return [str(detail)]
    return _parts(detail[0]) if nodetype in (Nodetype.ARRAY, Nodetype.SEQUENCE) else []


def _check(name: str, fields: list[tuple[str, Any]]) -> None:
    """Check that a type is plain.

    Raises:
        ValueError: It has no fields, a name is not an identifier, or an array is too long.
    """
    if not _TYPE.fullmatch(name) or not fields:
        raise ValueError(f"bad type {name!r}")
    for field_name, (kind, detail) in fields:
        if not _NAME.fullmatch(field_name):
            raise ValueError(f"bad field {field_name!r}")
        if kind == Nodetype.ARRAY and not 0 < detail[1] <= _ARRAY_LIMIT:
            raise ValueError(f"bad length of {field_name}")
