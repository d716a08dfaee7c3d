"""Order of numbers: kernels in place of Numba's `argsort`, `sort` and `median`, each of which takes about a
second to compile."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled

Int = NDArray[np.int64]

#: Length of the runs that are sorted by insertion before they are merged (20 in NumPy).
RUN = 20


@compiled
def ascending_rows(values: Float) -> Int:
    """Return the rows of numbers in ascending order, those of equal numbers in their own order (merge sort),
    int64, shape (N,).

    Args:
        values: Numbers, without NaN, shape (N,).
    """
    n = values.shape[0]
    rows, merged = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        begin, at = i - i % RUN, i
        while at > begin and values[rows[at - 1]] > values[i]:
            rows[at] = rows[at - 1]
            at -= 1
        rows[at] = i
    width = RUN
    while width < n:
        for begin in range(0, n, 2 * width):
            middle, end = min(begin + width, n), min(begin + 2 * width, n)
            a, b = begin, middle
            for k in range(begin, end):
                if a < middle and (b == end or values[rows[a]] <= values[rows[b]]):
                    merged[k] = rows[a]
                    a += 1
                else:
                    merged[k] = rows[b]
                    b += 1
        rows, merged = merged, rows
        width *= 2
    return rows


@compiled
def ascending(values: Float) -> Float:
    """Return numbers in ascending order, shape (N,).

    Args:
        values: Numbers, without NaN, shape (N,).
    """
    rows, ordered = ascending_rows(values), np.empty(values.shape[0])
    for k in range(rows.shape[0]):
        ordered[k] = values[rows[k]]
    return ordered


@compiled
def select(values: Float, k: int) -> float:
    """Return the number with `k` smaller or equal ones before it in ascending order, and reorder the numbers
    in place: it is in row k, no greater number is before it and no smaller one behind it (quickselect).

    Args:
        values: Numbers, without NaN, shape (N,).
        k: 0 to N - 1.
    """
    low, high = 0, values.shape[0] - 1
    while low < high:
        pivot, i, j = values[(low + high) // 2], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(values[k])


@compiled
def median(values: Float) -> float:
    """Return the median of numbers without NaN, shape (N,), N at least 1; they are reordered in place."""
    half = values.shape[0] // 2
    upper = select(values, half)
    if values.shape[0] % 2 == 1:
        return upper
    lower = values[0]
    for i in range(half):
        lower = max(lower, values[i])
    return float((lower + upper) / 2)


@compiled
def quantile(values: Float, part: float) -> float:
    """Return the quantile `part`, 0 to 1, of numbers without NaN, with linear interpolation. The numbers,
    shape (N,), N at least 1, are reordered in place."""
    at = part * (values.shape[0] - 1)
    k = int(at)
    lower = select(values, k)
    upper = lower if k + 1 == values.shape[0] else np.inf
    for i in range(k + 1, values.shape[0]):
        upper = min(upper, values[i])
    return float(lower + (at - k) * (upper - lower))
