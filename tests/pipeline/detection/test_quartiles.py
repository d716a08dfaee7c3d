"""The initial estimate of a trunk by quartiles."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.cylinder_fit import middle_half


@given(st.floats(-3.1, 3.1), st.floats(2.0, 20.0), st.floats(-0.2, 0.2), st.integers(0, 9))
def test_the_initial_estimate_turns_with_the_trunk(bearing, distance, lean, seed):
    """The front of a flat trunk is its median return, in any direction."""
    rng = np.random.default_rng(seed)
    offset, height = rng.uniform(-0.2, 0.3, 41), rng.uniform(-1.0, 1.0, 41)
    x, y = distance, offset + lean * height
    away = np.hypot(x, y)
    turned = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
    direction = turned @ np.stack([x / away, y / away])
    rays = np.vstack([direction, away, height])
    found = middle_half(rays, 41, *(turned @ [0.0, lean]))
    place = turned.T @ [found.x, found.y]
    np.testing.assert_allclose(place[1], np.median(offset), atol=0.02)
    np.testing.assert_allclose(place[0], distance, atol=0.01)
    np.testing.assert_allclose(found.radius, np.subtract(*np.quantile(offset, [0.75, 0.25])), rtol=0.05)
