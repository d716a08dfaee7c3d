"""A motion that all trees tell alike: recovered in closed form, and not seen where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.poses import Pose2, wrap_angle
from pipeline.slam.motion import Noise, OdometryTrust
from pipeline.slam.rigid_shift_test import AGREE, FEWEST, MANY, SEVERAL, estimate_rigid_shift
from pipeline.slam.slip_detection import SLIPPED, STUCK, UNSURE, motion_by_trees, slip_message
from tests.pipeline.strategies import seeds

SIGMA = 0.03
SURE = Noise(0.03, np.radians(0.4), np.radians(2.0))


def scene(seed, trees=14):
    """Landmarks around the origin, no two nearer than two metres."""
    rng = np.random.default_rng(seed)
    places: list[np.ndarray] = []
    while len(places) < trees:
        place = rng.uniform(-9.0, 9.0, 2)
        if all(np.hypot(*(place - other)) > 2.0 for other in places):
            places.append(place)
    return np.array(places), rng


def asked(
    known, seen, *, pose=(0.0, 0.0, 0.0), position=0.0, heading=0.0, distrust=0.0, familiar=1.0, well=None
):
    """Return the results of `estimate_rigid_shift` but the second, with circular covariances: whether the
    shift is significant, the pose, and its covariance."""
    rows = np.array([SIGMA**2, 0.0, SIGMA**2])
    R, spread = np.tile(rows, (len(seen), 1)), np.tile(rows, (len(known), 1))
    well = np.ones(len(known), np.bool_) if well is None else well
    wheels = OdometryTrust(SURE, distrust, 0.0, familiar)
    moved, unsure, place, C = estimate_rigid_shift(
        np.array(pose), position, heading, wheels, seen, R, known, spread, well
    )
    assert not (moved and unsure)
    return moved, place, C


@given(seeds, st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-0.02, 0.02), st.floats(-3.0, 3.0))
def test_a_small_motion_of_all_is_recovered(seed, x, y, turn, yaw):
    known, _ = scene(seed)
    before = Pose2(2.0, -1.0, yaw)
    true = Pose2(before.x + x, before.y + y, yaw + turn)
    known = before.apply(known)
    moved, place, C = asked(known, true.inverse().apply(known), pose=before.as_array())
    way = np.sqrt(x * x + y * y + (5.0 * turn) ** 2)
    assert moved or way < 0.1
    assert not moved or way > 0.04
    if not moved:
        return
    away = place - true.as_array()
    assert np.hypot(away[0], away[1]) < 0.01, "to the square of the turn"
    assert abs(wrap_angle(away[2])) < 1e-3
    assert np.all(np.linalg.eigvalsh(C) > 0.0)


@given(seeds)
def test_trees_that_stand_where_they_should_tell_nothing(seed):
    known, rng = scene(seed)
    assert not asked(known, known + rng.normal(0.0, SIGMA, known.shape))[0]


@given(seeds, st.integers(1, 3))
def test_some_that_do_not_agree_are_left_out(seed, others):
    known, rng = scene(seed)
    true = Pose2(0.2, 0.1, 0.01)
    seen = true.inverse().apply(known) + rng.normal(0.0, 0.3 * SIGMA, known.shape)
    seen[:others] += np.array([0.3, -0.5])
    moved, place, _ = asked(known, seen)
    assert moved
    np.testing.assert_allclose(place, true.as_array(), atol=0.05)


def test_its_sigmas_are_those_of_the_fit():
    """Normalised error squared of 300 fits: three degrees of freedom."""
    true, squares = Pose2(0.25, -0.1, 0.015), []
    for seed in range(300):
        known, rng = scene(seed)
        noise = rng.normal(0.0, SIGMA * np.sqrt(2.0), known.shape)
        moved, place, C = asked(known, true.inverse().apply(known) + noise)
        if moved:
            error = place - true.as_array()
            squares.append(error @ np.linalg.solve(C, error))
    assert len(squares) > 295, "a tree far out may stand by chance"
    assert 2.0 < np.mean(squares) < 3.5


@pytest.mark.parametrize("pairs", range(FEWEST))
def test_few_trees_tell_nothing(pairs):
    known, _ = scene(3)
    assert not asked(known[:pairs], known[:pairs] - [0.3, 0.0])[0]


def test_what_the_odometry_can_err_by_is_no_news():
    known, _ = scene(4)
    seen = known - [0.3, 0.0]
    assert asked(known, seen)[0]
    assert not asked(known, seen, position=0.3**2)[0]


def test_of_an_odometry_that_was_wrong_less_is_believed():
    known, _ = scene(5)
    seen = known - [0.048, 0.0]
    assert not asked(known, seen)[0]
    assert asked(known, seen, distrust=1.0)[0]


def test_two_halves_that_move_apart_are_no_motion_of_the_robot():
    known, _ = scene(6)
    seen = known.copy()
    seen[::2, 0] += 0.35
    seen[1::2, 0] -= 0.35
    assert not asked(known, seen)[0]


@pytest.mark.parametrize(("well", "familiar"), [(MANY - 1, 0.2), (FEWEST - 1, 1.0)])
def test_what_was_not_there_for_long_must_be_many(well, familiar):
    """People who walk side by side are seen anew where they come."""
    known, _ = scene(12, trees=MANY)
    first = np.arange(MANY) < well
    assert not asked(known[1:], known[1:] - [0.3, 0.0], familiar=familiar, well=first[1:])[0]
    assert asked(known, known - [0.3, 0.0], familiar=familiar, well=first)[0]
    assert asked(known[1:], known[1:] - [0.3, 0.0])[0]


@pytest.mark.parametrize("pairs", range(FEWEST, SEVERAL))
def test_a_few_well_known_ones_tell_only_of_an_odometry_that_was_wrong(pairs):
    """Else they are people who stood for long, and walk off: that is said, and nothing moved."""
    known, _ = scene(16, trees=pairs)
    seen = known - [0.3, 0.0]
    assert not asked(known, seen)[0]
    assert asked(known, seen, distrust=0.5)[0]
    known, seen = known[:FEWEST], seen[:FEWEST]
    told = told_of([0.0, 0.0, 0.0], known, seen)
    assert not told.slipped
    assert told.unsure
    np.testing.assert_array_equal(told.motion, 0.0)
    assert slip_message(told.motion, told.slipped, told.unsure) == UNSURE
    again = told_of([0.0, 0.0, 0.0], known, seen, distrust=0.5)
    assert again.slipped
    assert not again.unsure


@pytest.mark.parametrize("moving", [SEVERAL, MANY, 15])
def test_one_tree_that_stands_beside_is_enough(moving):
    known, _ = scene(13, trees=moving + 1)
    seen = known - [0.3, 0.0]
    assert asked(known[1:], seen[1:])[0]
    seen[0] = known[0]
    assert not asked(known, seen)[0]


def test_a_tree_beside_people_who_stroll_counts_though_it_fits_their_motion_too():
    known, _ = scene(17, trees=SEVERAL + 1)
    seen = known - [0.09, 0.0]
    assert asked(known, seen)[0]
    seen[0] = known[0]
    assert AGREE * SIGMA * np.sqrt(2.0) > 0.09
    assert not asked(known, seen)[0]


def test_what_is_seen_beside_and_known_to_nobody_counts_where_it_could_be_known():
    known, rng = scene(14, trees=SEVERAL + 8)
    seen = known - [0.3, 0.0]
    others = seen[:SEVERAL] + rng.uniform(0.9, 1.1, (SEVERAL, 2))
    assert asked(known[:SEVERAL], np.concatenate([seen[:SEVERAL], others]))[0], "no more are known"
    assert not asked(known, np.concatenate([seen[:FEWEST], others[:5]]))[0]


def told_of(motion, known, seen, *, covariance=1e-4, alone=0.0, driven=0.0, distrust=0.0):
    """`motion_by_trees` of a robot at the origin; all landmarks were seen ten times."""
    rows = np.array([SIGMA**2, 0.0, SIGMA**2])
    return motion_by_trees(
        np.zeros(3), np.array(motion), covariance * np.eye(3), driven,
        OdometryTrust(SURE, distrust, alone, 1.0), seen,
        np.tile(rows, (len(seen), 1)), known, np.tile(rows, (len(known), 1)),
        np.full(len(known), 10, np.int32), 3, 3.5,
    )  # fmt: skip


@pytest.mark.parametrize("true", [Pose2(0.1), Pose2(0.3, 0.0, 0.02), Pose2(3.0, 2.0, 0.1), Pose2(-6.0, 1.0)])
def test_stuck_wheels_are_put_right_over_any_way(true):
    known, _ = scene(7)
    told = told_of([0.0, 0.0, 0.0], known, true.inverse().apply(known))
    assert told.slipped
    np.testing.assert_allclose(told.motion, true.as_array(), atol=0.15)
    assert slip_message(np.zeros(3), told.slipped, False) == STUCK
    assert slip_message(np.array([0.1, 0.0, 0.0]), told.slipped, False) == SLIPPED
    assert slip_message(np.zeros(3), False, False) == ""


def test_a_motion_that_is_not_known_is_told_by_trees_that_agree_with_it():
    """A gap may have moved the robot by metres: that it has not is as good to know."""
    known, _ = scene(8)
    told = told_of([0.1, 0.0, 0.0], known, Pose2(0.1).inverse().apply(known), covariance=4.0)
    assert not told.slipped
    assert told.covariance[0, 0] < 0.2**2


def test_after_a_way_without_trees_less_contradicts_the_odometry():
    known, _ = scene(9)
    seen = Pose2(0.35).inverse().apply(known)
    assert told_of([0.0, 0.0, 0.0], known, seen).slipped
    assert not told_of([0.0, 0.0, 0.0], known, seen, alone=20.0).slipped
    assert not told_of([0.0, 0.0, 0.0], known, seen, driven=20.0).slipped, "there and back"


def test_of_another_place_nothing_is_told():
    known, _ = scene(10, trees=30)
    elsewhere, _ = scene(11)
    told = told_of([0.0, 0.0, 0.0], known, elsewhere)
    assert not told.slipped
    np.testing.assert_array_equal(told.motion, 0.0)


def test_half_that_goes_by_far_while_some_stand_is_none_of_the_robot():
    known, _ = scene(15, trees=12)
    seen = known - [3.0, 1.0]
    assert told_of([0.0, 0.0, 0.0], known, seen).slipped
    seen[:3] = known[:3]
    assert not told_of([0.0, 0.0, 0.0], known, seen).slipped
