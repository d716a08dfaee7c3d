"""From a decoder's columns to a Scan: what is not a return is left out and counted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Float32, Int32, Scan

#: Most points that one scan may have; a 128-ring sensor at 5 Hz gives 480,000.
POINT_LIMIT = 16_000_000
#: No LiDAR sees farther; such a number is a damaged one, and it would overflow in the stages.
RANGE_LIMIT = 10_000.0
#: Drivers write (0, 0, 0) for a beam without a return; nothing real is seen at 1 mm.
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
    """Make a Scan of points of shape (N, 3) [m] and their columns of shape (N,).

    Rows that are not finite, beyond 10 km, or at the origin are no returns: they are left out and
    added to `dropped`.
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
    if values is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        column = np.ascontiguousarray(values, dtype=np.float32)
    return np.nan_to_num(column, copy=False) if not np.isfinite(column).all() else column


def _as_int(values: NDArray[np.generic] | None) -> Int32 | None:
    return None if values is None else np.ascontiguousarray(values, dtype=np.int32)
