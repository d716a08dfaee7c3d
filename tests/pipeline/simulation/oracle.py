"""A slow intersection of rays and solids in plain NumPy, written independently of the compiled one, as
reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.primitives import BOX, CONE, Solids
from pipeline.simulation.terrain import SimulatedTerrain

Float = NDArray[np.float64]


def cone_range(shape: Float, o: Float, d: Float) -> Float:
    """Entry into the mantle: the plane through the axis gives a quadratic, here by np.roots' formula."""
    axis = shape[3:6]
    w = o - shape[:3]
    # |p - (p.u)u|^2 = (r0 + k p.u)^2 for p = w + t d, collected by powers of t.
    w_side, d_side = w - np.outer(w @ axis, axis), d - np.outer(d @ axis, axis)
    radius, rate = shape[7] + shape[8] * (w @ axis), shape[8] * (d @ axis)
    a = np.sum(d_side**2, axis=1) - rate**2
    b = 2.0 * (np.sum(w_side * d_side, axis=1) - radius * rate)
    c = np.sum(w_side**2, axis=1) - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):
        t = (-b - np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    h = w @ axis + t * (d @ axis)
    good = (t > 0.0) & (h >= 0.0) & (h <= shape[6])
    return np.where(good, t, np.inf)


def to_local(shape: Float, o: Float, d: Float) -> tuple[Float, Float]:
    """Rays in the frame of an ellipsoid or box, scaled to half sizes of 1."""
    c, s = shape[6], shape[7]
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return ((o - shape[:3]) @ turn.T) / shape[3:6], (d @ turn.T) / shape[3:6]


def ellipsoid_range(shape: Float, o: Float, d: Float) -> Float:
    """Entry into the unit sphere: nearest point of the line to its centre, then back by Pythagoras."""
    p, q = to_local(shape, o, d)
    length = np.linalg.norm(q, axis=1)
    unit = q / length[:, None]
    nearest = -np.sum(p * unit, axis=1)
    off = np.sum((p + nearest[:, None] * unit) ** 2, axis=1)
    with np.errstate(invalid="ignore"):
        t = (nearest - np.sqrt(1.0 - off)) / length
    return np.where((off < 1.0) & (t > 0.0), t, np.inf)


def box_range(shape: Float, o: Float, d: Float) -> Float:
    """Entry into the unit cube: the nearest of its six faces whose hit point lies on the face."""
    p, q = to_local(shape, o, d)
    best = np.full(len(p), np.inf)
    for axis in range(3):
        for side in (-1.0, 1.0):
            with np.errstate(invalid="ignore", divide="ignore"):
                t = (side - p[:, axis]) / q[:, axis]
                at = np.abs(p + t[:, None] * q)
            at[:, axis] = 0.0
            good = (t > 0.0) & (at.max(axis=1) <= 1.0)
            best = np.where(good, np.minimum(best, t), best)
    return best


def first_ranges(solids: Solids, o: Float, d: Float) -> Float:
    """Range of the first hit of each ray (N, 3) on any solid; none of them porous."""
    best = np.full(len(o), np.inf)
    for kind, shape in zip(solids.kind, solids.shape, strict=True):
        meet = cone_range if kind == CONE else box_range if kind == BOX else ellipsoid_range
        best = np.minimum(best, meet(shape, o, d))
    return best


def ground_ranges(terrain: SimulatedTerrain, o: Float, d: Float, farthest: float) -> Float:
    """Range at which rays go under the terrain: steps of 2 cm, then halving."""
    out = np.full(len(o), np.inf)
    steps = np.arange(0.0, farthest, 0.02)
    for n in range(len(o)):
        p = o[n] + steps[:, None] * d[n]
        under = np.nonzero(p[:, 2] < terrain.height(p[:, 0], p[:, 1]))[0]
        if under.size == 0 or under[0] == 0:
            continue
        low, high = steps[under[0] - 1], steps[under[0]]
        for _ in range(40):
            middle = 0.5 * (low + high)
            q = o[n] + middle * d[n]
            below = q[2] < terrain.height(q[:1], q[1:2])[0]
            low, high = (low, middle) if below else (middle, high)
        out[n] = high
    return out
