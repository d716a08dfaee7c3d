"""Features of columns for the classifier. None of them uses the reflectivity, whose unit depends on the
sensor."""

from __future__ import annotations

import numpy as np

from pipeline.classification.column_extraction import ARC, HIGH
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int32

# Bands of height above the ground, as slices: first, and one past the last.
BANDS = np.array([[1, 4], [4, 7], [7, 11], [11, 16], [16, 30]])
CLEAN, CLEAN_NEAR = 0.5, 0.7  # share of the returns around a clean slice that is at the axis, see `_stem`
GAP = 2  # slices in which a stem may be hidden

_BAND_WORDS = ("0.2-0.8", "0.8-1.4", "1.4-2.2", "2.2-3.2", "3.2-6")
NAMES = tuple(
    [f"{figure} {band} m" for band in _BAND_WORDS for figure in ("filled", "alone", "ring open")]
    + [
        "lowest return",
        "clean from",
        "clean to",
        "clean slices",
        "highest return",
        "headroom",
        "looked at up to",
        "tilt",
        "wobble",
        "spread",
        "voxels a slice",
        "returns a voxel",
        "returns around",
        "crown",
        "gone",
        "returns a slice",
        "thick",
        "wide",
        "uneven",
        "part of the view filled",
        "radius",
        "residual",
        "residual of the radius",
        "thick above",
        "wide above",
        "voxels to 3 m",
    ]
    + [f"alone beyond 0.45 m {band} m" for band in _BAND_WORDS[:4]]
    + [f"alone within 0.45 m {band} m" for band in _BAND_WORDS[:4]]
    + [f"opaque {band} m" for band in _BAND_WORDS]
    + [
        "free above what is clean",
        "free above the highest return",
        "rays up to",
        "nothing above what is clean",
    ]
)
COUNT = len(NAMES)
# The features from RAYS onwards are those of rays.
LAST, RAYS = NAMES.index("clean to"), NAMES.index("opaque 0.2-0.8 m")
UNSEEN = -1.0  # value of a feature of a band without returns


@compiled
def features(
    axis: Float,
    profiles: Float,
    viewed: Float,
    present: Float,
    absent: Float,
    met: Int32,
    passed: Int32,
    figures: Float,
) -> None:
    """Fill `figures`, shape (K, COUNT), with the features of columns in the order of NAMES.

    Args:
        axis: Axes, shape (K, 5), see `find_columns`.
        profiles: Profiles, shape (K, SLICES, PROFILE).
        viewed: Maximum height above the ground that a scan observed at the column, shape (K,) [m].
        present, absent: Number of scans with free view in which the column was present or absent, shape (K,).
        met, passed: Number of rays that ended at the column and that passed its axis, shape (K, SLICES).
        figures: Filled with the features.
    """
    for c in range(axis.shape[0]):
        _features(axis[c], profiles[c], viewed[c], present[c], absent[c], figures[c])
        _rays(profiles[c], met[c], passed[c], int(figures[c, LAST] / SLICE + 0.5), figures[c, RAYS:])


@compiled
def _features(axis: Float, rows: Float, viewed: float, present: float, absent: float, out: Float) -> None:
    """Write the features of one column that do not come from rays into `out`; see NAMES.

    Args:
        axis: Axis of the column, shape (5,).
        rows: Profile of the column, shape (SLICES, PROFILE).
        viewed: Maximum height that a scan observed at the column [m].
        present, absent: Number of scans in which the column was present and absent.
        out: Features in the order of NAMES, changed in place; those from RAYS onwards are not written.
    """
    for b in range(BANDS.shape[0]):
        _band(rows, BANDS[b, 0], BANDS[b, 1], out[3 * b : 3 * b + 3])
    k = 3 * BANDS.shape[0]
    bottom, first, last, clean, top = _stem(rows)
    out[k] = bottom * SLICE
    out[k + 1] = first * SLICE
    out[k + 2] = last * SLICE
    out[k + 3] = clean
    out[k + 4] = top * SLICE
    out[k + 5] = max(viewed, top * SLICE) - top * SLICE
    out[k + 6] = max(viewed, top * SLICE)
    out[k + 7] = np.hypot(axis[2], axis[3])
    inside, cells, filled, wobble, spread, ring = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(1, min(last + 1, SLICES)):
        if rows[s, 0] > 0.0:
            filled += 1.0
            inside += rows[s, 0]
            cells += rows[s, 3]
            wobble += rows[s, 5] ** 2 + rows[s, 6] ** 2
            spread += rows[s, 7]
            ring += rows[s, 1] + rows[s, 2]
    some = max(filled, 1.0)
    out[k + 8] = np.sqrt(wobble / some)
    out[k + 9] = spread / some
    out[k + 10] = cells / some
    out[k + 11] = np.log(1.0 + inside / max(cells, 1.0))
    out[k + 12] = ring / max(inside + ring, 1.0)
    above = 0.0
    for s in range(last + 1, SLICES):
        above += rows[s, 0] + rows[s, 1] + rows[s, 2]
    out[k + 13] = above / max(above + inside, 1.0)
    out[k + 14] = absent / max(present + absent, 1.0)
    out[k + 15] = np.log(1.0 + inside / some)
    out[k + 16], out[k + 17], out[k + 18] = _widths(rows, 1, min(last + 1, SLICES))
    out[k + 19] = last * SLICE / max(out[k + 6], SLICE)
    _circle(rows, last, out[k + 20 : k + 23])
    out[k + 23], out[k + 24], _ = _widths(rows, last + 1, SLICES)
    out[k + 25] = rows[1:HIGH, 3].sum()
    for b in range(4):
        _nearer(rows, BANDS[b, 0], BANDS[b, 1], out[k + 26 + b : k + 31 + b : 4])


