"""Extraction of columns: axis, lean and circle of a trunk are recovered; flat and low objects give no
column."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.classification.column_extraction import OCTANTS, PROFILE, examine
from pipeline.classification.features import COUNT, NAMES, features
from pipeline.classification.voxel_map import SLICES, TILE, VoxelMap
from tests.pipeline.classification.clouds import bush, trunk

LOW = np.zeros(2)


def examined(points):
    memory = VoxelMap.empty()
    memory.add(points, 0, 1 << 18)
    mean, returns = memory.around(np.array([0, 0]), 1.2)
    return examine(mean, returns, LOW, TILE)


def figures_of(axis, profiles, met=None, passed=None):
    out = np.empty((len(axis), COUNT))
    seen = np.full(len(axis), 5.0)
    none = np.zeros((len(axis), SLICES), np.int32)
    met, passed = none if met is None else met, none if passed is None else passed
    features(axis, profiles, seen, np.ones(len(axis)), np.zeros(len(axis)), met, passed, out)
    return out


@pytest.mark.parametrize("radius", [0.06, 0.12, 0.2])
@pytest.mark.parametrize("lean", [0.0, 0.08])
def test_a_trunk_is_found_with_its_axis_and_lean(radius, lean):
    axis, profiles = examined(trunk(2.03, 1.52, radius, lean=lean))
    assert len(axis) >= 1
    nearest = np.hypot(*(axis[:, :2] - [2.03, 1.52]).T).argmin()
    assert axis[nearest, :2] == pytest.approx([2.03, 1.52], abs=0.03)
    assert axis[nearest, 2:4] == pytest.approx([lean, 0.0], abs=0.02)
    figures = dict(zip(NAMES, figures_of(axis, profiles)[nearest], strict=True))
    assert figures["alone 0.8-1.4 m"] == 1.0
    assert figures["ring open 0.8-1.4 m"] == 1.0
    assert figures["filled 0.8-1.4 m"] == 1.0
    assert figures["tilt"] == pytest.approx(lean, abs=0.02)
    assert figures["highest return"] == pytest.approx(3.8)
    assert figures["headroom"] == pytest.approx(1.2)


def test_the_profile_counts_every_return_once():
    points = trunk(2.0, 2.0, 0.1)
    axis, profiles = examined(points)
    assert profiles.shape == (len(axis), SLICES, PROFILE)
    best = np.hypot(*(axis[:, :2] - 2.0).T).argmin()
    assert profiles[best, :, :3].sum() == len(points)
    assert (profiles[:, :, 4] <= OCTANTS).all()


def test_leaves_fill_the_ring_of_a_bush():
    axis, profiles = examined(bush(2.0, 2.0, 0.8))
    alone = figures_of(axis, profiles)[:, NAMES.index("alone 0.2-0.8 m")]
    assert alone.max() < 0.5


def test_nothing_and_what_is_low_have_no_column():
    assert len(examined(np.zeros((0, 3), np.float32))[0]) == 0
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 4, (5000, 2)), rng.uniform(0, 0.3, 5000)]).astype(np.float32)
    assert len(examined(ground)[0]) == 0
    assert len(examined(np.repeat(np.array([[1.0, 1.0, 1.0]], np.float32), 10, axis=0))[0]) == 0


def test_the_margin_belongs_to_the_neighbours():
    assert len(examined(trunk(-0.5, 2.0, 0.1))[0]) == 0


@pytest.mark.parametrize("radius", [0.08, 0.15, 0.25])
def test_the_circle_through_the_slices_is_the_trunk(radius):
    axis, profiles = examined(trunk(2.03, 1.52, radius))
    nearest = np.hypot(*(axis[:, :2] - [2.03, 1.52]).T).argmin()
    figures = dict(zip(NAMES, figures_of(axis, profiles)[nearest], strict=True))
    assert figures["radius"] == pytest.approx(radius, abs=0.02)
    assert figures["residual"] < 0.03
    assert figures["residual of the radius"] == pytest.approx(figures["residual"] / figures["radius"])


def test_leaves_lie_on_no_circle():
    axis, profiles = examined(bush(2.0, 2.0, 0.35))
    figures = figures_of(axis, profiles)[:, NAMES.index("residual")]
    assert figures.max() > 0.05


def test_a_plate_above_the_clean_slices_is_flat():
    post = trunk(2.0, 2.0, 0.04, top=1.4)
    rng = np.random.default_rng(0)
    side, up = rng.uniform(-0.85, 0.85, 3000), rng.uniform(1.6, 2.4, 3000)
    plate = np.stack([np.full(3000, 2.0), 2.0 + side, up], axis=1).astype(np.float32)
    axis, profiles = examined(np.concatenate([post, plate]))
    nearest = np.hypot(*(axis[:, :2] - 2.0).T).argmin()
    figures = dict(zip(NAMES, figures_of(axis, profiles)[nearest], strict=True))
    assert figures["thick above"] < 0.02
    assert figures["wide above"] > 0.1


def test_no_axis_is_examined_twice():
    axis, _ = examined(trunk(2.03, 1.52, 0.15))
    apart = np.abs(axis[:, None, :2] - axis[None, :, :2]).max(axis=2)
    assert (apart[~np.eye(len(axis), dtype=bool)] >= 0.02).all()


def test_a_thick_neighbour_does_not_hide_that_a_thin_stem_stands_alone():
    thin, thick = trunk(2.0, 2.0, 0.05), trunk(2.7, 2.0, 0.2)
    axis, profiles = examined(np.concatenate([thin[::8], thick, thick]))
    nearest = np.hypot(*(axis[:, :2] - 2.0).T).argmin()
    figures = dict(zip(NAMES, figures_of(axis, profiles)[nearest], strict=True))
    assert figures["alone 0.8-1.4 m"] < 0.4
    assert figures["alone within 0.45 m 0.8-1.4 m"] > 0.95
    assert figures["clean slices"] >= 15
    assert figures["voxels to 3 m"] > 6
