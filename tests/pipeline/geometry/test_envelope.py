"""Cholesky factorisation within an envelope: the solution of NumPy for any sparse matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.geometry.envelope import Envelope, Factor
from tests.pipeline.strategies import seeds


def matrix(rng, n, reach):
    """A positive definite matrix whose entries are at most `reach` from the diagonal, but for a few."""
    A = np.zeros((n, n))
    for _ in range(2 * n):
        i = rng.integers(n)
        j = (
            min(max(i + rng.integers(-reach, reach + 1), 0), n - 1)
            if rng.random() < 0.95
            else rng.integers(n)
        )
        A[i, j] = A[j, i] = rng.normal()
    return A + np.diag(np.abs(A).sum(axis=1) + 0.1)


def stored(A, side):
    """The envelope of a matrix, and its entries on and below the diagonal, filled up by the identity."""
    i, j = np.nonzero(A)
    envelope = Envelope.of(i, j, len(A), side)
    values = np.zeros(envelope.offset[-1])
    for block, row in enumerate(envelope.rows(values)):
        for r in range(side):
            at, first = side * block + r, side * int(envelope.first[block])
            if at < len(A):
                row[r, : at - first + 1] = A[at, first : at + 1]
            else:
                row[r, at - first] = 1.0
    return envelope, values


@given(seed=seeds, n=st.integers(1, 40), side=st.integers(1, 9), reach=st.integers(0, 6))
def test_the_solution_is_that_of_numpy(seed, n, side, reach):
    rng = np.random.default_rng(seed)
    A = matrix(rng, n, reach)
    envelope, values = stored(A, side)
    factor = Factor(values, envelope)
    for right in (rng.normal(size=n), rng.normal(size=(n, 3))):
        np.testing.assert_allclose(factor.solve(right), np.linalg.solve(A, right), rtol=1e-9, atol=1e-12)


def test_a_band_needs_no_more_than_its_blocks():
    envelope, values = stored(np.eye(100) + np.diag(np.full(99, 0.1), -1), 10)
    assert envelope.width.tolist() == [10, *[20] * 9]
    assert len(values) == 10 * (10 + 9 * 20)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    A = np.eye(5)
    A[4, 3] = A[3, 4] = 2.0
    envelope, values = stored(A, 2)
    with pytest.raises(np.linalg.LinAlgError):
        Factor(values, envelope)
