"""Pass-through box and voxel grid against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.config import preset
from pipeline.preprocessing import pass_through, voxel_grid
from tests.pipeline.strategies import simulated_cloud

FOREST = preset("forest").filters
clouds = arrays.arrays(
    np.float32, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(-2, 2, width=32)
)


def _means_of_cubes(points, size):
    """The mean of each cube, cubes in the order of their first point."""
    cubes: dict[tuple[int, ...], list[int]] = {}
    for row, point in enumerate(points):
        cubes.setdefault(tuple(np.floor(point.astype(np.float64) / size).astype(int)), []).append(row)
    return np.array([points[rows].astype(np.float64).mean(axis=0) for rows in cubes.values()]).reshape(-1, 3)


@given(clouds, st.sampled_from([0.01, 0.05, 0.25, 1.0]))
def test_voxels_are_the_means_of_cubes(points, size):
    p = FOREST.model_copy(update={"voxel_size": size})
    np.testing.assert_allclose(voxel_grid(points, p), _means_of_cubes(points, size), atol=1e-6)


@given(clouds, st.randoms(use_true_random=False))
def test_the_order_of_points_does_not_matter(points, random):
    p = FOREST.model_copy(update={"voxel_size": 0.5})
    rows = list(range(len(points)))
    random.shuffle(rows)
    one, other = voxel_grid(points, p), voxel_grid(points[rows], p)
    assert len(one) == len(other)
    apart = np.abs(one[:, None] - other[None]).max(axis=2)
    if len(points):
        assert apart.min(axis=0).max() < 1e-5
        assert apart.min(axis=1).max() < 1e-5


def test_voxels_of_a_whole_scan_are_the_means_of_cubes():
    points = simulated_cloud()
    for size in (0.01, 0.2):
        p = FOREST.model_copy(update={"voxel_size": size})
        np.testing.assert_allclose(voxel_grid(points, p), _means_of_cubes(points, size), atol=1e-5)


def test_voxels_are_not_mirrored_at_zero():
    p = FOREST.model_copy(update={"voxel_size": 1.0})
    points = np.array([[-0.25, 0.5, 0.5], [0.25, 0.5, 0.5], [0.75, 0.5, 0.5]], np.float32)
    np.testing.assert_allclose(voxel_grid(points, p), [[-0.25, 0.5, 0.5], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_a_size_of_zero_or_a_tiny_size_returns_the_points(size):
    p = FOREST.model_copy(update={"voxel_size": size})
    points = np.array([[1, 2, 3], [1, 2, 3], [-4, 5, 6]], np.float32)
    np.testing.assert_array_equal(voxel_grid(points, p), points)


def test_an_empty_cloud_stays_empty():
    empty = np.zeros((0, 3), np.float32)
    assert voxel_grid(empty, FOREST).shape == (0, 3)
    assert pass_through(empty, FOREST).shape == (0, 3)


def test_a_thousand_equal_points_are_one():
    points = np.full((1000, 3), 1.1, np.float32)
    np.testing.assert_allclose(voxel_grid(points, FOREST), points[:1], atol=1e-6)


@given(clouds)
def test_the_box_equals_a_numpy_mask(points):
    p = FOREST.model_copy(
        update={"x_min": -1.0, "x_max": 0.5, "y_min": 0.0, "y_max": 2.0, "z_min": -2.0, "z_max": 1.5}
    )
    low, high = np.array([-1.0, 0.0, -2.0]), np.array([0.5, 2.0, 1.5])
    inside = np.all((points >= low) & (points <= high), axis=1)
    np.testing.assert_array_equal(pass_through(points, p), points[inside])


@pytest.mark.parametrize("bound", [0.1, 0.3, -0.7, 9.9])
def test_a_point_on_a_face_belongs_to_the_box_whatever_float32_makes_of_it(bound):
    p = FOREST.model_copy(update={"x_min": bound, "x_max": bound + 1.0})
    q = FOREST.model_copy(update={"x_min": bound - 1.0, "x_max": bound})
    point = np.array([[bound, 0.0, 0.0]], np.float32)
    assert len(pass_through(point, p)) == 1
    assert len(pass_through(point, q)) == 1


def test_the_input_is_not_modified():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    before = points.copy()
    pass_through(points, FOREST)
    voxel_grid(points, FOREST.model_copy(update={"voxel_size": 0.5}))
    np.testing.assert_array_equal(points, before)
