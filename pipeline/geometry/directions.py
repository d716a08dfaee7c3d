"""The sectors of `pipeline.geometry.azimuth_bins` for arrays. The web process uses them, and starts without
Numba."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float

Int = NDArray[np.int64]


def direction_bins(place: Float, bins: int) -> Int:
    """Return `azimuth_bins.direction_bin` of each vector (x, y), shape (N, 2), int64, shape (N,)."""
    x, y = place.T
    length = np.abs(x) + np.abs(y)
    side = np.divide(y, length, out=np.zeros(len(place)), where=length > 0.0)
    turn = np.where(x >= 0.0, 1.0 + side, np.where(y < 0.0, -1.0 - side, 3.0 - side))
    sectors: Int = np.minimum(np.floor((turn + 1.0) * 0.25 * bins).astype(np.int64), bins - 1)
    return sectors


def bin_direction(k: int, bins: int) -> tuple[float, float]:
    """Return the unit vector x, y to the middle of sector k of `bins`; k is taken modulo `bins`.

    The sectors are those of `direction_bin`: they begin at -x and run over -y, +x and +y, and are not equally
    wide, because they divide a diamond and not a circle. `direction_bin` of the result is k modulo `bins`.
    """
    along = 4.0 * ((k % bins + 0.5) / bins) - 1.0
    side = along - 1.0 if 0.0 <= along <= 2.0 else (-1.0 - along if along < 0.0 else 3.0 - along)
    x = (1.0 - abs(side)) * (1.0 if 0.0 <= along <= 2.0 else -1.0)
    length = float(np.hypot(x, side))
    return x / length, side / length
