"""Points along the path of a robot, an arc of constant curvature."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float

_STRAIGHT = 1e-6  # 1/m; a smaller curvature counts as straight


def along_arc(s: Float, left: float | Float, curvature: float, backward: bool) -> Float:
    """Return points beside the path ahead of a robot, shape (N, 2) [m], in the level base frame.

    Args:
        s: Distances along the path from the base, shape (N,) [m].
        left: Distance to the left of the path [m], scalar or shape (N,).
        curvature: Curvature of the path [1/m], positive to the left; below 1e-6 the path is straight.
        backward: Whether the robot drives backward; then x is negated.
    """
    if abs(curvature) < _STRAIGHT:
        x, y = s, np.zeros_like(s) + left
    else:
        radius, angle = 1.0 / curvature, s * curvature
        x, y = (radius - left) * np.sin(angle), radius - (radius - left) * np.cos(angle)
    return np.column_stack([-x if backward else x, y])
