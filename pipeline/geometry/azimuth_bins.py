"""Azimuth bins: sectors around the sensor without an arctangent, fast enough for every point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled

Int = NDArray[np.int64]


@compiled
def direction_turn(x: float, y: float) -> float:
    """Return the direction of a finite vector (x, y) as a share of a revolution, 0 to 1, counter-clockwise
    from -x (0) over -y (0.25), +x (0.5) and +y (0.75).

    It is uniform along the diamond |x| + |y| = 1 instead of the circle, which needs no arctangent. The origin
    counts as the direction +x.
    """
    length = abs(x) + abs(y)
    if length == 0.0:
        return 0.5
    side = y / length
    turn = 1.0 + side if x >= 0.0 else (-1.0 - side if y < 0.0 else 3.0 - side)
    # turn runs from -1 (-x, coming from -y) over 0 (-y), 1 (+x), 2 (+y) to 3 (-x).
    return float((turn + 1.0) * 0.25)


@compiled
def direction_bin(x: float, y: float, bins: int) -> int:
    """Return the index, 0 to bins - 1, of the sector around the origin that contains the direction of a
    finite vector (x, y). Sectors are counted counter-clockwise from -x over -y, +x and +y.

    The sectors divide the diamond of `direction_turn`; the widest is twice as wide as the narrowest. The
    origin counts as the direction +x.
    """
    return min(int(np.floor(direction_turn(x, y) * bins)), bins - 1)


def direction_bins(place: Float, bins: int) -> Int:
    """Return `direction_bin` of each vector (x, y), shape (N, 2), int64, shape (N,)."""
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
