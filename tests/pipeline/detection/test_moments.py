"""Covariance and eccentricity of clusters (Eq. 3-4) against closed forms and NumPy, with their
invariances."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.config import preset
from pipeline.detection.cluster_shape import describe, eccentricity, moments, spread_about
from pipeline.geometry.hash_grid import group_rows
from pipeline.types.records import Labels
from tests.pipeline.strategies import SENSOR, arc, one_cluster

PAPER = preset("paper").shape
FOREST = preset("forest").shape
N = 20_000


def e_of(points):
    """Eccentricity of one cluster as the paper takes it."""
    return float(describe(points.astype(np.float32), one_cluster(points), SENSOR, PAPER).eccentricity[0])


@pytest.mark.parametrize("half_angle", np.radians([10, 30, 48.2, 60, 67.6, 80, 90]))
@pytest.mark.parametrize("radius", [0.05, 0.15, 0.5])
def test_eccentricity_of_an_arc_seen_evenly_along_it(half_angle, radius):
    a = half_angle
    s2 = np.sin(2 * a) / (4 * a)
    expected = (0.5 - s2) / (0.5 + s2 - (np.sin(a) / a) ** 2)
    assert e_of(arc(radius, a, rows=1, n=N)) == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("half_angle", np.radians([30, 60, 90]))
@pytest.mark.parametrize("radius", [0.05, 0.5])
def test_eccentricity_of_an_arc_seen_evenly_in_azimuth_from_afar(half_angle, radius):
    a = half_angle
    s = np.sin(a)
    across = np.linspace(-s, s, N) * radius
    x = 5.0 - np.sqrt(radius**2 - across**2)
    expected = (s**2 / 3) / (1 - s**2 / 3 - (np.cos(a) / 2 + a / (2 * s)) ** 2)
    assert e_of(np.stack([x, across, 0 * x], axis=1)) == pytest.approx(expected, rel=2e-3)


def test_the_two_half_circles_of_the_facts():
    assert e_of(arc(0.2, np.pi / 2, rows=1, n=N)) == pytest.approx(5.28, abs=0.01)
    across = np.linspace(-0.2, 0.2, N)
    x = 5.0 - np.sqrt(0.2**2 - across**2)
    assert e_of(np.stack([x, across, 0 * x], axis=1)) == pytest.approx(6.69, abs=0.01)


@pytest.mark.parametrize("radius", [0.05, 0.15, 0.3])
@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_eccentricity_of_a_half_circle_with_noise_along_the_ray(radius, sigma):
    rng = np.random.default_rng(1)
    across = rng.uniform(-radius, radius, 60_000)
    x = 5.0 - np.sqrt(radius**2 - across**2) + rng.normal(0, sigma, across.size)
    expected = (radius**2 / 3) / (0.0498 * radius**2 + sigma**2)
    expected = max(expected, 1 / expected)  # noise wider than a thin trunk turns the axes over
    assert e_of(np.stack([x, across, 0 * x], axis=1)) == pytest.approx(expected, rel=0.03)


clouds = arrays.arrays(np.float64, st.tuples(st.integers(3, 40), st.just(3)), elements=st.floats(-2, 2))


@given(clouds)
def test_eigenvalues_are_those_of_numpy(points):
    points = points.astype(np.float32)
    values = np.linalg.eigvalsh(np.cov(points[:, :2].astype(np.float64).T, bias=True))
    wanted = np.append(np.maximum(values[::-1], 0), 0.0)
    centroid, eigenvalues, _ = moments(points.astype(np.float64), np.array([0, len(points)]))
    np.testing.assert_allclose(eigenvalues[0], wanted, atol=1e-12)
    np.testing.assert_allclose(centroid[0], points.astype(np.float64).mean(axis=0), atol=1e-12)


@given(st.integers(0, 999), st.floats(-3, 3), st.floats(-5, 5), st.floats(-5, 5))
def test_turning_moving_and_shuffling_do_not_change_the_eccentricity(seed, turn, dx, dy):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(50, 3)) * [0.3, 0.1, 0.4]
    c, s = np.cos(turn), np.sin(turn)
    moved = rng.permutation(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [dx, dy, 1.0])
    assert e_of(moved) == pytest.approx(e_of(points), rel=1e-3)


@given(st.floats(0.1, 10.0))
def test_size_does_not_change_the_eccentricity(scale):
    points = np.random.default_rng(0).normal(size=(50, 3)) * [0.3, 0.1, 0.4]
    assert e_of(points * scale) == pytest.approx(e_of(points), rel=1e-3)


def test_extents_are_measured_along_the_ray_across_it_and_up():
    bearing = 0.8
    box = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.3, 0.3) for z in (-0.5, 0.5)])
    c, s = np.cos(bearing), np.sin(bearing)
    points = (box + np.array([5, 0, 0])) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    _, _, extent = moments(points, np.array([0, len(points)]))
    np.testing.assert_allclose(extent, [[0.2, 0.6, 1.0]], atol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5, 8, 50, 333])
@pytest.mark.parametrize("place", [(1.1, 2.3, 0.7), (-33.3, 0.1, 5.7)])
def test_equal_points_have_no_longer_side(n, place):
    """However the mean is rounded: neither 1e-32 / 1e-33 nor 1e-32 / 0 is a figure of a shape."""
    assert e_of(np.array([place] * n)) == 1.0


@pytest.mark.parametrize("n", [2, 3, 20])
@pytest.mark.parametrize("turn", [0.0, 0.3, 1.57])
def test_points_on_a_line_are_infinitely_long(n, turn):
    t = np.linspace(-0.25, 0.25, n)
    points = np.stack([4 + t * np.cos(turn), 1 + t * np.sin(turn), 0 * t], axis=1)
    assert e_of(points) > 1e6


def test_eccentricity_is_at_least_one():
    values = np.array([[2.0, 2.0, 0.0], [3.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(eccentricity(values), [1.0, 3.0, np.inf, 1.0])


@given(arrays.arrays(np.int32, st.integers(0, 40), elements=st.integers(-1, 4)))
def test_gathering_puts_the_rows_of_each_cluster_side_by_side(label):
    order, bounds = group_rows(label, 5)
    assert len(bounds) == 6
    for k in range(5):
        np.testing.assert_array_equal(order[bounds[k] : bounds[k + 1]], np.flatnonzero(label == k))


def test_no_clusters_are_columns_of_length_zero():
    labels = Labels(np.full(9, -1, np.int32), 0, np.zeros(0, np.bool_))
    for shape in (PAPER, FOREST):
        told = describe(np.ones((9, 3), np.float32), labels, SENSOR, shape)
        assert told.centre.shape == (0, 2)
        assert told.covariance.shape == (0, 2, 2)
        assert len(told.eccentricity) == len(told.verdict) == len(told.radius) == 0


@pytest.mark.parametrize("shape", [PAPER, FOREST], ids=["paper", "forest"])
def test_columns_are_contiguous_like_those_of_a_cached_scan(shape):
    label = np.repeat(np.arange(3, dtype=np.int32), 3)
    labels = Labels(label, 3, np.zeros(3, np.bool_))
    clusters = describe(np.ones((9, 3), np.float32), labels, SENSOR, shape)
    for column in fields(clusters):
        assert getattr(clusters, column.name).flags.c_contiguous, column.name


def test_the_spread_about_a_centre_is_that_of_each_cluster():
    points = np.array([[1.0, 0.0], [3.0, 0.0], [0.0, 6.0], [0.0, 7.0], [0.0, 11.0]])
    spread = spread_about(points, np.array([0, 2, 5]), np.zeros((2, 2)))
    np.testing.assert_allclose(spread, np.array([1.0, np.std([6.0, 7.0, 11.0])]))
