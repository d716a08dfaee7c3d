"""From decoded columns to a Scan: units of columns, invalid returns, the sensor by its first scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.firing_order import FIRING_ORDER, azimuth_step, turn_shares
from pipeline.io.readers.point_times import PointTimes, TimedScan, time_fields
from pipeline.types.records import Bool, Float, Float32, Int, Int32, Scan, Sensor

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
        keep = are_returns(xyz)
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


def are_returns(points: Float32) -> Bool:
    """Return which points, float32, shape (N, 3) [m], are valid returns, see `clean_scan`; shape (N,)."""
    # Column by column: reducing rows of three is ten times slower.
    with np.errstate(invalid="ignore"):
        x, y, z = np.abs(points.T)
        reach = np.maximum(np.maximum(x, y), z)
        valid: Bool = (reach > NEAR_LIMIT) & (reach < RANGE_LIMIT)
    return valid


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
#: The `line` of a Livox LiDAR is no ring: its elevation changes.
RING = ("ring", "channel", "laser_id")
#: Columns of clouds that other odometry writes, which may be de-skewed already; no driver has them.
PROCESSED = frozenset({"curvature", "normal_x"})
#: Columns that state which points are returns: the range of Ouster [mm], 0 for no return, and tags of Livox.
RETURNED = ("range", "tag")
RING_LIMIT = 1024


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


def scan_of(
    stamp_ns: int,
    columns: Mapping[str, NDArray[np.generic]],
    times: PointTimes | None = None,
    header_ns: int | None = None,
) -> Scan:
    """Return a scan of the columns of a table, which are found by their usual names (REFLECTANCE, RING; the
    first one that exists), without invalid returns (`clean_scan`). Ring numbers and times that are impossible
    are left out as a whole; where a sensor has times, a scan without usable ones has those of its middle.

    Args:
        stamp_ns: Time of the scan [ns].
        columns: Dict from names to columns, shape (N,); x, y and z [m] are among them.
        times: How times of points are read; None for scans without times.
        header_ns: Stamp in the header of the scan [ns], if it differs from `stamp_ns`.
    """
    points, keep = _returns_of(columns)
    ring = first_of(columns, RING)
    scan = clean_scan(
        stamp_ns,
        points,
        reflectance=first_of(columns, REFLECTANCE),
        ring=ring if ring is not None and is_ring(ring) else None,
    )
    if times is None or not keep.any():
        return scan
    if times.field == FIRING_ORDER:
        time: NDArray[np.generic] | None = turn_shares(scan.points)
    else:  # beams without a return often have no time either
        time = columns[times.field][keep] if times.field in columns else None
    offset_ns = None if time is None else times.offsets(time, stamp_ns if header_ns is None else header_ns)
    if offset_ns is None:  # all at the middle of the sweep, which the stamp is not
        offset_ns = np.full(len(scan.points), (times.low_ns + times.high_ns) // 2)
    return replace(scan, offset_ns=_as_int(offset_ns))


def has_times(scan: Scan) -> bool:
    """Return whether a scan with points can be de-skewed: its points have different times."""
    return scan.offset_ns is not None and bool(scan.offset_ns.min() < scan.offset_ns.max())


def timed_scan(stamp_ns: int, columns: Mapping[str, NDArray[np.generic]]) -> TimedScan:
    """Return the columns that may have times of points, of the valid returns of a table, and these in their
    order. A table with one of the columns PROCESSED has no order: it may be de-skewed already.

    Args:
        stamp_ns: Stamp of the scan [ns].
        columns: As in `scan_of`.
    """
    points, keep = _returns_of(columns)
    timed = {name: columns[name][keep] for name in time_fields(list(columns))}
    if not PROCESSED.isdisjoint(columns):
        return TimedScan(stamp_ns, timed)
    ring = first_of(columns, RING)
    ring = ring[keep] if ring is not None and is_ring(ring) else None
    return TimedScan(stamp_ns, timed, points[keep].astype(np.float32), ring)


def _returns_of(columns: Mapping[str, NDArray[np.generic]]) -> tuple[NDArray[np.floating], Bool]:
    """Return the points of a table, shape (N, 3) [m], and which of them are valid returns, shape (N,)."""
    kind = np.float64 if any(columns[axis].dtype.itemsize > 4 for axis in "xyz") else np.float32
    with np.errstate(invalid="ignore", over="ignore"):
        points = np.stack([columns[axis].astype(kind) for axis in "xyz"], axis=1)
    void = _no_returns(columns)
    if void is not None:
        points[void] = np.nan
    with np.errstate(over="ignore"):
        return points, are_returns(points.astype(np.float32, copy=False))


def _no_returns(columns: Mapping[str, NDArray[np.generic]]) -> Bool | None:
    """Return which points are no returns by the columns RETURNED, shape (N,); None without these columns. A
    driver that moves its cloud to another frame moves points without a return away from the origin."""
    reach, tag = (columns.get(name) for name in RETURNED)
    none = np.asarray(reach == 0) if reach is not None and reach.dtype.kind in "iu" else None
    noise = tag_noise(tag) if tag is not None and tag.dtype.kind in "iu" else None
    return noise if none is None else none if noise is None else none | noise


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


#: A sensor without rings whose returns are nearer to each other covers the width of a stem by many rows: the
#: steps of `Sensor` hold [rad]. Real scans of such a sensor have 0.0063.
_DENSE = 0.007
#: Largest angle between neighbouring returns [rad]: of a few hundred points all around.
_SPACING_MOST = 0.1
#: Fewest points of a ring for its elevation.
_RING_POINTS = 8
VLP_16 = Sensor("VLP-16", 16, float(np.radians(2.0)), float(np.radians(0.2)), 0.03, 100.0)
#: The returns of a VLP-16 are 0.63 degrees apart at 10 Hz, 0.89 at 20 Hz; of a thinned-out scan more [rad].
_VLP_16_SPACING = float(np.radians(1.1))
#: Bounds of a measured range sigma [m]: the roughness of bark, which exceeds the noise of a better sensor,
#: and the accuracy of a VLP-16 by its data sheet, which rough ground may exceed.
RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST = 0.01, 0.03
#: Number of places at which the range sigma is measured, and points at each: few, so that they are on one
#: surface, with nine degrees of freedom beside the plane.
_PLACES, _NEIGHBOURS = 1000, 12
_FEWEST = 100  # points of a scan
#: Residuals on planes are up to this times their median (9 degrees of freedom), and number of fits to them.
_MODE, _FITS = 1.5, 20
_LEVEL = np.radians(15.0)  # the field of view of a VLP-16, which shows ground and trunks
#: Neighbours of one ring lie on a line: their spread across it is less than this share of that along it. It
#: comes from the distance between laser and origin, which ties the direction of a point to its noise.
_LINE = 0.1


#: Largest median distance of the returns of a scan [m]: LiDARs of ground robots reach 50 to 500 m, and most
#: of their returns are of the ground within tens of metres.
FARTHEST_MEDIAN = 400.0
NO_METRES = (
    "scans whose coordinates are not in metres, or not those of the sensor: half of the points of the first "
    "one are farther than 400 m away; let the driver write metres in the frame of the LiDAR"
)


def median_range(scan: Scan) -> float:
    """Return the median distance of the points of a scan [m]; 0 without points."""
    if not len(scan.points):
        return 0.0
    return float(np.median(np.linalg.norm(scan.points.astype(np.float64), axis=1)))


def sensor_of(scan: Scan, known: Sensor | None = None) -> Sensor:
    """Infer the sensor from a scan: number of rings (the highest ring number + 1), their step in elevation,
    the step in azimuth, and the range sigma (`measured_range_sigma`).

    If the scan has no ring numbers, it is a VLP-16 if the elevations are those of this sensor, else `rings`
    is 0. Both steps of a sensor without rings are the angle between neighbouring returns (`beam_spacing`) if
    it is above _DENSE; otherwise, and for fewer than 100 points, the azimuth step is that of `Sensor` and the
    ring step 0.

    Args:
        scan: The scan.
        known: The sensor, if it is known except for its range sigma.
    """
    found = replace(known or _beams_of(scan), range_sigma=measured_range_sigma(scan))
    if known is None and not found.rings and len(scan.points) >= _FEWEST:
        step = beam_spacing(scan)
        if step > _DENSE:
            found = replace(found, azimuth_step=step, ring_step=step)
    return found


def beam_spacing(scan: Scan) -> float:
    """Return the angle between neighbouring returns [rad]: the square root of the solid angle of a return,
    which is the median over places all over the scan. The scan has at least 100 points.

    It is 0.9 to 1.1 times the square root of azimuth step times ring step of spinning sensors, 0.38 degrees
    for 24,000 returns in a cone of 70 degrees, and 1.05 for a Mid-360.
    """
    beam, _, near = _neighbours(scan)
    away: Float = np.linalg.norm(beam[near[:, -1]] - beam[near[:, 0]], axis=1)
    return float(min(np.sqrt(np.median(np.pi * away**2) / (_NEIGHBOURS - 1)), _SPACING_MOST))


def _neighbours(scan: Scan, highest: float = np.pi / 2.0) -> tuple[Float, Float, Int]:
    """Return the unit direction of each point, shape (N, 3), its range [m], and the rows of the _NEIGHBOURS
    points that are nearest in direction to each of _PLACES points, the point itself first. These have
    elevations up to `highest` [rad], if there are _FEWEST such points."""
    from scipy.spatial import cKDTree

    points = scan.points.astype(np.float64)
    reach = np.linalg.norm(points, axis=1)
    beam = points / reach[:, None]
    level = np.flatnonzero(np.abs(beam[:, 2]) <= np.sin(highest))
    level = level if len(level) >= _FEWEST else np.arange(len(points))
    places = level[np.linspace(0, len(level) - 1, min(_PLACES, len(level))).astype(np.int64)]
    return beam, reach, cKDTree(beam).query(beam[places], _NEIGHBOURS)[1]


def measured_range_sigma(scan: Scan) -> float:
    """Return the standard deviation of a range [m], from RANGE_SIGMA_LEAST to RANGE_SIGMA_MOST; the latter
    for fewer than 100 points.

    On a plane n p = d, the inverse range of a beam u is linear in u: 1/r = n u / d. This is fitted to the
    returns of neighbouring beams at places all over the scan, whatever the pattern of the sensor; neighbours
    on one ring determine no more than a line. The residuals show the noise on ground and stems, and more on
    leaves and at edges, so the lower quartile of the places is taken, or the mode of the residuals if most
    are larger: 0.87 to 1.24 times the true value in simulated stands, with few or many leaves. The places are
    within _LEVEL of the horizon: a sensor that sees up to 50 degrees, such as a Mid-360, has most of its
    returns in the crowns.
    """
    if len(scan.points) < _FEWEST:
        return RANGE_SIGMA_MOST
    beam, reach, near = _neighbours(scan, _LEVEL)
    inverse = 1.0 / reach[near][:, :, None]
    space, spread, _ = np.linalg.svd(beam[near], full_matrices=False)
    known = spread > _LINE * spread[:, 1:2]
    known[:, :2] = True
    space = space * known[:, None, :]
    residual = (inverse - space @ (space.transpose(0, 2, 1) @ inverse))[:, :, 0]
    variance = np.sum(residual**2, axis=1) / (_NEIGHBOURS - known.sum(axis=1))
    sigmas = np.sqrt(variance) * reach[near[:, 0]] ** 2
    quartile, mode = np.quantile(sigmas, [0.25, 0.05])
    for _ in range(_FITS):
        mode = np.median(sigmas[sigmas <= _MODE * mode])
    sigma = float(min(quartile, mode))
    return float(np.clip(sigma, RANGE_SIGMA_LEAST, RANGE_SIGMA_MOST))


def _beams_of(scan: Scan) -> Sensor:
    """Return the sensor of a scan as `sensor_of` does; its range sigma has no meaning."""
    if len(scan.points) < _FEWEST:
        return Sensor()
    if scan.ring is None or not _are_rings(scan):
        is_vlp_16 = _in_steps_of_vlp_16(scan) and beam_spacing(scan) < _VLP_16_SPACING
        return VLP_16 if is_vlp_16 else Sensor()
    rings = int(scan.ring.max()) + 1
    elevation = _elevations(scan)
    steps = np.abs(np.diff(elevation[np.isfinite(elevation)]))
    ring_step = float(np.median(steps)) if len(steps) else 0.0
    step = azimuth_step(scan.points, scan.ring)
    name = {
        1: "planar laser",
        16: "16-ring LiDAR",
        32: "32-ring LiDAR",
        64: "64-ring LiDAR",
        128: "128-ring LiDAR",
    }
    return Sensor(name.get(rings, "LiDAR"), rings, ring_step, step or Sensor().azimuth_step)


#: A ring has one elevation in each direction, up to the tilt of its cloud [rad]; the coarsest rings are two
#: degrees apart.
_RING_SPREAD = float(np.radians(1.5))
_RING_SECTORS = 180


def _are_rings(scan: Scan) -> bool:
    """Return whether the ring numbers are those of rings: the median standard deviation of the elevation of a
    ring in a sector of two degrees is below _RING_SPREAD. The lines of a LiDAR with a rosette are not."""
    points, ring = scan.points.astype(np.float64), np.asarray(scan.ring, np.int64)
    reach = np.hypot(points[:, 0], points[:, 1])
    far = reach > 1.0  # nearer, the distance between laser and origin changes the angle
    elevation = np.arctan2(points[far, 2], reach[far])
    turn = np.arctan2(points[far, 1], points[far, 0]) / (2.0 * np.pi) + 0.5
    cell = ring[far] * _RING_SECTORS + np.minimum(turn * _RING_SECTORS, _RING_SECTORS - 1).astype(np.int64)
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    mean = np.bincount(cell, elevation) / np.maximum(count, 1)
    variance = np.bincount(cell, (elevation - mean[cell]) ** 2) / np.maximum(count, 1)
    some = count >= 4
    return not some.any() or float(np.median(np.sqrt(variance[some]))) < _RING_SPREAD


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
