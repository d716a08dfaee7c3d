"""What the columns of a cloud are called and mean, in PointCloud2 messages and PCD files alike."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

REFLECTANCE = ("intensity", "intensities", "reflectivity", "reflectance", "i")
RING = ("ring", "channel", "laser_id", "line")
TIME = ("t", "time", "timestamp", "time_offset", "offset_time")
RING_LIMIT = 1024
OFFSET_LIMIT_NS = 2_000_000_000


def first_of(
    columns: Mapping[str, NDArray[np.generic]], names: tuple[str, ...]
) -> NDArray[np.generic] | None:
    """The column with the first of these names that is there, None when none is."""
    return next((columns[name] for name in names if name in columns), None)


def is_ring(ring: NDArray[np.generic]) -> bool:
    """Whether a column numbers lasers: whole numbers from 0 to less than RING_LIMIT."""
    if ring.dtype.kind not in "iu" or not len(ring):
        return False
    return int(ring.min()) >= 0 and int(ring.max()) < RING_LIMIT


def point_offsets(time: NDArray[np.generic], stamp_ns: int) -> NDArray[np.int64] | None:
    """Times of points relative to the stamp [ns], shape (N,), or None when they make no sense.

    Integers are nanoseconds; floating numbers are seconds after the stamp, or since 1970 in the unit
    that their size tells. Times that do not lie within 2 s of the stamp make no sense.
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
    return ns if int(np.abs(ns).max()) <= OFFSET_LIMIT_NS else None


def _unit(largest: float) -> float | None:
    """Seconds in one unit of times since 1970, None when they are relative."""
    for limit, unit in ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0)):
        if largest > limit:
            return unit
    return None
