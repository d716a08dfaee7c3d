"""From decoded columns to a Scan: units of columns, invalid returns, the sensor by its first scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Float, Float32, Int, Int32, Scan, Sensor

#: Most points of one scan; a 128-ring sensor at 5 Hz gives 480,000.
POINT_LIMIT = 16_000_000
#: Larger ranges [m] are damaged numbers.
RANGE_LIMIT = 10_000.0
#: Drivers write (0, 0, 0) for a beam without a return; closer points are no returns [m].
NEAR_LIMIT = 1e-3


def clean_scan(
    stamp_ns: int,
    points: NDArray[np.floating],
    *,
    reflectance: NDArray[np.generic] | None = None,
    ring: NDArray[np.generic] | None = None,
    offset_ns: NDArray[np.generic] | None = None,
    dropped: int = 0,
) -> Scan:
    """Return a scan without invalid returns: points that are not finite, have a coordinate with a magnitude
    of RANGE_LIMIT or more, or are at the origin (all magnitudes up to NEAR_LIMIT). If no point is left out,
    arrays that already have the type of `Scan` are shared with the result, except reflectances of which some
    are not finite.

    Args:
        stamp_ns: Time of the scan [ns].
        points: Points in the sensor frame, shape (N, 3) [m].
        reflectance: Reflectances, shape (N,), or None. NaN becomes 0, infinite numbers become the largest
            float32 of their sign.
        ring: Ring numbers, shape (N,), or None.
        offset_ns: Times of the points after the stamp, shape (N,) [ns], or None.
        dropped: Number of returns that were left out before; the rows left out here are added.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        xyz = np.ascontiguousarray(points, dtype=np.float32)
        # Column by column: reducing rows of three is ten times slower.
        x, y, z = np.abs(xyz.T)
        reach = np.maximum(np.maximum(x, y), z)
        keep = (reach > NEAR_LIMIT) & (reach < RANGE_LIMIT)
    refused = int(len(keep) - np.count_nonzero(keep))
    if refused:
        xyz = xyz[keep]

    def column(values: NDArray[np.generic] | None) -> NDArray[np.generic] | None:
        """Return the remaining rows of a column; None for None."""
        return values if values is None or not refused else values[keep]

    return Scan(
        stamp_ns,
        xyz,
        _as_float(column(reflectance)),
        _as_int(column(ring)),
        _as_int(column(offset_ns)),
        dropped + refused,
    )


def _as_float(values: NDArray[np.generic] | None) -> Float32 | None:
    """Return a column as float32, with NaN as 0 and infinite numbers as the largest float32 of their sign;
    None for None. A contiguous float32 column of finite numbers is not copied."""
    if values is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        column = np.ascontiguousarray(values, dtype=np.float32)
    return np.nan_to_num(column) if not np.isfinite(column).all() else column


def _as_int(values: NDArray[np.generic] | None) -> Int32 | None:
    """Return a column as int32, not copied if it is contiguous int32; None for None."""
    return None if values is None else np.ascontiguousarray(values, dtype=np.int32)


REFLECTANCE = ("intensity", "intensities", "reflectivity", "reflectance", "i")
RING = ("ring", "channel", "laser_id", "line")
TIME = ("t", "time", "timestamp", "time_offset", "offset_time")
RING_LIMIT = 1024
OFFSET_LIMIT_NS = 2_000_000_000


def first_of(
    columns: Mapping[str, NDArray[np.generic]], names: tuple[str, ...]
) -> NDArray[np.generic] | None:
    """Return the first of some columns that exists, None if none exists.

    Args:
        columns: Dict from names to columns.
        names: Names in the order of preference.
    """
    return next((columns[name] for name in names if name in columns), None)


def is_ring(ring: NDArray[np.generic]) -> bool:
    """Return whether a column has ring numbers: an integer type with numbers from 0 to below RING_LIMIT.
    False for an empty column."""
    if ring.dtype.kind not in "iu" or not len(ring):
        return False
    return int(ring.min()) >= 0 and int(ring.max()) < RING_LIMIT


