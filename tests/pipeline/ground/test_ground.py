"""Ground of one scan: heights above planes of any slope, trunks, hedges and ghost echoes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.ground.scan_ground import (
    SECTORS,
    Terrain,
    find_terrain,
    height_above,
    heights_of_places,
    in_band,
    shows_ground,
)
from tests.pipeline.strategies import seeds

FOREST = preset("forest").ground
SENSOR_HEIGHT = 0.8


def _rings(slope_deg, uphill, *, field=np.pi):
    """Returns of a VLP-16 from a plane: where each of its rays meets the ground, within 25 m."""
    elevation = np.radians(np.arange(-15.0, 16.0, 2.0))
    azimuth = np.arange(-field, field, np.radians(0.4))
    e, a = (grid.ravel() for grid in np.meshgrid(elevation, azimuth))
    ray = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    rise = np.tan(np.radians(slope_deg))
    fall = rise * (ray[:, 0] * np.cos(uphill) + ray[:, 1] * np.sin(uphill)) - ray[:, 2]
    with np.errstate(divide="ignore"):
        reach = SENSOR_HEIGHT / fall
    ok = (fall > 1e-6) & (reach < 25.0)
    return (ray[ok] * reach[ok, None]).astype(np.float32)


@given(st.floats(0.0, 34.0), st.floats(-3.1, 3.1))
def test_ground_returns_of_any_plane_are_below_the_height_band(slope, uphill):
    points = _rings(slope, uphill)
    above = height_above(points, find_terrain(points, FOREST))
    near = np.hypot(points[:, 0], points[:, 1]) < 10.0
    assert np.abs(np.median(above[near])) < 0.15
    inside = (above[near] >= FOREST.height_min) & (above[near] <= FOREST.height_max)
    assert inside.mean() < 0.02, f"{inside.mean():.1%} of the ground stands in the band"


@pytest.mark.parametrize("height", [0.5, 1.0, 1.9])
@pytest.mark.parametrize("slope", [0.0, 12.0, 20.0])
def test_a_point_over_a_plane_has_its_height(slope, height):
    points = _rings(slope, 0.7)
    terrain = find_terrain(points, FOREST)
    raised = points + np.array([0.0, 0.0, height], np.float32)
    near = np.hypot(points[:, 0], points[:, 1]) < 8.0
    error = height_above(raised, terrain)[near] - height
    assert abs(np.median(error)) < 0.12
    assert np.abs(error).max() < 0.25 + np.tan(np.radians(slope))


@given(st.floats(0.0, 20.0), st.floats(-3.1, 3.1))
def test_a_plane_is_recognised_as_ground_and_heights_of_places_equal_those_of_points(slope, uphill):
    points = _rings(slope, uphill)
    terrain = find_terrain(points, FOREST)
    assert shows_ground(terrain)
    above = heights_of_places(points.astype(np.float64), terrain.height)
    np.testing.assert_allclose(above, height_above(points, terrain), atol=1e-3)


def test_level_ground_is_exact():
    points = _rings(0.0, 0.0)
    above = height_above(points, find_terrain(points, FOREST))
    np.testing.assert_allclose(above, 0.0, atol=1e-5)


@pytest.mark.parametrize("field", [0.6, 1.2])
@pytest.mark.parametrize("uphill", [0.0, np.pi])
def test_a_sensor_that_sees_one_side_only_finds_the_slope_there(field, uphill):
    points = _rings(8.0, uphill, field=field)
    above = height_above(points, find_terrain(points, FOREST))
    near = np.hypot(points[:, 0], points[:, 1]) < 8.0
    inside = (above[near] >= FOREST.height_min) & (above[near] <= FOREST.height_max)
    assert inside.mean() < 0.05


@pytest.mark.parametrize("slope", [0.0, 12.0])
@pytest.mark.parametrize("lowest", [0.0, 0.6])
def test_a_trunk_does_not_become_terrain(slope, lowest):
    ground = _rings(slope, 0.4)
    bearing = np.arctan2(ground[:, 1], ground[:, 0])
    behind = (np.abs(bearing) < 0.05) & (ground[:, 0] > 5.0)
    ground = ground[~behind]  # the trunk hides what lies behind it
    at = 5.0 * np.tan(np.radians(slope)) * np.cos(0.4) - SENSOR_HEIGHT
    z = np.arange(lowest, 2.5, 0.1)
    turn = np.linspace(2.0, 4.2, 20)
    t, z = (grid.ravel() for grid in np.meshgrid(turn, z))
    trunk = np.stack([5.0 + 0.2 * np.cos(t), 0.2 * np.sin(t), at + z], axis=1).astype(np.float32)
    terrain = find_terrain(np.concatenate([ground, trunk]), FOREST)
    assert np.abs(height_above(trunk, terrain) - z).max() < 0.25
    stays = in_band(trunk, height_above(trunk, terrain), FOREST)
    assert len(stays) > 0.9 * np.count_nonzero((z >= 0.3) & (z <= 2.0))


def test_a_return_below_the_ground_does_not_lower_the_surface():
    ground = _rings(0.0, 0.0)
    ghost = np.array([[4.2, 0.1, -2.5]], np.float32)
    terrain = find_terrain(np.concatenate([ground, ghost]), FOREST)
    np.testing.assert_allclose(height_above(ground, terrain), 0.0, atol=1e-5)


def test_the_terrain_is_not_steeper_than_the_maximum_slope():
    wall = np.array(
        [[x, y, z] for x in (5.0,) for y in np.arange(-2, 2, 0.1) for z in np.arange(0.5, 3, 0.1)]
    )
    points = np.concatenate([_rings(0.0, 0.0), wall.astype(np.float32)])
    terrain = find_terrain(points, FOREST)
    assert terrain.height.max() < -SENSOR_HEIGHT + 0.2


@pytest.mark.parametrize("points", [[], [[3.0, 0.0, -0.8]], [[0.0, 0.0, 1.0]] * 10])
def test_few_points_give_finite_heights(points):
    cloud = np.array(points, np.float32).reshape(-1, 3)
    above = height_above(cloud, find_terrain(cloud, FOREST))
    assert above.shape == (len(cloud),)
    assert np.all(np.isfinite(above))


def test_the_height_band_includes_its_limits():
    points = np.arange(15, dtype=np.float32).reshape(5, 3)
    height = np.array([0.29, 0.3, 1.0, 2.0, 2.01], np.float32)
    p = FOREST.model_copy(update={"height_min": float(np.float32(0.3)), "height_max": 2.0})
    np.testing.assert_array_equal(in_band(points, height, p), points[1:4])


def test_the_order_of_points_does_not_matter():
    points = _rings(10.0, 1.0)
    rows = np.random.default_rng(0).permutation(len(points))
    one = find_terrain(points, FOREST)
    other = find_terrain(points[rows], FOREST)
    np.testing.assert_allclose(one.height, other.height, atol=1e-9)  # sums are made in the points' order
    np.testing.assert_array_equal(one.seen, other.seen)


def test_a_hedge_on_a_hill_does_not_lift_the_ground():
    """A crown's underside 4 m up hides all of the ground in some directions; beside it the ground is seen."""
    points = _rings(10.0, np.pi)
    distance, turn = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
    hedge = (distance > 8.0) & (distance < 16.0) & (np.abs(turn) < np.radians(5.0))
    lifted = points.copy()
    lifted[hedge, 2] += 4.0
    above = height_above(lifted, find_terrain(lifted, FOREST))
    assert np.count_nonzero(hedge) > 15
    assert np.mean(above[hedge] > 2.0) > 0.5


