"""What a coordinate of a cloud is, and what is taken from all of them so that 32 bits hold the rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Float

COORDINATE_LIMIT = 1e8  # m


def is_place(xyz: Float) -> NDArray[np.bool_]:
    """Which rows of shape (N, 3) [m] are coordinates, shape (N,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.isfinite(xyz) & (np.abs(xyz) < COORDINATE_LIMIT)).all(axis=1))


def offset_for(middle: Float) -> Float:
    """The offset of a cloud by a place within it, shape (3,) [m]: whole hundreds near the points, so that
    nothing is lost and who reads the files can add it.
    """
    return np.where(np.abs(middle) < 1000.0, 0.0, np.round(middle / 100.0) * 100.0)