def point_offsets(time: NDArray[np.generic], stamp_ns: int) -> NDArray[np.int64] | None:
    """Return the times of points relative to the stamp [ns], shape (N,), or None if they are impossible.

    Integers are nanoseconds after the stamp, or since 1970 if the first one is above 1e15; floating numbers
    are seconds after the stamp, or times since 1970 in s, ms, us or ns if the largest is above 1e8, 1e11,
    1e14 or 1e17. If one time is farther than 2 s from the stamp, all are impossible; so is an empty column. A
    floating number that is not finite counts as the time of the stamp.
    """
    if not len(time):
        return None
    if time.dtype.kind in "iu":
        ns = time.astype(np.int64)
        ns = ns - stamp_ns if abs(int(ns[0])) > 10**15 else ns
    else:
        with np.errstate(invalid="ignore"):
            seconds = time.astype(np.float64)
        finite = np.isfinite(seconds)
        if not finite.all():
            seconds[~finite] = 0.0
        unit = _unit(float(np.abs(seconds).max()))
        since = stamp_ns if unit is not None else 0
        # Subtract the whole second first: a double cannot hold nanoseconds since 1970.
        whole = since // 1_000_000_000
        scale = unit or 1.0
        with np.errstate(over="ignore"):
            seconds = (seconds - whole / scale) * scale
            ns = np.clip(seconds * 1e9, -1e18, 1e18).astype(np.int64) - (since - whole * 10**9)
        ns[~finite] = 0
    return ns if int(np.abs(ns).max()) <= OFFSET_LIMIT_NS else None


def _unit(largest: float) -> float | None:
    """Return the unit [s] of times since 1970 by the largest magnitude, None if times are relative (up to
    1e8)."""
    for limit, unit in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0)):
        if largest > limit:
            return unit
    return None


def scan_of(stamp_ns: int, columns: Mapping[str, NDArray[np.generic]]) -> Scan:
    """Return a scan of the columns of a table, which are found by their usual names (REFLECTANCE, RING, TIME;
    the first one that exists), without invalid returns (`clean_scan`). Ring numbers and times that are
    impossible are left out as a whole.

    Args:
        stamp_ns: Time of the scan [ns].
        columns: Dict from names to columns, shape (N,); x, y and z [m] are among them.
    """
    kind = np.float64 if any(columns[axis].dtype.itemsize > 4 for axis in "xyz") else np.float32
    with np.errstate(invalid="ignore", over="ignore"):
        points = np.stack([columns[axis].astype(kind) for axis in "xyz"], axis=1)
    ring, time = first_of(columns, RING), first_of(columns, TIME)
    return clean_scan(
        stamp_ns,
        points,
        reflectance=first_of(columns, REFLECTANCE),
        ring=ring if ring is not None and is_ring(ring) else None,
        offset_ns=None if time is None else point_offsets(time, stamp_ns),
    )


#: Fewest points of a ring for its elevation.
_RING_POINTS = 8
VLP_16 = Sensor("VLP-16", 16, float(np.radians(2.0)), float(np.radians(0.2)), 0.03, 100.0)
#: Bounds of a measured range sigma [m]: the roughness of bark, which exceeds the noise of a better sensor,
#: and the accuracy of a VLP-16 by its data sheet, which rough ground may exceed.
RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST = 0.01, 0.03
#: Number of places at which the range sigma is measured, and points at each: few, so that they are on one
#: surface, with nine degrees of freedom beside the plane.
_PLACES, _NEIGHBOURS = 1000, 12
_FEWEST = 100  # points of a scan


def sensor_of(scan: Scan, known: Sensor | None = None) -> Sensor:
    """Infer the sensor from a scan: number of rings (the highest ring number + 1), their step in elevation,
    the step in azimuth, and the range sigma (`measured_range_sigma`).

    If the scan has no ring numbers, it is a VLP-16 if the elevations are those of this sensor, else `rings`
    is 0. For fewer than 100 points `rings` is 0 too. An unknown azimuth step is that of `Sensor`, an unknown
    ring step 0.

    Args:
        scan: The scan.
        known: The sensor, if it is known except for its range sigma.
    """
    return replace(known or _beams_of(scan), range_sigma=measured_range_sigma(scan))


