"""Clusters of a planar laser: runs of beams between jumps of range."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.detection.clustering import range_jump

STEP = np.radians(0.5)
BEAMS = np.arange(-180, 181) * STEP


def beams(ranges, first=0):
    """Points of consecutive beams; None is a beam without a return."""
    rows = [
        [r * np.cos(BEAMS[first + k]), r * np.sin(BEAMS[first + k]), 0.0]
        for k, r in enumerate(ranges)
        if r is not None
    ]
    return np.array(rows, np.float32).reshape(-1, 3)


def label_of(ranges, *, jump=1.0, min_points=1, first=100):
    return range_jump(beams(ranges, first), jump, min_points, STEP)


def test_a_jump_cuts_and_a_slope_does_not():
    label, _ = label_of([5, 5.5, 6, 6.5, 8, 8.2, 3])
    assert label.tolist() == [0, 0, 0, 0, 1, 1, 2]


def test_one_missing_beam_does_not_cut_and_two_do():
    assert label_of([5, None, 5, 5])[0].tolist() == [0, 0, 0]
    assert label_of([5, None, None, 5, 5])[0].tolist() == [0, 1, 1]


def test_small_runs_are_noise_and_take_no_number():
    label, hidden = label_of([5, 9, 9, 9, 5], min_points=2)
    assert label.tolist() == [-1, 0, 0, 0, -1]
    assert len(hidden) == 1


def test_an_edge_is_hidden_where_the_neighbouring_beam_ends_nearer():
    _, hidden = label_of([5, 5, 9, 9, 5, None, None, None, 7, 7])
    assert hidden.tolist() == [False, True, False, False]


def test_a_run_beside_free_beams_is_not_hidden():
    _, hidden = label_of([None, None, 9, 9, None, None])
    assert hidden.tolist() == [False]


@given(
    st.lists(st.one_of(st.none(), st.floats(1.0, 30.0)), max_size=60),
    st.floats(0.1, 3.0),
    st.integers(1, 4),
    st.randoms(use_true_random=False),
)
def test_laws_of_the_cut(ranges, jump, min_points, random):
    points = beams(ranges, 100)
    label, hidden = range_jump(points, jump, min_points, STEP)
    assert len(label) == len(points)
    assert len(hidden) == label.max(initial=-1) + 1
    reach = np.hypot(points[:, 0], points[:, 1])
    for k in range(len(hidden)):
        rows = np.flatnonzero(label == k)
        assert len(rows) >= min_points
        assert np.array_equal(rows, np.arange(rows[0], rows[-1] + 1)), "a run has no holes"
        assert np.all(np.abs(np.diff(reach[rows])) <= jump + 1e-5)
    order = list(range(len(points)))
    random.shuffle(order)
    shuffled, _ = range_jump(points[order], jump, min_points, STEP)
    np.testing.assert_array_equal(shuffled, label[order])


def test_a_trunk_straight_behind_is_one_cluster():
    around = np.radians(np.arange(177.0, 184.0, 0.5))
    points = np.stack([5 * np.cos(around), 5 * np.sin(around), 0 * around], axis=1).astype(np.float32)
    label, _ = range_jump(points, 1.0, 1, STEP)
    assert label.max() == 0
