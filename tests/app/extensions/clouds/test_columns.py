"""Chains of circles and upright columns of a whole cloud."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.clouds.inventory.cross_sections import find_columns, strongest_first
from app.extensions.clouds.inventory.stem_model import STEM, is_repeated
from app.extensions.clouds.terrain_raster import TerrainRaster
from pipeline.types.records import Verdict
from tests.pipeline.plots import stem


@pytest.mark.slow
def test_a_column_is_found_in_a_cloud_of_more_than_a_million_voxels():
    """The column comes first; a full voxel map drops the voxels that were added first."""
    rng = np.random.default_rng(0)
    column = stem(-5.0, -5.0, 0.12, rng, height=6.0)
    column = np.column_stack([column, column[:, 2] - column[:, 2].min()])
    side = np.arange(1100) * 0.1 + 0.05
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    grass = np.column_stack([x, y, np.full(len(x), 0.3), np.full(len(x), 0.3)])
    assert len(grass) > 1 << 20
    raster = TerrainRaster(
        np.zeros(2), 110.0, np.zeros((1, 1)), np.ones((1, 1), np.bool_), np.ones((1, 1), np.bool_)
    )
    points = np.concatenate([column, grass]).astype(np.float32)
    axes, _, _ = strongest_first(list(find_columns(points, raster, np.full((1, 1), 6.0))))
    away = np.hypot(*(axes[:, :2] - (-5.0, -5.0)).T)
    assert away.min() < 0.2


def test_stems_without_a_model_are_repeated_only_at_the_same_place():
    """Columns at x, with the radius (NaN if unknown) and the number of slices of their stems."""
    nan = np.nan
    rows = [(0.0, 0.2, 20), (0.05, nan, 1), (4.0, nan, 1), (8.0, nan, 0), (4.0, nan, 0)]
    stems = np.full(len(rows), nan, STEM)
    axes = np.zeros((len(rows), 5))
    for k, (x, radius, slices) in enumerate(rows):
        axes[k, 0], stems[k]["slices"] = x, slices
        if np.isfinite(radius):
            stems[k] = (x, 0.0, 0.0, 0.0, radius, *[0.0] * 6, 0.4, 6.0, slices, *[0.0] * 6)
    verdict = np.full(len(rows), Verdict.TOO_FEW_POINTS, np.int32)
    verdict[0] = Verdict.TREE
    assert is_repeated(stems, axes, verdict).tolist() == [False, True, False, False, True]
    assert is_repeated(stems[:0], axes[:0], verdict[:0]).tolist() == []
