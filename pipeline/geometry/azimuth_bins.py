"""Azimuth bins: sectors around the sensor without an arctangent, fast enough for every point."""

from __future__ import annotations

import numpy as np

from pipeline.jit import compiled


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