@compiled
def _rays(rows: Float, met: Int32, passed: Int32, last: int, out: Float) -> None:
    """Write into `out` the features of rays: for each band the share of rays that ended at the column, UNSEEN
    if there are no rays; the height of the slices without returns that rays passed, from the clean slices up
    to the next return, and above the highest return; the height up to which there are rays; and the gap
    between the clean slices and the next return [m]. Without a next return, the first height has no upper
    limit, and the gap is the height from the highest return up to the highest slice with rays. Slice 0 is
    not read.

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE); a slice has a return if its first value, the
            returns at the axis, is above 0.
        met, passed: Rays by slice that ended at the column and that passed it, shape (SLICES,).
        last: Last clean slice.
        out: Shares by band, then the four lengths, shape (bands + 4,).
    """
    n = BANDS.shape[0]
    for b in range(n):
        ended, went = 0.0, 0.0
        for s in range(BANDS[b, 0], BANDS[b, 1]):
            ended += met[s]
            went += passed[s]
        out[b] = ended / (ended + went) if ended + went > 0.0 else UNSEEN
    free, above, seen, top = 0, 0, 0, 0
    gap = -1
    for s in range(1, SLICES):
        if rows[s, 0] > 0.0:
            top, above = s, 0
            if s > last and gap < 0:
                gap = s - last - 1
        elif passed[s] > 0:
            above += 1
            free += s > last and gap < 0
        if met[s] + passed[s] > 0:
            seen = s
    out[n] = free * SLICE
    out[n + 1] = above * SLICE
    out[n + 2] = seen * SLICE
    out[n + 3] = (gap if gap >= 0 else max(seen - top, 0)) * SLICE


@compiled
def _nearer(rows: Float, first: int, end: int, out: Float) -> None:
    """Write into `out`, shape (2,), the share of the returns within 0.9 m that is within 0.45 m, UNSEEN
    without returns within 0.45 m; and the share of the latter that is at the axis, UNSEEN without returns at
    the axis.

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE).
        first, end: First slice, and one past the last slice.
        out: Filled with both shares.
    """
    inside, near, ring = 0.0, 0.0, 0.0
    for s in range(first, end):
        inside += rows[s, 0]
        near += rows[s, 0] + rows[s, 1]
        ring += rows[s, 2]
    out[0] = near / (near + ring) if near > 0.0 else UNSEEN
    out[1] = inside / near if inside > 0.0 else UNSEEN


@compiled
def _widths(rows: Float, first: int, end: int) -> tuple[float, float, float]:
    """Return the mean standard deviations of the inside of slices across and along its long side [m], and the
    relative variation of the width. Only slices with two voxels or more count; without any, the standard
    deviations are UNSEEN and the variation is 0.

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE).
        first, end: First slice, and one past the last slice.
    """
    xx, xy, yy, n, total, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(first, end):
        if rows[s, 3] >= 2.0:
            n += 1.0
            xx += rows[s, 8]
            xy += rows[s, 9]
            yy += rows[s, 10]
            wide = np.sqrt(max(rows[s, 8] + rows[s, 10], 0.0))
            total += wide
            squares += wide * wide
    some = max(n, 1.0)
    uneven = np.sqrt(max(squares / some - (total / some) ** 2, 0.0)) / max(total / some, 0.01)
    if n == 0.0:
        return UNSEEN, UNSEEN, uneven
    middle, half = 0.5 * (xx + yy) / some, np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy) / some
    return np.sqrt(max(middle - half, 0.0)), np.sqrt(max(middle + half, 0.0)), uneven


