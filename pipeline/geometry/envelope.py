"""Cholesky factorisation of a sparse symmetric matrix within its envelope (George, Liu 1981, chapter 4).

The envelope of a row reaches from its first entry to the diagonal, and the factor has no entry outside of it.
An order of the unknowns that puts coupled ones near each other (Cuthill, McKee 1969) keeps it small. Rows are
stored in blocks of equal height, so that all products are those of dense matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.pose_arrays import Int
from pipeline.geometry.poses import Float


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """Places of the entries of a matrix of N block rows in one array.

    Attributes:
        count: Number of rows of the matrix; the last block row may have more.
        side: Height and width of a block.
        first: First block in the envelope of each block row, int64, shape (N,).
        width: Number of columns of each block row up to the diagonal block, with it, int64, shape (N,).
        offset: Place of the first entry of each block row, and the number of entries, int64, shape (N + 1,).
    """

    count: int
    side: int
    first: Int
    width: Int
    offset: Int

    @classmethod
    def of(cls, rows: Int, columns: Int, count: int, side: int) -> Envelope:
        """Return the envelope of a matrix with `count` rows, which are filled up to whole blocks.

        Args:
            rows, columns: Places of its entries, int64, shape (E,). Entries above the diagonal are ignored.
            count: Number of rows.
            side: Height and width of a block.
        """
        blocks = -(-count // side)
        first = np.arange(blocks)
        np.minimum.at(first, rows // side, columns // side)
        width = side * (np.arange(blocks) - first + 1)
        return cls(count, side, first, width, np.r_[0, np.cumsum(side * width)])

    def rows(self, values: Float) -> list[Float]:
        """Return the block rows of an array of values as views, each of the shape (side, width)."""
        return [part.reshape(self.side, -1) for part in np.split(values, self.offset[1:-1])]


class Factor:
    """The factor L of a positive definite matrix A = L L^T.

    Args:
        values: Entries of A on and below the diagonal in the places of the envelope; overwritten by L, with
            inverse diagonal blocks.
        envelope: The envelope.

    Raises:
        LinAlgError: A is not positive definite.
    """

    def __init__(self, values: Float, envelope: Envelope) -> None:
        self._envelope, self._rows = envelope, envelope.rows(values)
        side, first, rows = envelope.side, envelope.first, self._rows
        for i, row in enumerate(rows):
            for j in range(first[i], i + 1):
                low = max(first[i], first[j])
                block = row[:, side * (j - first[i]) :][:, :side]
                left = row[:, side * (low - first[i]) : side * (j - first[i])]
                above = rows[j][:, side * (low - first[j]) : side * (j - first[j])]
                block -= left @ above.T
                if j < i:
                    block[:] = block @ rows[j][:, -side:].T
                else:
                    block[:] = np.linalg.inv(np.linalg.cholesky(block))

    def solve(self, right: Float) -> Float:
        """Return the solution of A x = b for right-hand sides, shape (n,) or (n, M), of at most as many rows
        as the matrix; of the same shape."""
        side, first = self._envelope.side, self._envelope.first
        x = np.zeros((side * len(self._rows), *right.shape[1:]))
        x[: len(right)] = right
        for i, row in enumerate(self._rows):
            x[side * i :][:side] -= row[:, :-side] @ x[side * first[i] : side * i]
            x[side * i :][:side] = row[:, -side:] @ x[side * i :][:side]
        for i, row in reversed(list(enumerate(self._rows))):
            x[side * i :][:side] = row[:, -side:].T @ x[side * i :][:side]
            x[side * first[i] : side * i] -= row[:, :-side].T @ x[side * i :][:side]
        return x[: len(right)]
