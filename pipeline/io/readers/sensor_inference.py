"""What the first scan tells about the LiDAR that made it."""

from __future__ import annotations

import numpy as np

from pipeline.types.records import Float, Int, Scan, Sensor

#: Fewer points than this in a ring say nothing about its elevation.
_RING_POINTS = 8
VLP_16 = Sensor("VLP-16", 16, float(np.radians(2.0)), float(np.radians(0.2)), 0.03, 100.0)


def sensor_of(scan: Scan) -> Sensor:
    """Rings, their step and the step of the azimuth as the scan shows them.

    Without a ring column only a VLP-16 is recognised, by its elevations; else `rings` is 0.
    """
    if len(scan.points) < 100:
        return Sensor(range_sigma=0.03)
    if scan.ring is None:
        return VLP_16 if _in_steps_of_vlp_16(scan) else Sensor(range_sigma=0.03)
    rings = int(scan.ring.max()) + 1
    elevation = _elevations(scan)
    steps = np.abs(np.diff(elevation[np.isfinite(elevation)]))
    ring_step = float(np.median(steps)) if len(steps) else 0.0
    azimuth_step = _azimuth_step(scan)
    name = {
        1: "planar laser",
        16: "16-ring LiDAR",
        32: "32-ring LiDAR",
        64: "64-ring LiDAR",
        128: "128-ring LiDAR",
    }
    return Sensor(
        name.get(rings, "LiDAR"), rings, ring_step, azimuth_step or Sensor().azimuth_step, range_sigma=0.03
    )


def _in_steps_of_vlp_16(scan: Scan) -> bool:
    """Whether nearly all returns lie at odd degrees of elevation from -15 to 15, in four rings or more."""
    points = scan.points.astype(np.float64)
    reach = np.hypot(points[:, 0], points[:, 1])
    # The lasers stand up to 11 mm above and below the centre, which blurs the angles near by.
    degrees = np.degrees(np.arctan2(points[:, 2], reach))[reach > 3.0]
    if len(degrees) < 100:
        return False
    nearest = 2.0 * np.floor(degrees / 2.0) + 1.0
    fitting = (np.abs(degrees - nearest) < 0.2) & (np.abs(nearest) <= 15.0)
    return float(np.mean(fitting)) > 0.95 and len(np.unique(nearest[fitting])) >= 4


def rings_descend(scan: Scan) -> bool:
    """Whether ring 0 looks highest, as some drivers number them."""
    elevation = _elevations(scan) if scan.ring is not None and len(scan.points) else np.zeros(0)
    elevation = elevation[np.isfinite(elevation)]
    return len(elevation) >= 2 and float(np.median(np.diff(elevation))) < 0.0


def _elevations(scan: Scan) -> Float:
    """Median elevation [rad] by ring, NaN for rings with few points, shape (rings,)."""
    ring = np.asarray(scan.ring, dtype=np.int64)
    points = scan.points.astype(np.float64)
    angle = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    found = np.full(int(ring.max()) + 1, np.nan)
    for number in np.unique(ring):
        members: Int = np.flatnonzero(ring == number)
        if len(members) >= _RING_POINTS:
            found[number] = np.median(angle[members])
    return found


def _azimuth_step(scan: Scan) -> float:
    """Median angle between neighbouring returns of a ring [rad], 0 when it cannot be told."""
    steps = []
    ring = np.asarray(scan.ring)
    azimuth = np.arctan2(scan.points[:, 1].astype(np.float64), scan.points[:, 0].astype(np.float64))
    for number in np.unique(ring):
        gaps = np.diff(np.sort(azimuth[ring == number]))
        # Two returns of one shot share their azimuth; gaps of 2 degrees are holes.
        steps.append(gaps[(gaps > 2e-4) & (gaps < 0.035)])
    gaps = np.concatenate(steps) if steps else np.zeros(0)
    return float(np.median(gaps)) if len(gaps) >= _RING_POINTS else 0.0