@compiled
def _circle(rows: Float, last: int, out: Float) -> None:
    """Write into `out` the radius of the circle through the returns of all clean slices, at most 1 [m], the
    rms distance of the returns from the circle [m], and this distance divided by the radius; all UNSEEN if
    there are fewer than six returns or the fit fails (Kasa 1976: z + B x + C y + D = 0 by least squares).

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE); slices 1 to `last` that are clean are used.
        last: Last slice.
        out: Filled with the three values, shape (3,).
    """
    m = np.zeros(9)
    for s in range(1, min(last + 1, SLICES)):
        if rows[s, 0] >= CLEAN * (rows[s, 0] + rows[s, 1] + rows[s, 2]):
            m += rows[s, ARC : ARC + 9]
    out[:] = UNSEEN
    if m[0] < 6.0:
        return
    m /= m[0]
    x, y, z = m[1], m[2], m[3] + m[5]
    xx, xy, yy = m[3] - x * x, m[4] - x * y, m[5] - y * y
    xz, yz, zz = m[6] - x * z, m[7] - y * z, m[8] - z * z
    det = xx * yy - xy * xy
    if det < 1e-12:
        return
    B, C = -(yy * xz - xy * yz) / det, -(xx * yz - xy * xz) / det
    D = -(z + B * x + C * y)
    square = 0.25 * (B * B + C * C) - D
    if square <= 1e-6:
        return
    radius = np.sqrt(square)
    misfit = zz + 2.0 * (B * xz + C * yz) + B * B * xx + 2.0 * B * C * xy + C * C * yy
    out[0] = min(radius, 1.0)
    out[1] = np.sqrt(max(misfit, 0.0)) / (2.0 * radius)
    out[2] = out[1] / out[0]


@compiled
def _band(rows: Float, first: int, end: int, out: Float) -> None:
    """Write into `out`, shape (3,), for the slices of a band the share with returns at the axis, the share of
    the returns that is at the axis (UNSEEN if none is), and the share of the octants of the ring without
    returns.

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE).
        first, end: First slice, and one past the last slice.
        out: Filled with the shares.
    """
    inside, around, filled, octants = 0.0, 0.0, 0.0, 0.0
    for s in range(first, end):
        inside += rows[s, 0]
        around += rows[s, 1] + rows[s, 2]
        filled += rows[s, 0] > 0.0
        octants += rows[s, 4]
    out[0] = filled / (end - first)
    out[1] = inside / (inside + around) if inside > 0.0 else UNSEEN
    out[2] = 1.0 - octants / (8.0 * (end - first))


@compiled
def _stem(rows: Float) -> tuple[int, int, int, int, int]:
    """Return the lowest slice with a return, the first and the last clean slice of the run (see `_run`), the
    number of clean slices in the run, and the highest slice with a return. Slice 0 is not used. If there are
    no returns, lowest is SLICES and highest 0.

    If no slice is clean with the returns in the ring, the run is that with the share CLEAN_NEAR and without
    the ring.
    """
    bottom, top = SLICES, 0
    for s in range(1, SLICES):
        if rows[s, 0] > 0.0:
            bottom = min(bottom, s)
            top = s
    first, last, clean = _run(rows, CLEAN, 1.0)
    if clean == 0:
        first, last, clean = _run(rows, CLEAN_NEAR, 0.0)
    return bottom, first, last, clean, top


@compiled
def _run(rows: Float, part: float, ring: float) -> tuple[int, int, int]:
    """Return the first and the last clean slice of the lowest run, and the number of clean slices in it;
    SLICES, 0 and 0 if there is none.

    A slice is clean if enough of its returns are at the axis. The run ends at a gap of more than GAP slices.

    Args:
        rows: Profile of the column, shape (SLICES, PROFILE); slice 0 is not used.
        part: Minimum share of the returns that is at the axis.
        ring: Weight of the returns in the ring.
    """
    first, last, clean = SLICES, 0, 0
    for s in range(1, SLICES):
        at_axis = rows[s, 0] >= part * (rows[s, 0] + rows[s, 1] + ring * rows[s, 2])
        if rows[s, 0] > 0.0 and at_axis and (clean == 0 or s - last <= GAP + 1):
            first = min(first, s)
            last = s
            clean += 1
    return first, last, clean
