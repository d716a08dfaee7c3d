"""A click means the marker that its ray hits, also when the browser's picture is older than ours."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.scene.scan import distances, meant

coordinate = st.floats(-20.0, 20.0)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@given(vector, vector.filter(lambda v: np.linalg.norm(v) > 0.1), vector, st.floats(0.05, 3.0))
def test_the_distance_is_the_smallest_over_ray_and_segment(origin, direction, low, height):
    high = low + np.array([0.0, 0.0, height])
    (told,) = distances(origin, direction, low[None], high[None])
    along = np.linspace(0.0, 1.0, 200)[:, None]
    segment = low + along * (high - low)
    unit = direction / np.linalg.norm(direction)
    t = np.maximum((segment - origin) @ unit, 0.0)[:, None]
    by_hand = np.linalg.norm(segment - origin - t * unit, axis=1).min()
    assert told <= by_hand + 1e-9
    assert told >= by_hand - height / 199


LOW = np.array([[4.0, -2.0, 0.3], [4.0, 0.0, 0.3], [4.0, 2.0, 0.3]])
HIGH, RADIUS = LOW + np.array([0.0, 0.0, 1.5]), np.full(3, 0.2)


def test_the_marker_that_was_hit_is_meant():
    origin = np.array([0.0, 0.0, 1.0])
    for row, y in enumerate((-2.0, 0.0, 2.0)):
        assert meant(origin, np.array([4.0, y, 0.0]), LOW, HIGH, RADIUS, row) == row


def test_a_number_of_an_older_picture_is_put_right_by_the_ray():
    origin = np.array([0.0, 0.0, 1.0])
    at_the_last = np.array([4.0, 2.0, 0.0])
    for stale in (0, 1, 7, None):
        assert meant(origin, at_the_last, LOW, HIGH, RADIUS, stale) == 2


def test_a_ray_into_the_sky_means_nothing():
    assert meant(np.zeros(3), np.array([0.0, 0.0, 1.0]), LOW, HIGH, RADIUS, 1) is None
    none = np.zeros((0, 3))
    assert meant(np.zeros(3), np.array([1.0, 0.0, 0.0]), none, none, np.zeros(0), 0) is None
