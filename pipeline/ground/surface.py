"""The surface that candidates of the ground carry: a plane as the trend, and a membrane on it."""

from __future__ import annotations

import numpy as np

from pipeline.ground.terrain import SECTORS, ring_distance
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float

FAR = 12.0  # m; candidates farther away say less of the trend
LEVEL = 4.0  # m^2; how surely the trend is level, in candidates a metre away
STIFFNESS = 0.15  # of the membrane, against a cell that surely is ground
ABOVE, BELOW = 0.08, 0.25  # m; farther from the surface a candidate pulls with the same force only
FIRM = 0.7  # weight of a candidate that the surface passes above
SEEN_WITHIN = 0.15  # m
ROUNDS, TREND_ROUNDS = 3, 4
X, Y, Z = 0, 1, 2


@compiled
def trend(lowest: Float, slope: float) -> Float:
    """A plane through the candidates, the lower ones first: shape (3,), height at the origin [m], slopes.

    Least squares, reweighted: what lies above the plane pulls with a force that no longer grows.
    """
    sectors, rings = lowest.shape[0], lowest.shape[1]
    rows = np.empty((sectors * rings, 3))
    n = 0
    for s in range(sectors):
        for k in range(rings):
            if lowest[s, k, Z] < np.inf:
                rows[n] = lowest[s, k]
                n += 1
    plane: Float = np.zeros(3)
    if n == 0:
        return plane
    plane[0] = np.median(rows[:n, Z])
    for _ in range(TREND_ROUNDS):
        A, b = np.zeros((3, 3)), np.zeros(3)
        A[1, 1] = A[2, 2] = LEVEL
        for i in range(n):
            x, y, z = rows[i, X], rows[i, Y], rows[i, Z]
            d = z - plane[0] - plane[1] * x - plane[2] * y
            w = 1.0 / (1.0 + (x * x + y * y) / (FAR * FAR))
            w *= ABOVE / d if d > ABOVE else (BELOW / -d if d < -BELOW else 1.0)
            A[0, 0] += w
            A[0, 1] += w * x
            A[0, 2] += w * y
            A[1, 1] += w * x * x
            A[1, 2] += w * x * y
            A[2, 2] += w * y * y
            b[0] += w * z
            b[1] += w * x * z
            b[2] += w * y * z
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        plane[:] = np.linalg.solve(A, b)
    steep = np.sqrt(plane[1] ** 2 + plane[2] ** 2)
    if steep > slope:
        plane[1] *= slope / steep
        plane[2] *= slope / steep
    return plane


@compiled
def smooth_surface(height: Float, weight: Float, plane: Float) -> tuple[Float, Bool]:
    """The membrane h that minimises sum w (h - z)^2 + sum c (h_i - h_j)^2 over neighbouring cells i, j.

    Lines along and across the rays are solved in turn. Far above or below the surface a candidate's pull
    stops growing; one below it pulls as firmly as the surest.

    Args:
        height, weight: shape (SECTORS, rings), see `evidence`; plane: shape (3,).

    Returns:
        The heights of the nodes [m] and whether the ground was seen there, both of the same shape.
    """
    sectors, rings = height.shape
    along, across = _couplings(rings)
    h = np.zeros((sectors, rings))
    w, wz = np.zeros((sectors, rings)), np.zeros((sectors, rings))
    for turn in range(ROUNDS):
        for s in range(sectors):
            for k in range(rings):
                if height[s, k] == height[s, k]:
                    d = height[s, k] - h[s, k] if turn > 0 else 0.0
                    w[s, k] = weight[s, k] if d >= 0.0 else FIRM
                    w[s, k] *= ABOVE / d if d > ABOVE else (BELOW / -d if d < -BELOW else 1.0)
                    wz[s, k] = w[s, k] * height[s, k]
        _solve_rays(h, w, wz, along, across)
        _solve_circles(h, w, wz, along, across)
    seen = np.zeros((sectors, rings), np.bool_)
    for s in range(sectors):
        for k in range(rings):
            seen[s, k] = weight[s, k] > 0.25 and abs(height[s, k] - h[s, k]) < SEEN_WITHIN
            x, y = _middle(s, k)
            h[s, k] += plane[0] + plane[1] * x + plane[2] * y
    return h, seen


@compiled
def _couplings(rings: int) -> tuple[Float, Float]:
    """Stiffness between a node and the next one outwards, and the next one around, by ring."""
    along, across = np.zeros(rings), np.zeros(rings)
    for k in range(rings):
        wide = ring_distance(k + 0.5) * 2.0 * np.pi / SECTORS
        deep = ring_distance(k + 1.0) - ring_distance(k + 0.0)
        across[k] = STIFFNESS * deep / wide
        if k + 1 < rings:
            between = ring_distance(k + 1.5) - ring_distance(k + 0.5)
            along[k] = STIFFNESS * ring_distance(k + 1.0) * 2.0 * np.pi / SECTORS / between
    return along, across


@compiled
def _solve_rays(h: Float, w: Float, wz: Float, along: Float, across: Float) -> None:
    """Thomas' algorithm along each ray, its neighbours as they are."""
    sectors, rings = h.shape
    upper, right = np.empty(rings), np.empty(rings)
    for s in range(sectors):
        left, after = h[s - 1], h[(s + 1) % sectors]
        inner = 0.0
        for k in range(rings):
            pivot = w[s, k] + 2.0 * across[k] + inner + along[k]
            value = wz[s, k] + across[k] * (left[k] + after[k])
            if k > 0:
                pivot -= inner * upper[k - 1]
                value += inner * right[k - 1]
            upper[k], right[k] = along[k] / pivot, value / pivot
            inner = along[k]
        h[s, rings - 1] = right[rings - 1]
        for k in range(rings - 2, -1, -1):
            h[s, k] = right[k] + upper[k] * h[s, k + 1]


@compiled
def _solve_circles(h: Float, w: Float, wz: Float, along: Float, across: Float) -> None:
    """The same around each circle, all of them at once; the seam is coupled to the values before."""
    sectors, rings = h.shape
    upper, right = np.empty((sectors, rings)), np.empty((sectors, rings))
    for s in range(sectors):
        for k in range(rings):
            pivot = w[s, k] + 2.0 * across[k] + along[k]
            value = wz[s, k]
            if k > 0:
                pivot += along[k - 1]
                value += along[k - 1] * h[s, k - 1]
            if k + 1 < rings:
                value += along[k] * h[s, k + 1]
            if s == 0:
                value += across[k] * h[sectors - 1, k]
            else:
                pivot -= across[k] * upper[s - 1, k]
                value += across[k] * right[s - 1, k]
            if s == sectors - 1:
                value += across[k] * h[0, k]
            upper[s, k], right[s, k] = across[k] / pivot, value / pivot
    for k in range(rings):
        h[sectors - 1, k] = right[sectors - 1, k]
    for s in range(sectors - 2, -1, -1):
        for k in range(rings):
            h[s, k] = right[s, k] + upper[s, k] * h[s + 1, k]


@compiled
def _middle(sector: int, ring: int) -> tuple[float, float]:
    """Place of a node [m]: the inverse of `direction_turn` at the middle of its cell."""
    turn = 4.0 * (sector + 0.5) / SECTORS - 1.0
    if turn < 0.0:
        x, y = -abs(turn), -(1.0 - abs(turn))
    elif turn < 2.0:
        y = turn - 1.0
        x = 1.0 - abs(y)
    else:
        y = 3.0 - turn
        x = -(1.0 - abs(y))
    scale = ring_distance(ring + 0.5) / np.sqrt(x * x + y * y)
    return x * scale, y * scale
