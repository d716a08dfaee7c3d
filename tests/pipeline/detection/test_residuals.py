"""Residual of one return in closed form: the part of a wide beam that hits the trunk."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.cylinder_fit import BEAM, RAY, normal_equations

SIGMA = 1e-6  # m; what the error of a range is expected to add is nothing then
FAR = 1e3  # m; every return keeps its weight


def one_return(across, behind, distance, radius):
    """Squared residual and gradient of a return `across` to the right of an axis straight ahead [m]."""
    axis = np.array([distance, 0.0])
    place = axis + np.array([behind, -across])
    # The ray that passes the axis at `across` and ends `behind` after its foot.
    turn = np.arcsin(np.clip(across / distance, -1.0, 1.0))
    direction = np.array([np.cos(turn), -np.sin(turn)])
    reach = direction @ axis + behind
    rays = np.zeros((RAY, 1))
    rays[:, 0] = *direction, reach, 0.0
    g, H = np.zeros(5), np.zeros((5, 5))
    p = np.array([*axis, 0.0, 0.0, radius])
    squares, _ = normal_equations(rays, 1, p, SIGMA, FAR, FAR, g, H)
    return squares, g, reach, place


def seen_part(across, reach, radius):
    """Middle of what of a beam meets the trunk, seen from the side where the beam passes [m]."""
    low, high = max(abs(across) - BEAM * reach, -radius), min(abs(across) + BEAM * reach, radius)
    return 0.5 * (low + high) if low <= high else abs(across) - BEAM * reach


@given(st.floats(0.02, 0.4), st.floats(3.0, 120.0), st.floats(-1.2, 1.2), st.floats(-1.5, -0.2))
def test_the_residual_is_that_of_the_middle_of_the_part_that_meets_the_trunk(radius, distance, side, front):
    across, behind = side * radius, front * radius
    squares, _, reach, _ = one_return(across, behind, distance, radius)
    expected = np.hypot(behind, seen_part(across, reach, radius)) - radius
    assert np.sqrt(squares) == pytest.approx(abs(expected), abs=1e-7)


@pytest.mark.parametrize("distance", [5.0, 20.0, 40.0, 80.0])
def test_a_beam_wider_than_the_trunk_does_not_turn_its_normal_round(distance):
    """A beam straight at the axis meets all of the trunk, and one beside it more on its own side."""
    radius = 0.05
    squares, g, _, _ = one_return(0.0, -radius, distance, radius)
    assert squares == pytest.approx(0.0, abs=1e-12)
    for across in (0.2 * radius, 0.8 * radius):
        assert seen_part(across, distance, radius) >= 0.0
        _, g, _, _ = one_return(across, -1.4 * radius, distance, radius)
        _, mirrored, _, _ = one_return(-across, -1.4 * radius, distance, radius)
        # The return lies outside, in front and to the right: it draws the circle there.
        assert g[1] > 0.0 or abs(g[1]) < 1e-3 * abs(g[0])  # the latter where all of the trunk is lit
        assert mirrored[1] == pytest.approx(-g[1], rel=1e-3)
        assert mirrored[0] == pytest.approx(g[0], rel=1e-6)


@given(st.floats(0.05, 0.5), st.floats(2.0, 30.0))
def test_a_return_on_the_circle_asks_for_nothing(radius, distance):
    _, g, _, _ = one_return(0.0, -radius, distance, radius)
    np.testing.assert_allclose(g, 0.0, atol=1e-3)
