"""Control points against theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.stand.control_points import fit_control_points, fit_rigid_pairs
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2

SQUARE = np.array([[0.0, 0.0], [20.0, 1.0], [18.0, 22.0], [-3.0, 17.0]])
OFF = np.array([[0, 0], [0, 0], [3, 0], [0, 0]])  # the third point is wrong


@given(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7), st.floats(-3.1, 3.1))
def test_exact_points_give_the_exact_pose(x, y, yaw):
    fit = fit_control_points(SQUARE, Pose2(x, y, yaw).apply(SQUARE))
    np.testing.assert_allclose(fit.pose.apply(SQUARE), Pose2(x, y, yaw).apply(SQUARE), atol=1e-6)
    assert math.remainder(fit.pose.yaw - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-7)
    assert fit.rms < 1e-6


def test_residuals_and_sigma_agree_with_theory_for_four_points_of_5_cm():
    random = np.random.default_rng(1)
    truth, sigma = Pose2(312000.0, 5096000.0, 0.7), 0.05
    spread = math.sqrt(np.square(SQUARE - SQUARE.mean(axis=0)).sum())
    squares, told, shift, turn = [], [], [], []
    for _ in range(100):
        fit = fit_control_points(SQUARE, truth.apply(SQUARE) + random.normal(0, sigma, SQUARE.shape))
        squares.append(np.square(fit.residuals).sum())
        told.append((fit.sigma_point**2, fit.sigma**2, fit.sigma_turn**2))
        centre = SQUARE.mean(axis=0, keepdims=True)
        shift.append(fit.pose.apply(centre) - truth.apply(centre))
        turn.append(fit.pose.yaw - truth.yaw)
    freedom = 2 * 4 - 3
    # the sum of squares is chi-square with five degrees of freedom
    assert np.mean(squares) / sigma**2 == pytest.approx(freedom, abs=4 * math.sqrt(2 * freedom / 100))
    assert np.var(squares) / sigma**4 == pytest.approx(2 * freedom, rel=0.6)
    expected = (sigma**2, sigma**2 / 4, sigma**2 / spread**2)
    np.testing.assert_allclose(np.mean(told, axis=0), expected, rtol=4 * math.sqrt(2 / freedom / 100))
    assert np.std(shift) == pytest.approx(sigma / 2, rel=0.2)
    assert np.std(turn) == pytest.approx(sigma / spread, rel=0.3)


def test_two_points_are_enough():
    fit = fit_control_points(SQUARE[:2], Pose2(5, 6, 1.0).apply(SQUARE[:2]))
    assert fit.pose.yaw == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("local", "known", "says"),
    [
        (SQUARE[:1], SQUARE[:1], "too few"),
        (SQUARE[:0], SQUARE[:0], "no control points"),
        (SQUARE * 0.001, SQUARE, "at one place"),
        (SQUARE, SQUARE / 0.3048, "3.281 times"),
        (SQUARE, SQUARE[:, ::-1], "exchanged"),
        (SQUARE, SQUARE + OFF, "Check point c"),
        (SQUARE[:3], SQUARE[[1, 0, 2]], "contradict"),
    ],
)
def test_points_that_do_not_fit_are_refused_with_the_reason(local, known, says):
    with pytest.raises(StemmapError, match=says):
        fit_control_points(local, known, names="abcd"[: len(local)])


@pytest.mark.parametrize(
    ("third", "remedy"),
    [
        (SQUARE[2] + [0.0, 5.0], "Check point c;"),
        # At its right distance from a, but not from b: either of b and c can be wrong.
        (Pose2(0.0, 0.0, 0.2).apply(SQUARE[2:3])[0], "Check the points b, c: one is wrong;"),
    ],
)
def test_the_point_without_which_the_others_agree_is_named_for_three_points(third, remedy):
    local = SQUARE[:3]
    known = np.stack([local[0], local[1] + [0.01, 0.0], third])
    with pytest.raises(StemmapError) as refused:
        fit_control_points(local, known, names="abc")
    assert refused.value.remedy.startswith(remedy)
    assert "greater error" not in refused.value.remedy
    assert "a: 0.00 m" in refused.value.what or "a: 0.01 m" in refused.value.what


def test_two_wrong_points_are_not_explained_by_one():
    known = SQUARE + np.array([[0, 0], [0, 0], [3, 0], [0, 4]])
    with pytest.raises(StemmapError, match=r"no single point explains it; residuals [a-d]: \d"):
        fit_control_points(SQUARE, known, names="abcd")


def test_a_greater_sigma_allows_greater_residuals():
    known = SQUARE + OFF
    assert fit_control_points(SQUARE, known, point_sigma=1.0).rms > 0.5


def test_one_wrong_point_among_good_ones_is_named_though_the_residuals_are_small():
    """The least-squares fit spreads an error of 1.47 m over four points: no coordinate is off by 0.5 m."""
    random = np.random.default_rng(3)
    known = Pose2(470600.0, 4070100.0, 0.4).apply(SQUARE) + random.normal(0.0, 0.04, SQUARE.shape)
    assert fit_control_points(SQUARE, known).rms < 0.1
    known[2] += [1.3, -0.7]
    assert fit_rigid_pairs(SQUARE, known).sigma_point < 0.6
    with pytest.raises(StemmapError, match="contradict") as error:
        fit_control_points(SQUARE, known, names="abcd")
    assert "point c" in error.value.remedy


@pytest.mark.parametrize("sigma", [0.02, 0.12])
def test_good_points_are_seldom_refused(sigma):
    random, refused = np.random.default_rng(4), 0
    for _ in range(300):
        local = random.uniform(0.0, 30.0, (random.integers(4, 8), 2))
        try:
            fit_control_points(local, local + random.normal(0.0, sigma, local.shape))
        except StemmapError:
            refused += 1
    assert refused <= 2  # 1 in 3000 for each point


def test_points_at_one_place_leave_the_turn_unknown():
    local, known = np.full((2, 2), 3.0), np.array([[10.0, 0.0], [12.0, 0.0]])
    fit = fit_rigid_pairs(local, known)
    assert fit.sigma_turn == math.inf
    np.testing.assert_allclose(fit.pose.apply(local), [[11.0, 0.0], [11.0, 0.0]])


def test_a_wrong_point_at_the_place_of_another_is_named():
    """Without the third point, the others are at one place."""
    local = np.array([[0.0, 0.0], [0.0, 0.0], [20.0, 0.0]])
    with pytest.raises(StemmapError, match="contradict") as error:
        fit_control_points(local, local + np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 0.0]]))
    assert "point 2" in error.value.remedy
