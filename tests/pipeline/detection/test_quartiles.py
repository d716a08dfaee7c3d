"""Quantiles of sorted numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.detection.cylinder_fit import quantile


@given(
    arrays.arrays(
        np.float64,
        st.integers(1, 60),
        elements=st.one_of(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), st.floats(-1e3, 1e3)),
    ),
    st.sampled_from([0.25, 0.5, 0.75]),
)
def test_quantiles_are_those_of_numpy(numbers, part):
    assert quantile(np.sort(numbers), part) == pytest.approx(np.quantile(numbers, part), abs=1e-9)
