"""How finely places are told that are gathered over many scans.

What a scan leaves to the gathering and to the height map is rounded where it is made, for the map and for the
map made again alike: so it can be kept in few bytes, and what is kept is what was seen, to the bit. The steps
are powers of two, so that no number of them is rounded again.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

POINT = 1.0 / 256  # m, of a return: errs by 1.1 mm where the range of a sensor errs by 10 to 30
GROUND = 1.0 / 1024  # m, of the ground's height

T = TypeVar("T", np.float32, np.float64)


def rounded(values: NDArray[T], step: float) -> NDArray[T]:
    """To the nearest multiple of a step that is a power of two; of the same kind."""
    kind = values.dtype.type
    told: NDArray[T] = np.rint(values * kind(1.0 / step)) * kind(step) + kind(0.0)  # and no -0
    return told
