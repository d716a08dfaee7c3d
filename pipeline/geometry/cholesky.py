"""Small positive definite systems; the library's call costs ten times more."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled


@compiled
def factorise(H: Float, L: Float) -> None:
    """Fill the lower triangle of L with that of H = L L^T, shape (n, n); H must be positive definite."""
    for a in range(H.shape[0]):
        for b in range(a):
            total = H[a, b]
            for k in range(b):
                total -= L[a, k] * L[b, k]
            L[a, b] = total / L[b, b]
        total = H[a, a]
        for k in range(a):
            total -= L[a, k] * L[a, k]
        L[a, a] = np.sqrt(total)


@compiled
def solve(L: Float, b: Float, x: Float) -> None:
    """Fill x with the solution of L L^T x = b, shape (n,)."""
    n = b.shape[0]
    for a in range(n):
        total = b[a]
        for k in range(a):
            total -= L[a, k] * x[k]
        x[a] = total / L[a, a]
    for a in range(n - 1, -1, -1):
        total = x[a]
        for k in range(a + 1, n):
            total -= L[k, a] * x[k]
        x[a] = total / L[a, a]
