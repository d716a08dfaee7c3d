"""Chains of circles and upright columns of a whole cloud."""

from __future__ import annotations

import numpy as np

from pipeline.classification import package_alone
from pipeline.inventory.stem_model import (
    COLUMNS,
    FIRST,
    LAST,
    LEAN_X,
    LEAN_Y,
    RADIUS,
    SLICES,
    X,
    Y,
    is_repeated,
)
from pipeline.inventory.stem_tracing import find_upright
from pipeline.types.records import Verdict
from tests.pipeline.inventory.plots import stem


def test_a_column_is_found_in_a_cloud_of_more_than_a_million_voxels():
    """The column comes first; a full voxel map drops the voxels that were added first."""
    rng = np.random.default_rng(0)
    column = stem(-5.0, -5.0, 0.12, rng, height=6.0)
    column = np.column_stack([column, column[:, 2] - column[:, 2].min()])
    side = np.arange(1100) * 0.1 + 0.05
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    grass = np.column_stack([x, y, np.full(len(x), 0.3), np.full(len(x), 0.3)])
    assert len(grass) > 1 << 20
    places, _ = find_upright(
        np.concatenate([column, grass]).astype(np.float32), package_alone("package", True)
    )
    away = np.hypot(*(places - (-5.0, -5.0)).T)
    assert away.min() < 0.2


def stems(rows: list[tuple[float, float, float, int]]) -> np.ndarray:
    """Models of stems by x, y, radius and number of slices; NaN for an unknown radius."""
    out = np.full((len(rows), COLUMNS), np.nan)
    for k, (x, y, radius, slices) in enumerate(rows):
        out[k, [X, Y, SLICES]] = x, y, slices
        if np.isfinite(radius):
            out[k, [RADIUS, LEAN_X, LEAN_Y, FIRST, LAST]] = radius, 0.0, 0.0, 0.4, 6.0
    return out


def test_stems_without_a_model_are_repeated_only_at_the_same_place():
    nan = np.nan
    models = stems(
        [
            (0.0, 0.0, 0.2, 20),
            (0.05, 0.0, nan, 1),
            (4.0, 0.0, nan, 1),
            (8.0, 0.0, nan, 0),
            (nan, nan, nan, 0),
            (nan, nan, nan, 0),
        ]
    )
    verdict = np.full(len(models), Verdict.TOO_FEW_POINTS, np.int32)
    verdict[0] = Verdict.TREE
    assert is_repeated(models, verdict).tolist() == [False, True, False, False, False, False]
    assert is_repeated(models[:0], verdict[:0]).tolist() == []
