"""Which cluster a click meant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

NEAR = 0.5  # m; a ray that passes the marker it hit farther than this hit the marker of another scan


def meant(
    origin: Float, direction: Float, low: Float, high: Float, radius: Float, instance: int | None
) -> int | None:
    """The upright cylinder that a ray was aimed at.

    While a run plays, the picture in the browser is some scans older than the one known here, and its
    numbers name other clusters; then the cylinder that the ray passes nearest is meant.

    Args:
        origin, direction: Of the ray, shape (3,), any length.
        low, high: Foot and top of each axis, shape (K, 3) [m]; radius: shape (K,) [m].
        instance: Which one the browser says was hit.

    Returns:
        Its row; None where none is near.
    """
    if not len(radius):
        return None
    gap = distances(origin, direction, low, high) - radius
    if instance is not None and 0 <= instance < len(radius) and gap[instance] <= 0.05:
        return instance
    best = int(np.argmin(gap))
    return best if gap[best] <= NEAR else None


def distances(origin: Float, direction: Float, low: Float, high: Float) -> Float:
    """How near a ray passes to each segment from `low` to `high`, shape (K,) [m]."""
    d = direction / max(float(np.linalg.norm(direction)), 1e-12)
    axis, away = high - low, low - origin
    # Closest points of two lines: s along the segment within 0..1, t along the ray not behind its origin.
    aa, ad = np.einsum("ij,ij->i", axis, axis), axis @ d
    da, dd = np.einsum("ij,ij->i", axis, away), away @ d
    flat = np.maximum(aa - ad**2, 1e-12)
    s = np.clip((ad * dd - da) / flat, 0.0, 1.0)
    t = np.maximum(dd + s * ad, 0.0)
    s = np.clip((t * ad - da) / np.maximum(aa, 1e-12), 0.0, 1.0)
    nearest: Float = np.linalg.norm(away + s[:, None] * axis - t[:, None] * d, axis=1)
    return nearest
