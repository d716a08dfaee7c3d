"""Messages of a Livox LiDAR as its drivers write them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg

from tests.pipeline.io.recordings import START_NS, Author

POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n{}[] points"
)
COUNT = 400


def rosette(scan: int, count: int = COUNT) -> NDArray[np.void]:
    """Returns in a cone, on curves that cross all elevations; every tenth is none, every twentieth noise."""
    t = (np.arange(count) + count * scan) * 0.013
    azimuth, elevation = 0.6 * np.sin(7.3 * t), 0.6 * np.sin(5.1 * t)
    table = np.zeros(count, "u4,f4,f4,f4,u1,u1,u1")
    table.dtype.names = ("offset_time", "x", "y", "z", "reflectivity", "tag", "line")
    table["offset_time"] = np.arange(count) * 100_000_000 // count
    reach = 6.0 + 0.01 * np.arange(count)
    table["x"] = reach * np.cos(elevation) * np.cos(azimuth)
    table["y"] = reach * np.cos(elevation) * np.sin(azimuth)
    table["z"] = reach * np.sin(elevation)
    for axis in "xyz":
        table[axis][::10] = 0.0
    table["reflectivity"] = 50
    table["tag"] = 0x10
    table["tag"][5::20] = 0x12
    table["line"] = np.arange(count) % 6
    return table


def custom(author: Author, kind: str, scan: int, timebase_ns: int | None = None) -> Any:
    """A CustomMsg, made by rosbags."""
    package = kind.partition("/")[0]
    point = f"{package}/msg/CustomPoint"
    if kind not in author.store.fielddefs:
        author.store.register(get_types_from_msg(POINT, point))
        author.store.register(get_types_from_msg(MESSAGE.format(f"{package}/CustomPoint"), kind))
    stamp_ns = START_NS + scan * 100_000_000
    points = [author.store.types[point](*row) for row in rosette(scan).tolist()]
    header = author.header(stamp_ns, "livox_frame")
    base_ns = stamp_ns if timebase_ns is None else timebase_ns
    return author.store.types[kind](header, base_ns, len(points), 0, np.zeros(3, np.uint8), points)
