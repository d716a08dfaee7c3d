"""The range of heights of the colour ramp, which the scene draws and the page labels."""

from __future__ import annotations

import numpy as np

from pipeline.types.records import Frame

# About the heights of ground and trunks of a stand, relative to the sensor [m].
HEIGHT_LOW, HEIGHT_HIGH = -1.0, 3.0


def height_range(frame: Frame) -> tuple[float, float]:
    """Return the lower and upper end of the colour ramp, heights in the level frame of the sensor [m]:
    HEIGHT_LOW and HEIGHT_HIGH for a scan and for a map without points; the percentiles 1 and 99 of the
    filtered points without a drive."""
    if frame.of_drive or not len(frame.filtered):
        return HEIGHT_LOW, HEIGHT_HIGH
    low, high = np.percentile(frame.filtered[:, 2], (1.0, 99.0))
    return float(low), float(high)
