"""Rays against solids: closed forms, and the slow reference for all others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.simulation.primitives import BOX, CONE, ELLIPSOID, SolidsBuilder
from pipeline.simulation.ray_casting import (
    ground_incidence,
    meet_box,
    meet_cone,
    meet_ellipsoid,
    meet_ground,
    solid_incidence,
    waves_at,
)
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float
from tests.pipeline.simulation import oracle

SEEDS = st.integers(0, 2**32 - 1)


def random_rays(rng: np.random.Generator, count: int = 400) -> tuple[Float, Float]:
    origin = rng.uniform(-6.0, 6.0, (count, 3))
    target = rng.uniform(-1.2, 1.2, (count, 3))
    d = target - origin
    return origin, d / np.linalg.norm(d, axis=1)[:, None]


def ground_range(terrain: SimulatedTerrain, o: Float, d: Float, farthest: float = 100.0) -> float:
    waves, space = np.empty((terrain.packed.shape[0], 3)), np.empty(terrain.packed.shape[0])
    waves_at(terrain.packed, o, waves)
    return meet_ground(terrain.packed, waves, d, farthest, space)


def test_upright_cylinder_is_met_at_distance_less_radius():
    builder = SolidsBuilder()
    builder.cone(0, [5.0, 0.0, -1.0], [5.0, 0.0, 1.0], (0.2, 0.2))
    shape = builder.build().shape[0]
    assert meet_cone(shape, np.zeros(3), np.array([1.0, 0.0, 0.0])) == pytest.approx(4.8)
    assert meet_cone(shape, np.zeros(3), np.array([-1.0, 0.0, 0.0])) == np.inf
    assert meet_cone(shape, np.zeros(3), np.array([0.0, 0.0, 1.0])) == np.inf


def test_beam_at_the_tangent_of_a_cylinder():
    builder = SolidsBuilder()
    builder.cone(0, [5.0, 0.0, -1.0], [5.0, 0.0, 1.0], (0.2, 0.2))
    shape = builder.build().shape[0]
    edge = np.arcsin(0.2 / 5.0)
    inside, outside = edge - 1e-6, edge + 1e-6
    assert meet_cone(shape, np.zeros(3), np.array([np.cos(inside), np.sin(inside), 0.0])) < 5.0
    assert meet_cone(shape, np.zeros(3), np.array([np.cos(outside), np.sin(outside), 0.0])) == np.inf


@given(SEEDS)
def test_cones_agree_with_the_oracle(seed):
    rng = np.random.default_rng(seed)
    builder = SolidsBuilder()
    start = rng.uniform(-1.0, 1.0, 3)
    end = start + rng.uniform(0.3, 1.0, 3) * rng.choice([-1.0, 1.0], 3)
    radius = float(rng.uniform(0.05, 0.6))
    builder.cone(0, start, end, (radius, radius * float(rng.uniform(0.9, 1.0))))
    shape = builder.build().shape[0]
    o, d = random_rays(rng)
    ours = np.array([meet_cone(shape, a, b) for a, b in zip(o, d, strict=True)])
    slow = oracle.cone_range(shape, o, d)
    both = np.isfinite(ours) & np.isfinite(slow)
    np.testing.assert_allclose(ours[both], slow[both], rtol=0, atol=1e-7)
    # They may differ only where a ray just grazes the mantle or its end.
    assert np.sum(np.isfinite(ours) != np.isfinite(slow)) <= 1


@given(SEEDS)
def test_ellipsoids_and_boxes_agree_with_the_oracle(seed):
    rng = np.random.default_rng(seed)
    builder = SolidsBuilder()
    half = rng.uniform(0.2, 1.0, 3)
    builder.ellipsoid(0, rng.uniform(-1.0, 1.0, 3), half, yaw=float(rng.uniform(0.0, 3.0)))
    builder.box(0, rng.uniform(-1.0, 1.0, 3), half, yaw=float(rng.uniform(0.0, 3.0)))
    ellipsoid, box = builder.build().shape
    o, d = random_rays(rng)
    outside = [np.abs(oracle.to_local(shape, o, d)[0]).max(axis=1) > 1.0 for shape in (ellipsoid, box)]
    ours = np.array([meet_ellipsoid(ellipsoid, a, b)[0] for a, b in zip(o, d, strict=True)])
    ours = np.where(ours > 0.0, ours, np.inf)
    slow = oracle.ellipsoid_range(ellipsoid, o, d)
    np.testing.assert_allclose(ours[outside[0]], slow[outside[0]], rtol=0, atol=1e-6)
    ours = np.array([meet_box(box, a, b) for a, b in zip(o, d, strict=True)])
    np.testing.assert_allclose(ours[outside[1]], oracle.box_range(box, o, d)[outside[1]], rtol=0, atol=1e-9)


def test_flat_ground_is_met_at_height_over_sine():
    terrain = SimulatedTerrain(np.zeros((1, 4)))
    for degrees in (1.0, 5.0, 15.0, 89.0):
        down = np.radians(degrees)
        d = np.array([np.cos(down), 0.0, -np.sin(down)])
        expected = 0.8 / np.sin(down)
        assert ground_range(terrain, np.array([3.0, 2.0, 0.8]), d) == pytest.approx(expected)
        assert ground_incidence(terrain.packed, np.zeros(3), d, expected) == pytest.approx(np.sin(down))
    assert ground_range(terrain, np.array([0.0, 0.0, 0.8]), np.array([1.0, 0.0, 0.0])) == np.inf
    assert ground_range(terrain, np.array([0.0, 0.0, 0.8]), np.array([0.6, 0.0, 0.8])) == np.inf


def test_plane_of_ten_degrees_is_met_uphill():
    slope = np.tan(np.radians(10.0))
    terrain = SimulatedTerrain(np.array([[slope, 0.0, 0.0, 0.0]]))
    got = ground_range(terrain, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    assert got == pytest.approx(1.0 / slope)


@pytest.mark.parametrize("seed", range(4))
def test_rolling_ground_agrees_with_fine_steps(seed):
    rng = np.random.default_rng(seed)
    terrain = SimulatedTerrain.grow(float(rng.uniform(0.0, 0.3)), 0.35, 8.0, rng)
    o = rng.uniform(-20.0, 20.0, (150, 3))
    o[:, 2] = terrain.height(o[:, 0], o[:, 1]) + rng.uniform(0.4, 2.0, 150)
    azimuth, up = rng.uniform(0.0, 2.0 * np.pi, 150), np.radians(rng.uniform(-18.0, 18.0, 150))
    d = np.stack([np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1)
    ours = np.array([ground_range(terrain, a, b, 60.0) for a, b in zip(o, d, strict=True)])
    slow = oracle.ground_ranges(terrain, o, d, 60.0)
    assert np.isfinite(slow).sum() > 40
    np.testing.assert_array_equal(np.isfinite(ours), np.isfinite(slow))
    both = np.isfinite(slow)
    hits = o[both] + ours[both, None] * d[both]
    np.testing.assert_allclose(hits[:, 2], terrain.height(hits[:, 0], hits[:, 1]), atol=2e-4)
    # Where a ray grazes a crest, a height of 0.1 mm is a long way along the ray.
    assert np.median(np.abs(ours[both] - slow[both])) < 1e-3


def test_terrain_gradient_is_that_of_its_height():
    rng = np.random.default_rng(3)
    terrain = SimulatedTerrain.grow(0.2, 0.3, 9.0, rng)
    x, y = rng.uniform(-30.0, 30.0, (2, 200))
    z, gx, gy = terrain.evaluate(x, y).T
    step = 1e-4
    # The polynomial's seams show as 1e-5 in the slope.
    np.testing.assert_allclose((terrain.height(x + step, y) - z) / step, gx, atol=2e-4)
    np.testing.assert_allclose((terrain.height(x, y + step) - z) / step, gy, atol=2e-4)
    assert terrain.height(np.zeros(1), np.zeros(1))[0] == pytest.approx(0.0, abs=1e-12)


def test_incidence_on_each_shape():
    builder = SolidsBuilder()
    builder.cone(0, [5.0, 0.0, -1.0], [5.0, 0.0, 1.0], (1.0, 1.0))
    builder.ellipsoid(0, [5.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    builder.box(0, [5.0, 0.0, 0.0], [1.0, 1.0, 1.0])
    shapes = builder.build().shape
    ahead = np.array([1.0, 0.0, 0.0])
    o = np.array([0.0, 0.6, 0.0])
    # The normal at height 0.6 of a unit circle makes an angle with cosine 0.8; a box's face faces us.
    for kind, shape, t, cosine in (
        (CONE, shapes[0], 4.2, 0.8),
        (ELLIPSOID, shapes[1], 4.2, 0.8),
        (BOX, shapes[2], 4.0, 1.0),
    ):
        assert solid_incidence(kind, shape, o, ahead, t) == pytest.approx(cosine)
