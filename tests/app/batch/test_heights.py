"""The height of the nearest terrain cell."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.batch.map_frame import heights_at


@pytest.mark.parametrize("scattered", [False, True])
def test_heights_are_those_of_the_nearest_cell(scattered: bool):
    rng = np.random.default_rng(2)
    key = np.unique(rng.integers(-20, 20, (700, 2)), axis=0)
    centres = rng.uniform(-10.0, 10.0, (400, 2)) if scattered else np.round((key + 0.5) * 0.5 + 0.123, 3)
    terrain = np.column_stack([centres, rng.normal(0.0, 1.0, len(centres))])
    points = rng.uniform(-15.0, 15.0, (5000, 2))
    distance, row = cKDTree(centres).query(points)
    np.testing.assert_array_equal(heights_at(terrain, points, np.inf), terrain[row, 2])
    near = heights_at(terrain, points, 1.0)
    np.testing.assert_array_equal(near, np.where(distance <= 1.0, terrain[row, 2], np.nan))
    assert np.isnan(heights_at(terrain[:0], points)).all()
