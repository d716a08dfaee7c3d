"""Known places: active while the detections agree with them, inactive while they contradict them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam import FastSlam
from pipeline.slam.motion import Motion
from pipeline.slam.particle_maps import MapColumns
from pipeline.slam.places import (
    ACTIVE,
    AGREEING,
    GATE,
    INACTIVE,
    ODDS,
    PLACE,
    REVISIT_DISTANCE,
    UNCERTAIN,
    WINDOW,
    Places,
    agreement,
    state_of,
)
from pipeline.slam.state import SlamState
from tests.pipeline.strategies import detections, seeds

R = [0.03**2, 0.0, 0.03**2]
TREES = np.array([[3.0, 4.0], [6.0, -3.0], [9.0, 2.0]])
EXACT = np.diag([1e-6, 1e-6, 1e-8])


def line(scans: int = 31, step: float = PLACE) -> Places:
    """Places of a straight path with one landmark at each scan, which only this scan shows."""
    places = Places()
    for k in range(scans):
        places = places.with_scan(k * step, k, np.array([k]))
    return places


def test_only_landmarks_of_contradicted_places_are_not_usable() -> None:
    births = np.array([-1, 0, 1, 2])  # the first one precedes all places
    places = line(3)
    assert places.is_usable(births).tolist() == [True, True, True, True]
    assert places.with_contradiction(np.array([0])).is_usable(births).tolist() == [True, False, True, True]
    assert Places().is_usable(births).all()


def of_stand(trees: np.ndarray, shown: np.ndarray, P: np.ndarray = EXACT) -> tuple[float, np.ndarray]:
    """Log odds of the trees and which of them agree, for exact detections."""
    own, of_map = np.tile(R, (len(shown), 1)), np.tile(R, (len(trees), 1))
    odds, agrees, _ = agreement(np.zeros(3), P, shown, own, trees, of_map)
    return odds, agrees


def mapped() -> FastSlam:
    """A filter with one particle after four scans of TREES, the last one at x = 1.5 m."""
    slam = FastSlam(preset("stems").slam.model_copy(update={"particles": 1}), 1)
    for k in range(4):
        slam.process(k, Pose2(0.5, 0.0, 0.0), detections(TREES - [0.5 * k, 0.0]), np.zeros(128))
    return slam


@given(seed=seeds)
def test_the_same_trees_agree_and_shifted_ones_contradict(seed):
    rng = np.random.default_rng(seed)
    trees = rng.uniform(-20.0, 20.0, (120, 2))
    odds, agrees = of_stand(trees, trees)
    assert odds > ODDS
    assert agrees.all()
    shifted, agrees = of_stand(trees, trees + np.array([0.0, 2.0]))
    assert shifted < -ODDS
    assert agrees.sum() < 30


def test_few_landmarks_do_not_decide():
    trees = np.array([[5.0, 0.0]])
    odds, _ = of_stand(trees, np.array([[6.0, 0.0]]))
    assert -ODDS < odds < 0.0
    assert of_stand(trees, np.array([[40.0, 0.0]]))[0] == 0.0, "too far away to say anything"
    uncertain = np.diag([100.0, 100.0, 1e-8])
    assert of_stand(trees, np.array([[6.0, 0.0]]), uncertain)[0] == 0.0, "any tree agrees with such a pose"


def test_odds_of_one_tree_in_closed_form():
    variance = 2.0 * R[0]
    exact = np.zeros((3, 3))
    p = 1.0 - math.exp(-(GATE**2) * variance / WINDOW**2)
    tree = np.array([[3.0, 4.0]])
    assert of_stand(tree, tree, exact)[0] == pytest.approx(math.log(AGREEING / p))
    assert of_stand(tree, tree + 1.0, exact)[0] == pytest.approx(math.log((1.0 - AGREEING) / (1.0 - p)))


def test_a_place_is_old_after_the_revisit_distance():
    places = line()
    last = 30 * PLACE
    old = places.is_old(last)
    assert old.tolist() == [last - k * PLACE > REVISIT_DISTANCE for k in range(31)]
    assert places.of_old(np.array([0, 30, -1]), last).tolist() == [True, False, False]


def test_an_old_place_is_seen_only_for_certain():
    places, last = line(), 31 * PLACE
    assert places.with_scan(last, 31, np.array([3])).is_old(last)[3]
    near = ~places.with_seen(last, np.array([10])).is_old(last)[:20]
    reach = int(REVISIT_DISTANCE / PLACE)
    assert near.tolist() == [10 - reach <= k <= 10 + reach for k in range(20)]


def test_a_contradicted_place_is_inactive_until_it_is_seen():
    places = line().with_contradiction(np.array([4]))
    assert places.contradicted
    assert places.is_usable(np.array([3, 4, 5])).tolist() == [True, False, True]
    kernels = places.in_reach(np.array([4, 30]), 30 * PLACE)
    states = [ACTIVE, UNCERTAIN, INACTIVE, UNCERTAIN, ACTIVE, ACTIVE]
    assert [state_of(b, kernels) for b in (-1, 3, 4, 5, 30, 40)] == states
    assert places.with_seen(200.0, np.array([5])).is_usable(np.array([4])).all()
    assert not places.with_scan(200.0, 31, np.zeros(0, np.int64)).contradicted
    assert not len(places.in_reach(np.array([-1, 29, 30]), 30 * PLACE).state), "all in reach are active"


def test_landmarks_of_inactive_places_are_left_alone():
    slam = mapped()
    known = slam.landmarks()
    assert known.birth.tolist() == [0, 1, 2]
    slam.state = replace(slam.state, places=slam.state.places.with_contradiction(known.birth))
    seen = TREES - [2.5, 0.2]
    estimate = slam.process(4, Pose2(0.5, 0.0, 0.0), detections(seen), np.zeros(128))
    assert estimate.landmark_of.min() > 2
    now = slam.landmarks()
    assert len(now.birth) == 6
    np.testing.assert_array_equal(now.position[:3], known.position)
    slam.state = replace(slam.state, places=slam.state.places.with_seen(0.0, known.birth))
    slam.process(5, Pose2(), detections(seen), np.zeros(128))
    assert not slam.state.places.inactive.any()


def test_landmarks_of_uncertain_places_correct_the_pose_and_stay():
    slam = mapped()
    known = slam.landmarks()
    old = replace(slam.state.places, seen=slam.state.places.seen - 2.0 * REVISIT_DISTANCE)
    slam.state = replace(slam.state, places=old)
    estimate = slam.process(4, Pose2(0.55, 0.0, 0.0), detections(TREES - [2.0, 0.0]), np.zeros(128))
    assert estimate.landmark_of.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(slam.landmarks().position, known.position)
    assert not slam.state.places.is_old(slam.state.distance).any(), "three trees that agree decide"


def test_a_scan_that_does_not_update_the_filter_ignores_landmarks_of_inactive_places():
    slam = mapped()
    slam.state = replace(slam.state, places=slam.state.places.with_contradiction(slam.landmarks().birth))
    assert slam.state.places.inactive.any()
    estimate = slam.process(4, Pose2(0.1, 0.0, 0.0), detections(TREES - [1.6, 0.2]), np.zeros(128))
    assert np.all(estimate.landmark_of == -1)


def test_a_landmark_is_not_merged_into_one_of_an_uncertain_place():
    old = np.array([[5.0, 0.0], [5.0, 4.0], [8.0, 2.0]])
    mean = np.vstack([old, [[5.05, 0.0]]])
    columns = MapColumns(
        mean,
        np.tile([0.0025, 0.0, 0.0025], (4, 1)),
        np.full(4, 20, np.int32),
        np.full(4, 20.0, np.float32),
        np.array([0, 1, 2, 100]),
    )
    slam = FastSlam(preset("stems").slam.model_copy(update={"particles": 3}), 1)
    places = Places(np.array([0, 100]), np.array([0.0, 60.0]), np.array([0.0, 60.0]), np.zeros(2, np.bool_))
    state = SlamState.in_map(np.zeros((3, 3)), columns)
    slam.state = replace(state, places=places, distance=61.0, detections=102)
    motion = Motion(Pose2(), due=True)
    slam.process(1, motion, detections(old[2:]), np.zeros(128))  # shows nothing of the landmark 100
    assert slam.landmarks().birth.tolist() == [0, 1, 2, 100]
