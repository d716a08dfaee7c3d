"""A robot in doubt of its place: what it does not see is not missing, one hypothesis is followed, and after a
loop the trees stand where SLAM has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.slam.best_particle import are_apart, heir, leader
from pipeline.slam.resampling import low_variance_ancestors, normalised
from pipeline.tracking import Tracker
from pipeline.tracking.map_correction import held
from pipeline.tracking.miss_suppression import beyond_doubt
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Landmarks, Verdict
from tests.pipeline.strategies import ALL_FREE, detections, seeds

STEMS = preset("stems").tracking
MAX = STEMS.distance_max


def table(places, sigma, verdict=-1):
    """Trees of many hits, each known so well [m]."""
    n = len(places)
    t = TrackTable.empty(n)
    t.number[:] = 1 + np.arange(n)
    t.x[:, :2] = places
    t.P[:, 0, 0] = t.P[:, 1, 1] = np.square(sigma)
    t.hits[:], t.score[:], t.verdict[:] = 20, 5.0, verdict
    return t


def pose_known(sigma, yaw=0.0):
    """Covariance of a pose."""
    return np.diag(np.square([sigma, sigma, yaw]))


@given(seeds, st.floats(0.0, 5.0), st.floats(0.0, 0.2))
def test_who_knows_the_trees_no_better_than_the_robot_its_place_spares_none(seed, sigma, yaw):
    random = np.random.default_rng(seed)
    places = random.uniform(-10.0, 10.0, (8, 2))
    at_tree = np.sqrt(sigma**2 + 0.5 * np.square(yaw) * np.square(places).sum(axis=1))
    as_well, better = table(places, at_tree), table(places, 0.01)
    assert not beyond_doubt(as_well.x, as_well.P, np.zeros(3), pose_known(sigma, yaw), MAX, 15.0).any()
    spared = beyond_doubt(better.x, better.P, np.zeros(3), pose_known(sigma, yaw), MAX, 15.0)
    np.testing.assert_array_equal(spared, at_tree - 0.01 > 0.5 * MAX)


def after_misses(sigma, scans=60):
    """What is left of an old tree and of one that was begun here, where neither is seen."""
    tracker = Tracker(STEMS)
    tracker.tracks = table([[5.0, 1.0], [6.0, -1.0]], [0.05, max(sigma, 0.05)])
    known = np.array([[5.0, 4.0]])
    for k in range(scans):
        tracker.process(k * 10**8, Pose2(), pose_known(sigma), detections([[3.0, 5.0]]), ALL_FREE, 15.0)
        tracker.anchor(known, np.full((1, 3), 1e-4), Pose2(), 15.0)
    return {1, 2} & set(tracker.tracks.number.tolist())


def test_in_doubt_old_trees_are_not_given_up_and_those_begun_in_doubt_are():
    assert after_misses(0.05) == set()
    assert after_misses(5.0) == {1}


# --- after a loop ---------------------------------------------------------------------------------


def landmarks(places):
    """Of twelve hits, begun at scan 3."""
    n = len(places)
    own = np.tile(1e-4 * np.eye(2), (n, 1, 1))
    return Landmarks(np.array(places), own, 4.0 * own, np.full(n, 12), np.full(n, 3))


def test_what_was_begun_in_doubt_stands_at_its_landmark_or_nowhere():
    places = [[0.0, 0.0], [10.3, 0.0], [20.0, 0.0], [30.0, 0.0], [40.0, 0.0]]
    tracks = table(places, [0.05, 4.0, 4.0, 4.0, 0.05])
    tracks.verdict[3] = Verdict.TREE
    known = landmarks([[10.0, 0.0], [50.0, 0.0]])
    young = np.array([False, True, True, True, True])
    after, left = held(tracks, young, known, MAX)
    assert after.number.tolist() == [1, 2, 4, 5], (
        "nothing backs the third; what was gathered backs the fourth"
    )
    np.testing.assert_allclose(after.x[1, :2], [10.0, 0.0])
    np.testing.assert_allclose(after.P[1, :2, :2], 5e-4 * np.eye(2))
    assert left.tolist() == [1]
    assert tracks.x[1, 0] == 10.3, "the table itself is left alone"


def test_a_tree_that_was_given_up_is_taken_back_with_a_number_of_its_own():
    from tests.pipeline.loop_closure.test_detection import shifted

    tracker = Tracker(STEMS)
    tracker.tracks, tracker.next_number = table([[0.0, 0.0]], 0.05), 9
    known = landmarks([[0.0, 0.1], [7.0, 0.0]])
    stamps = 100 * np.arange(60)
    tracker.hold_to(known, shifted(first=20), stamps)
    trees = tracker.trees()
    assert trees.number.tolist() == [1, 9]
    assert trees.confirmed.all()
    assert (trees.observations[1], trees.first_seen_ns[1]) == (12, 300)
    tracker.hold_to(known, shifted(first=20), stamps)
    assert len(tracker.tracks) == 2, "once"


# --- one hypothesis -------------------------------------------------------------------------------


@given(seeds, st.floats(0.1, 3.0))
def test_where_particles_lie_apart_one_is_followed_until_it_dies(seed, power):
    random = np.random.default_rng(seed)
    weights, offset = normalised(power * random.standard_normal(40)), float(random.uniform())
    near, far = random.normal(0.0, 0.2, (40, 3)), random.normal(0.0, 8.0, (40, 3))
    far[weights.argmax(), :2] += 1e3  # however the weights are
    assert (are_apart(near, weights, 1.0), are_apart(far, weights, 1.0)) == (False, True)
    assert leader(weights, 7, near, 1.0) == weights.argmax()
    assert leader(weights, 7, far, 1.0) == 7
    ancestors = low_variance_ancestors(weights, offset)
    chosen = heir(7, ancestors, weights)
    assert ancestors[chosen] == chosen, "a survivor keeps its slot"
    assert chosen == (7 if 7 in ancestors else weights.argmax())


def test_a_pose_that_is_told_where_particles_lie_apart_is_one_of_them():
    from pipeline.slam import FastSlam
    from tests.pipeline.strategies import NOTHING_SEEN

    slam = FastSlam(preset("stems").slam, 0)
    slam.place(0, Pose2(3.0, 1.0, 0.0), np.diag([25.0, 25.0, 0.01]))
    told = slam.process(1, Pose2(0.1, 0.0, 0.0), detections([]), NOTHING_SEEN)
    assert told.T_map_base.as_array().tobytes() in {row.tobytes() for row in told.particles}
    away = told.particles - told.T_map_base.as_array()
    about_it = (told.weights[:, None] * away).T @ away
    assert told.relative is not None
    for covariance in (told.covariance, told.relative):
        assert np.linalg.eigvalsh(covariance - about_it).min() > -1e-3, "of that pose, not of the mean"
    slam.state = replace(slam.state, pose=np.tile([3.0, 1.0, 0.0], (100, 1)))
    told = slam.process(2, Pose2(), detections([]), NOTHING_SEEN)
    assert told.T_map_base.x == pytest.approx(3.0, abs=0.01)
