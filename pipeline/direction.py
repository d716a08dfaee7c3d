"""Directions around the sensor, cheap enough to ask for every point."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled


@compiled
def direction_bin(x: float, y: float, bins: int) -> int:
    """Which of `bins` sectors around the origin the direction (x, y) lies in, from -x over -y on.

    The sectors are cut by the diamond |x| + |y| = 1 instead of the circle, which needs no
    arctangent; the widest is twice as wide as the narrowest. The origin counts as the direction +x.
    """
    length = abs(x) + abs(y)
    if length == 0.0:
        return bins // 2
    side = y / length
    turn = 1.0 + side if x >= 0.0 else (-1.0 - side if y < 0.0 else 3.0 - side)
    # turn runs from -1 (-x, coming from -y) over 0 (-y), 1 (+x), 2 (+y) to 3 (-x).
    return min(int(np.floor((turn + 1.0) * 0.25 * bins)), bins - 1)
