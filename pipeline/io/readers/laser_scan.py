"""sensor_msgs/LaserScan: from ranges of a laser that sees in one plane to a Scan with z = 0."""

from __future__ import annotations

import numpy as np

from pipeline.io.readers.cleaning import POINT_LIMIT, clean_scan
from pipeline.io.readers.point_fields import OFFSET_LIMIT_NS
from pipeline.io.readers.pointcloud2 import LayoutError
from pipeline.io.readers.ros_messages import LaserScan
from pipeline.types.records import Scan


def decode_laser_scan(laser: LaserScan, stamp_ns: int) -> Scan:
    """Decode a LaserScan; the stamp is the time of its first beam.

    Beams outside of its own range_min and range_max are no returns. All points are of ring 0.

    Raises:
        LayoutError: Its angles or ranges cannot be true.
    """
    ranges = np.asarray(laser.ranges, dtype=np.float64)
    first, step = float(laser.angle_min), float(laser.angle_increment)
    if len(ranges) > POINT_LIMIT or not abs(first) < 100.0 or not 1e-6 < abs(step) < 1.0:
        raise LayoutError(f"{len(ranges)} beams from {first} rad in steps of {step} rad")
    if abs(step) * len(ranges) > 13.0:
        raise LayoutError("the beams go around more than twice")
    angle = first + step * np.arange(len(ranges))
    seen = np.isfinite(ranges) & (ranges >= float(laser.range_min)) & (ranges <= float(laser.range_max))
    far, angle = ranges[seen], angle[seen]
    points = np.stack([far * np.cos(angle), far * np.sin(angle), np.zeros(len(far))], axis=1)
    each_ns = float(laser.time_increment) * 1e9
    timed = 0.0 < each_ns * len(ranges) < OFFSET_LIMIT_NS
    strength = laser.intensities if len(laser.intensities) == len(ranges) else None
    return clean_scan(
        stamp_ns,
        points,
        reflectance=None if strength is None else np.asarray(strength)[seen],
        ring=np.zeros(len(points), np.int32),
        offset_ns=np.rint(each_ns * np.flatnonzero(seen)).astype(np.int64) if timed else None,
        dropped=len(ranges) - len(points),
    )
