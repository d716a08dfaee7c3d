"""Order of numbers, as NumPy has it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.geometry.ordering import ascending, ascending_rows, median, quantile

NUMBERS = arrays.arrays(
    np.float64,
    st.integers(1, 130),
    elements=st.one_of(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), st.floats(-1e3, 1e3)),
)


@given(NUMBERS)
def test_rows_are_sorted_and_equal_numbers_keep_their_order(numbers):
    np.testing.assert_array_equal(ascending_rows(numbers), np.argsort(numbers, kind="stable"))
    np.testing.assert_array_equal(ascending(numbers), np.sort(numbers))


@given(NUMBERS)
def test_the_median_is_that_of_numpy_to_the_bit(numbers):
    assert median(numbers.copy()) == np.median(numbers)


@given(NUMBERS, st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]))
def test_quantiles_are_those_of_numpy(numbers, part):
    assert quantile(numbers.copy(), part) == pytest.approx(np.quantile(numbers, part), abs=1e-9)
