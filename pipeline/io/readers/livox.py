"""Livox CustomMsg of the drivers 1 and 2 and of their ROS 2 forks: decoding of all points at once."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: One layout under three names: livox_ros_driver (ROS 1), livox_ros_driver2 (ROS 1 and 2), livox_ros2_driver.
CUSTOM_TYPES = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)
POINT_TEXT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
)
CUSTOM_TEXT = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "{package}/CustomPoint[] points\n"
)
_POINT_BYTES = 19
_NAMES = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
_FORMATS = ("u4", "f4", "f4", "f4", "u1", "u1", "u1")
_OFFSETS = (0, 4, 8, 12, 16, 17, 18)


class CustomMsgError(Exception):
    """The bytes of a CustomMsg do not fit together."""


@dataclass(frozen=True, slots=True)
class CustomMsg:
    """A decoded message.

    Attributes:
        frame: `frame_id` of the header.
        timebase_ns: Time of the first point by the clock of the sensor [ns].
        points: Structured array, shape (N,): offset_time [ns after timebase], x, y, z [m], reflectivity, tag,
            line.
    """

    frame: str
    timebase_ns: int
    points: NDArray[np.void]


def decode_custom(payload: bytes, encoding: str) -> CustomMsg:
    """Decode a CustomMsg.

    Args:
        payload: The message.
        encoding: "ros1", or another text for CDR.

    Raises:
        CustomMsgError: The message is shorter than its header and number of points say.
    """
    packed = encoding == "ros1"
    try:
        if packed:
            order, start, align = "<", 0, 1
            at = 12
        else:
            order, start, align = "<" if payload[1] & 1 else ">", 4, 4
            at = start + 8
        (length,) = struct.unpack_from(order + "I", payload, at)
        frame = payload[at + 4 : at + 4 + length].rstrip(b"\0").decode("utf-8", "replace")
        at = start + _aligned(at + 4 + length - start, 2 * align if align > 1 else 1)
        timebase, _number, _lidar = struct.unpack_from(order + "QIB3x", payload, at)
        (count,) = struct.unpack_from(order + "I", payload, at + 16)
    except (struct.error, IndexError) as error:
        raise CustomMsgError("the message is cut in its header") from error
    step = _aligned(_POINT_BYTES, align)
    first = at + 20
    if count and first + step * (count - 1) + _POINT_BYTES > len(payload):
        raise CustomMsgError(f"{count} points need more than the {len(payload)} bytes of the message")
    dtype = np.dtype(
        {"names": _NAMES, "formats": [order + f for f in _FORMATS], "offsets": _OFFSETS, "itemsize": step}
    )
    # CDR does not fill up the last point.
    body = payload[first : first + step * count].ljust(step * count, b"\0")
    return CustomMsg(frame, timebase, np.frombuffer(body, dtype, count))


def _aligned(size: int, unit: int) -> int:
    """Return a size rounded up to a multiple of a unit."""
    return -(-size // unit) * unit


#: Largest share of points that tags may call noise; above it, they mean something else.
_NOISE_MOST = 0.5


def tag_noise(tag: NDArray[np.generic]) -> NDArray[np.bool_] | None:
    """Return which points the sensor calls noise, shape (N,); None if none, or more than _NOISE_MOST.

    Bits 0 and 1 of a tag are the confidence by the position of a point (between two objects), bits 2 and 3 by
    its strength (rain, fog, dust). For all models 0 is a normal point; 1 and 2 are noise with high and
    moderate confidence for Avia, Horizon and Mid-70, points with moderate and low confidence for Mid-360 and
    HAP; 3 is reserved, or noise with low confidence.
    """
    bits = tag.astype(np.uint8)
    noise = np.isin(bits & 3, (1, 2)) | np.isin((bits >> 2) & 3, (1, 2))
    share = float(np.mean(noise)) if len(noise) else 0.0
    return noise if 0.0 < share <= _NOISE_MOST else None
