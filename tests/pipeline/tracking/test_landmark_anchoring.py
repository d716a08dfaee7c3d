"""Trees stand where the best particle has them."""

from __future__ import annotations

import numpy as np

from pipeline.config import preset
from pipeline.tracking.landmark_anchoring import anchor
from pipeline.tracking.track_table import TrackTable
from pipeline.tracking.tracker import limits_of
from pipeline.tracking.tracking_inputs import Sight

COVARIANCE = np.array([[0.01, 0.0, 0.01]])
SURE = np.zeros((3, 3))


def tracks(rows):
    table = TrackTable.empty(len(rows))
    table.x[:, :2] = rows
    table.P[:, :2, :2] = 0.01 * np.eye(2)
    table.score[:] = 5.0
    return table


def held(table, landmarks, reach=20.0, distance_max=2.0, of_place=COVARIANCE, of_pose=SURE):
    landmarks = np.asarray(landmarks, np.float64).reshape(-1, 2)
    sight = Sight(0, np.zeros(3), of_pose, of_pose, np.zeros(0), reach)
    limits = limits_of(preset("forest").tracking)._replace(distance_max=distance_max, miss=1.0)
    anchor(table.as_rows(), len(table), sight, landmarks, np.repeat(of_place, len(landmarks), 0), limits)
    return table


def test_a_tree_that_disagrees_with_its_landmark_is_moved_there():
    table = held(tracks([[5.0, 0.0], [0.0, 5.0]]), [[6.0, 0.0], [0.1, 5.0]])
    np.testing.assert_array_equal(table.x[:, :2], [[6.0, 0.0], [0.0, 5.0]])
    np.testing.assert_array_equal(table.score, 5.0)


def test_a_tree_that_slam_does_not_know_is_missed():
    table = held(tracks([[5.0, 0.0], [5.5, 0.0]]), [[5.0, 0.0]])
    np.testing.assert_array_equal(table.score, [5.0, 4.0])


def test_trees_out_of_reach_are_left_alone():
    table = held(tracks([[50.0, 0.0]]), [[51.0, 0.0]])
    np.testing.assert_array_equal(table.x[0, :2], [50.0, 0.0])
    assert table.score[0] == 5.0


def test_no_tree_and_no_landmark_are_no_harm():
    held(tracks(np.zeros((0, 2))), [[1.0, 1.0]])
    assert held(tracks([[1.0, 1.0]]), []).score[0] == 4.0


def test_a_moved_tree_keeps_a_covariance_that_is_one():
    """The old place was correlated with the velocity; the landmark's is not."""
    random = np.random.default_rng(0)
    A = random.normal(size=(4, 4))
    tracks = TrackTable.empty(1)
    tracks.x[0, :2], tracks.P[0], tracks.score[0] = [5.0, 0.0], A @ A.T, 5.0
    small = np.array([[1e-4, 0.0, 1e-4]])
    Sigma = 1e-6 * np.eye(3)
    tracks.P[0, :2, :2] = 1e-3 * np.eye(2)
    held(tracks, [[5.5, 0.0]], 15.0, 1.0, small, Sigma)
    assert tracks.x[0, 0] == 5.5
    assert np.all(np.linalg.eigvalsh(tracks.P[0]) > 0.0)