def measured_range_sigma(scan: Scan) -> float:
    """Return the standard deviation of a range [m], from RANGE_SIGMA_LEAST to RANGE_SIGMA_MOST; the latter
    for fewer than 100 points.

    On a plane n p = d, the inverse range of a beam u is linear in u: 1/r = n u / d. This is fitted to the
    returns of neighbouring beams at places all over the scan, whatever the pattern of the sensor. The
    residuals show the noise on ground and stems, and more on leaves and at edges, so the lower quartile of
    the places is taken: 0.87 to 1.09 times the true value in simulated stands, with few or many leaves.
    """
    from scipy.spatial import cKDTree

    if len(scan.points) < _FEWEST:
        return RANGE_SIGMA_MOST
    points = scan.points.astype(np.float64)
    reach = np.linalg.norm(points, axis=1)
    beam = points / reach[:, None]
    places = np.linspace(0, len(points) - 1, min(_PLACES, len(points))).astype(np.int64)
    _, near = cKDTree(beam).query(beam[places], _NEIGHBOURS)
    inverse = 1.0 / reach[near][:, :, None]
    space = np.linalg.svd(beam[near], full_matrices=False)[0]
    residual = (inverse - space @ (space.transpose(0, 2, 1) @ inverse))[:, :, 0]
    variance = np.sum(residual**2, axis=1) / (_NEIGHBOURS - 3)
    sigma = float(np.quantile(np.sqrt(variance) * reach[places] ** 2, 0.25))
    return float(np.clip(sigma, RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST))


def _beams_of(scan: Scan) -> Sensor:
    """Return the sensor of a scan as `sensor_of` does; its range sigma has no meaning."""
    if len(scan.points) < _FEWEST:
        return Sensor()
    if scan.ring is None:
        return VLP_16 if _in_steps_of_vlp_16(scan) else Sensor()
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
    return Sensor(name.get(rings, "LiDAR"), rings, ring_step, azimuth_step or Sensor().azimuth_step)


def _in_steps_of_vlp_16(scan: Scan) -> bool:
    """Return whether nearly all returns beyond 3 m have odd degrees of elevation, -15 to 15, in four rings or
    more; False for fewer than 100."""
    points = scan.points.astype(np.float64)
    reach = np.hypot(points[:, 0], points[:, 1])
    # The lasers are up to 11 mm above and below the centre, which blurs the angles of near returns.
    degrees = np.degrees(np.arctan2(points[:, 2], reach))[reach > 3.0]
    if len(degrees) < 100:
        return False
    nearest = 2.0 * np.floor(degrees / 2.0) + 1.0
    fitting = (np.abs(degrees - nearest) < 0.2) & (np.abs(nearest) <= 15.0)
    return float(np.mean(fitting)) > 0.95 and len(np.unique(nearest[fitting])) >= 4


def rings_descend(scan: Scan) -> bool:
    """Return whether ring 0 has the highest elevation, as some drivers number rings. False if there are no
    ring numbers or fewer than two rings with known elevations."""
    elevation = _elevations(scan) if scan.ring is not None and len(scan.points) else np.zeros(0)
    elevation = elevation[np.isfinite(elevation)]
    return len(elevation) >= 2 and float(np.median(np.diff(elevation))) < 0.0


def _elevations(scan: Scan) -> Float:
    """Return the median elevation [rad] of each ring, NaN for one with fewer than _RING_POINTS points, shape
    (rings,). The scan has points and ring numbers."""
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
    """Return the median angle between neighbouring returns of a ring [rad], without equal azimuths and holes;
    0 for fewer than _RING_POINTS such angles. The scan has ring numbers."""
    steps = []
    ring = np.asarray(scan.ring)
    azimuth = np.arctan2(scan.points[:, 1].astype(np.float64), scan.points[:, 0].astype(np.float64))
    for number in np.unique(ring):
        gaps = np.diff(np.sort(azimuth[ring == number]))
        # Two returns of one shot have the same azimuth; gaps of 2 degrees are holes.
        steps.append(gaps[(gaps > 2e-4) & (gaps < 0.035)])
    gaps = np.concatenate(steps) if steps else np.zeros(0)
    return float(np.median(gaps)) if len(gaps) >= _RING_POINTS else 0.0
