"""Fit of one cluster with residuals: exact cylinders are recovered exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.cylinder_fit import arc_start, fit_one
from pipeline.types.records import Sensor


def leaning_arc(centre, lean, radius, half=1.2):
    """Points on the side of a leaning cylinder that faces the origin."""
    facing = np.arctan2(-centre[1], -centre[0])
    angle, height = np.meshgrid(facing + np.linspace(-half, half, 31), np.linspace(-0.7, 0.7, 8))
    x = centre[0] + lean[0] * height + radius * np.cos(angle)
    y = centre[1] + lean[1] * height + radius * np.sin(angle)
    return np.column_stack([x.ravel(), y.ravel(), height.ravel()])


@given(st.floats(-3.0, 3.0), st.floats(0.08, 0.3), st.floats(-0.04, 0.04), st.floats(-0.04, 0.04))
def test_a_leaning_cylinder_has_no_residuals(bearing, radius, lean_x, lean_y):
    centre = 5.0 * np.array([np.cos(bearing), np.sin(bearing)])
    points = leaning_arc(centre, (lean_x, lean_y), radius)
    fit = fit_one(points, Sensor(range_sigma=0.005))
    assert fit is not None
    np.testing.assert_allclose(fit.centre, centre, atol=0.01)
    np.testing.assert_allclose(fit.lean, (lean_x, lean_y), atol=0.02)
    assert fit.radius == pytest.approx(radius, abs=0.01)
    assert np.abs(fit.residual).max() < 0.02
    np.testing.assert_allclose(np.hypot(*fit.offset.T), fit.residual + fit.radius)
    assert fit.arc == pytest.approx(2.4, abs=0.3)


def test_residuals_are_positive_outside():
    points = leaning_arc(np.array([5.0, 0.0]), (0.0, 0.0), 0.2)
    points[100, :2] += 0.05 * (points[100, :2] - [5.0, 0.0]) / 0.2
    fit = fit_one(points, Sensor(range_sigma=0.005))
    assert fit is not None
    assert int(np.argmax(fit.residual)) == 100
    assert fit.residual[100] == pytest.approx(0.05, abs=0.01)


def test_too_few_points_have_no_fit():
    assert fit_one(np.ones((4, 3)), Sensor()) is None


@given(st.floats(-np.pi, np.pi), st.floats(0.1, 6.0), st.integers(3, 40))
def test_an_arc_begins_where_it_begins(start, width, count):
    angle = start + np.linspace(0.0, width, count)
    if width / (count - 1) < 2.0 * np.pi - width - 1e-6:  # else the gap lies within
        wrapped = np.angle(np.exp(1j * angle))
        assert np.angle(np.exp(1j * (arc_start(wrapped) - start))) == pytest.approx(0.0, abs=1e-9)
