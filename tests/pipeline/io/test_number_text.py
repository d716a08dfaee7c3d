"""Text tables of numbers: the same numbers as Python reads; damaged lines are left out and counted."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.readers.pose_files import parse_table, read_rows


@given(
    st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), max_size=20),
    st.sampled_from([" ", "\t", "   "]),
    st.sampled_from(["\n", "\r\n", "\n\n"]),
    st.sampled_from(["{!r}", "{:.17g}", "{:e}"]),
)
def test_numbers_are_those_that_python_reads(
    rows: list[tuple[float, ...]], gap: str, end: str, form: str
) -> None:
    text = end.join(gap.join(form.format(number) for number in row) for row in rows).encode()
    expected = np.array([[float(form.format(number)) for number in row] for row in rows]).reshape(-1, 3)
    table, damaged = parse_table(text, 3)
    np.testing.assert_array_equal(table, expected)
    assert damaged == 0


@given(st.binary(max_size=200))
def test_arbitrary_bytes_never_raise(text: bytes) -> None:
    table, damaged = parse_table(text, 2)
    assert table.shape[1] == 2
    assert damaged >= 0


@pytest.mark.parametrize("line", ["5 6 7", "5", "5 x", "5 1.2.3", "5 -", "\xff 5"])
def test_a_damaged_line_is_left_out_and_counted(line: str) -> None:
    table, damaged = parse_table(f"1 2\n{line}\n3 nan\n".encode("latin1"), 2)
    np.testing.assert_array_equal(table, [[1.0, 2.0], [3.0, np.nan]])
    assert damaged == 1


def test_rows_end_at_the_promised_number_of_lines() -> None:
    text = b"1 2\n3 4\n5 x\n7 8\n3 0 1 2\n"
    (rows,) = read_rows(io.BytesIO(text), 2, 4)
    np.testing.assert_array_equal(rows, [[1.0, 2.0], [3.0, 4.0], [7.0, 8.0]])
    assert list(read_rows(io.BytesIO(b""), 2, 4)) == []


def test_a_line_without_end_is_read_in_bounded_parts() -> None:
    text = b"1 2\n" + b"9" * 10_000_000 + b"\n3 4\n"
    rows = np.concatenate(list(read_rows(io.BytesIO(text), 2, 1_000)))
    np.testing.assert_array_equal(rows, [[1.0, 2.0], [3.0, 4.0]])
