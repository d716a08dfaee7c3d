"""Numbers that clusters keep from scan to scan."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.scene.scan import ClusterNumbers

places = st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), max_size=12).map(
    lambda rows: np.array(rows, dtype=np.float64).reshape(-1, 2)
)


def test_a_cluster_keeps_its_number_while_it_trembles():
    companions = ClusterNumbers()
    first = companions.follow(np.array([[0.0, 0.0], [5.0, 0.0]]))
    later = companions.follow(np.array([[5.1, 0.1], [0.0, 0.2], [9.0, 9.0]]))
    assert list(later[:2]) == [first[1], first[0]]
    assert later[2] not in first


def test_a_cluster_that_jumps_is_another():
    companions = ClusterNumbers()
    first = companions.follow(np.array([[0.0, 0.0]]))
    assert companions.follow(np.array([[0.6, 0.0]]))[0] != first[0]


@given(st.lists(places, min_size=1, max_size=4))
def test_no_number_is_given_twice(scans: list[np.ndarray]):
    companions = ClusterNumbers()
    for scan in scans:
        numbers = companions.follow(scan)
        assert len(set(numbers.tolist())) == len(scan)


@given(places)
def test_the_same_places_keep_their_numbers_in_any_order(scan: np.ndarray):
    scan = np.unique(scan, axis=0)
    companions = ClusterNumbers()
    first = companions.follow(scan)
    assert list(companions.follow(scan[::-1])) == list(first[::-1])
