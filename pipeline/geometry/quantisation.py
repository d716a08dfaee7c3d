"""Quantisation of the data of a scan that is integrated over many scans.

It is applied in the front end, for a first run and for a rerun, so that the scan cache stores it in few bytes
without loss. The steps are powers of two, so that their multiples are exact.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

POINT = 1.0 / 256  # m; step of a return: a standard error of 1.1 mm, that of a sensor is 10 to 30 mm
GROUND = 1.0 / 1024  # m; step of a ground height

T = TypeVar("T", np.float32, np.float64)


def rounded(values: NDArray[T], step: float) -> NDArray[T]:
    """Return values rounded to the nearest multiple of `step`, with their type and shape; a value half-way
    between two multiples is rounded to the even one, and -0 becomes 0. NaN and infinity remain.

    Args:
        values: float32 or float64, any shape; not changed.
        step: A power of two.
    """
    kind = values.dtype.type
    result: NDArray[T] = np.rint(values * kind(1.0 / step)) * kind(step) + kind(0.0)  # + 0 turns -0 into 0
    return result
