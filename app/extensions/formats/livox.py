"""Livox CustomMsg of the drivers 1 and 2 and of their ROS 2 forks: decoding of all points at once."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.point_times import LONGEST_NS

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


def columns_of(payload: bytes, encoding: str, header_ns: int) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Return the frame and a dict from names to columns of a CustomMsg, shape (N,). The times of the points
    are after its stamp: by its time base if this is by the clock of the stamp (within 2 s), else the time
    base is taken as the stamp.

    Args:
        payload, encoding: As in `decode_custom`, also for errors.
        header_ns: The stamp [ns].
    """
    custom = decode_custom(payload, encoding)
    columns: dict[str, NDArray[np.generic]] = {name: custom.points[name] for name in _NAMES}
    late_ns = custom.timebase_ns - header_ns
    if abs(late_ns) < 2 * LONGEST_NS:
        columns["offset_time"] = columns["offset_time"].astype(np.int64) + late_ns
    return custom.frame, columns
