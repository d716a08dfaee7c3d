"""Quartiles without sorting: those of the sorted numbers, to the last bit."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.detection.cylinder_fit import quantile


def of_sorted(numbers, part):
    """The plain way."""
    ordered, at = np.sort(numbers), part * (len(numbers) - 1)
    k = int(at)
    after = min(k + 1, len(numbers) - 1)
    return ordered[k] + (at - k) * (ordered[after] - ordered[k])


@given(
    arrays.arrays(
        np.float64,
        st.integers(1, 60),
        elements=st.one_of(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), st.floats(-1e3, 1e3)),
    )
)
def test_quantiles_one_after_another_are_those_of_the_sorted_numbers(numbers):
    n, low, moved = len(numbers), 0, numbers.copy()
    for part in (0.25, 0.5, 0.75):
        assert quantile(moved, low, n, part) == of_sorted(numbers, part)
        low = int(part * (n - 1))
    np.testing.assert_array_equal(np.sort(moved), np.sort(numbers))


def test_numbers_behind_the_first_n_are_not_asked_and_stay():
    numbers = np.array([3.0, 1.0, 2.0, -9.0, 9.0])
    assert quantile(numbers, 0, 3, 0.5) == 2.0
    np.testing.assert_array_equal(numbers[3:], [-9.0, 9.0])
