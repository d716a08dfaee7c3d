"""Numbers in text: the same as Python reads, and a stop at the first word that is none."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.io.readers.number_text import parse_numbers

FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)


@settings(max_examples=200, deadline=None)
@given(st.lists(FLOATS, max_size=40), st.sampled_from([" ", "\t", "\r\n", ", ", "   \n"]))
def test_single_precision_comes_back_to_the_last_bit(numbers: list[float], gap: str):
    text = gap.join(f"{number:.9g}" for number in numbers).encode()
    np.testing.assert_array_equal(parse_numbers(text).astype(np.float32), np.array(numbers, np.float32))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-1e12, 1e12), max_size=40), st.sampled_from(["{:.6f}", "{:.17g}", "{:e}", "{!r}"]))
def test_double_precision_agrees_with_python(numbers: list[float], form: str):
    words = [form.format(number) for number in numbers]
    expected = np.array([float(word) for word in words])
    np.testing.assert_allclose(parse_numbers(" ".join(words).encode()), expected, rtol=1e-14, atol=1e-300)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_give_finite_numbers_or_nan_and_never_an_error(text: bytes):
    assert parse_numbers(text).dtype == np.float64


def test_words_that_are_no_numbers_end_the_reading():
    for text in (b"1 2 x 3", b"1 2 1.2.3 3", b"1 2 - 3", b"1 2 4e 3", b"1 2 . 3"):
        np.testing.assert_array_equal(parse_numbers(text), [1.0, 2.0])
    np.testing.assert_array_equal(parse_numbers(b"1 NaN -nan +2."), [1.0, np.nan, np.nan, 2.0])
    np.testing.assert_array_equal(parse_numbers(b"1 2 3", limit=2), [1.0, 2.0])
    assert len(parse_numbers(b"")) == len(parse_numbers(b"  \n")) == 0