def test_an_echo_far_below_the_ground_is_a_ghost():
    points = _rings(0.0, 0.0)
    near = np.flatnonzero((np.hypot(points[:, 0], points[:, 1]) > 4.0) & (points[:, 1] > 0.0))
    ghosts = points[near[::400]] - np.array([0.0, 0.0, 1.5], np.float32)
    with_ghosts = np.concatenate([points, ghosts])
    above = height_above(points, find_terrain(with_ghosts, FOREST))
    assert np.abs(above[np.hypot(points[:, 0], points[:, 1]) < 10.0]).max() < 0.3


@given(seeds, st.integers(1, 48))
def test_heights_of_many_points_are_those_of_each(seed, rings):
    random = np.random.default_rng(seed)
    nodes = random.normal(-1.0, 0.3, (SECTORS, rings))
    points = random.normal(0.0, random.uniform(0.1, 80.0), (200, 3)).astype(np.float32)
    points[:50] = np.round(points[:50])
    points[50:53, 0] = np.nan, np.inf, -np.inf
    above = height_above(points, Terrain(nodes, np.ones(nodes.shape, bool)))
    assert np.all(np.isnan(above[50:53]))
    known = np.delete(points, slice(50, 53), axis=0)
    wanted = heights_of_places(known.astype(np.float64), nodes)
    np.testing.assert_allclose(np.delete(above, slice(50, 53)), wanted, atol=2e-3)
