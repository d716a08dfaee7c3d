"""Figures of columns for tests of forests."""

from __future__ import annotations

import numpy as np

from pipeline.classification.features import COUNT, NAMES
from pipeline.geometry.poses import Float


def ending(top: float, free: float) -> Float:
    """The figures of a column that ends in free air, all others 0, shape (1, COUNT)."""
    figures = np.zeros((1, COUNT))
    figures[0, NAMES.index("highest return")] = top
    figures[0, NAMES.index("free above the highest return")] = free
    return figures
