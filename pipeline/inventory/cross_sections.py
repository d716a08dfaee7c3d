"""Circles in the horizontal slices of a plot, each of which may be a slice of a stem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.detection.clustering import dbscan_grid
from pipeline.geometry.poses import Float
from pipeline.inventory.circle import FIGURES, best_circle, fit_circle, on_circle, share_inside
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int

LOWEST, HIGHEST = 0.2, 6.2  # m above the ground; stems are followed between
STEP = 0.2  # m; between slices
THICK = 2  # steps that a slice is thick, so that neighbours overlap
LEAST = 8  # points on a circle
WINDOW = 0.6  # m; wider clusters are searched window by window, each twice as wide
WIDE = 1.6  # m
CIRCLES = 3  # in one cluster
HOLLOW = 0.25  # part of a circle's points that may lie inside it
SCATTER, SCATTER_OF_RADIUS = 0.05, 0.3  # m, and part of the radius
ARC = np.radians(70.0)  # of a circle that may begin a stem
NEAREST, EPS_MIN, EPS_MAX = 8, 0.05, 0.25  # neighbours; m
SLAB, INSIDE = FIGURES, FIGURES + 1  # columns of a circle beyond those of its fit


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """The points between LOWEST and HIGHEST above the ground, slice by slice.

    Attributes:
        points: float64, shape (N, 3): x, y [m], height above the ground [m], lowest slice first.
        bounds: shape (S + 1,): where each step of height begins.
        spacing: Usual distance to the eighth neighbour [m].
    """

    points: Float
    bounds: Int
    spacing: float

    def slab(self, k: int) -> Float:
        """The points of slice k, shape (M, 3)."""
        return self.points[self.bounds[k] : self.bounds[min(k + THICK, len(self.bounds) - 1)]]

    @property
    def count(self) -> int:
        """Number of slices."""
        return len(self.bounds) - THICK

    @staticmethod
    def middle(k: Float | Int) -> Float:
        """Height of the middle of slices above the ground [m]."""
        return LOWEST + STEP * (np.asarray(k, np.float64) + 0.5 * THICK)


def cut(points: Float32) -> Slices:
    """Cut points of shape (N, 4) (x, y, z, height above the ground) into slices."""
    steps = round((HIGHEST - LOWEST) / STEP)
    step = np.floor((points[:, 3] - LOWEST) / STEP).astype(np.int64)
    inside = (step >= 0) & (step < steps)
    points, step = points[inside], step[inside]
    order = np.argsort(step, kind="stable")
    bounds = np.searchsorted(step[order], np.arange(steps + 1))
    chosen = points[order][:, [0, 1, 3]].astype(np.float64)
    return Slices(chosen, bounds, _spacing(chosen))


def _spacing(points: Float) -> float:
    from scipy.spatial import cKDTree

    if len(points) <= NEAREST:
        return EPS_MAX
    part = points[:400_000] if len(points) <= 400_000 else points[:: len(points) // 400_000 + 1]
    thinned = (len(points) / len(part)) ** 0.5  # points lie on surfaces
    some = part[:: max(len(part) // 2000, 1)]
    distance: Float = cKDTree(part).query(some, k=NEAREST + 1)[0][:, -1]
    return float(np.median(distance) / thinned)


def find_circles(slices: Slices, r_min: float, r_max: float) -> Float:
    """All circles of all slices that may be stems.

    Args:
        slices: Of the plot.
        r_min, r_max: Radii that are looked for [m].

    Returns:
        Shape (K, FIGURES + 2): the figures of `fit_circle`, the slice, and the part of the points inside.
    """
    eps = float(np.clip(1.3 * slices.spacing, EPS_MIN, EPS_MAX))
    tolerance = float(np.clip(0.3 * slices.spacing, 0.01, 0.03))
    found = [np.zeros((0, FIGURES + 2))]
    for k in range(slices.count):
        xy = np.ascontiguousarray(slices.slab(k)[:, :2])
        label = dbscan_grid(xy, eps, 4)[0]
        order = np.argsort(label, kind="stable")
        order = order[label[order] >= 0]
        clusters = int(label.max(initial=-1)) + 1
        bounds = np.searchsorted(label[order], np.arange(clusters + 1))
        found.append(_circles(xy[order], bounds, tolerance, r_min, r_max, float(k)))
    return np.concatenate(found)


@compiled
def _circles(xy: Float, bounds: Int, tolerance: float, r_min: float, r_max: float, k: float) -> Float:
    out = np.empty((64, FIGURES + 2))
    n = 0
    for c in range(bounds.shape[0] - 1):
        members = xy[bounds[c] : bounds[c + 1]]
        if members.shape[0] < LEAST:
            continue
        x0, y0 = members[:, 0].min(), members[:, 1].min()
        wide = max(members[:, 0].max() - x0, members[:, 1].max() - y0)
        if wide <= WIDE:
            n, out = _peel(members, tolerance, r_min, r_max, k, n, out)
            continue
        order, cells, across = _in_windows(members, x0, y0, wide)
        for a in range(across):
            for b in range(across):
                part = _window(members, order, cells, across, a, b)
                if part.shape[0] >= LEAST:
                    n, out = _peel(part, tolerance, r_min, r_max, k, n, out)
    return out[:n]


@compiled
def _in_windows(xy: Float, x0: float, y0: float, wide: float) -> tuple[Int, Int, int]:
    """Points in the order of square cells of WINDOW, and where each cell begins."""
    across = int(wide / WINDOW) + 1
    cell = np.empty(xy.shape[0], np.int64)
    cells = np.zeros(across * across + 1, np.int64)
    for i in range(xy.shape[0]):
        cell[i] = int((xy[i, 0] - x0) / WINDOW) * across + int((xy[i, 1] - y0) / WINDOW)
        cells[cell[i] + 1] += 1
    cells = np.cumsum(cells)
    place, order = cells[:-1].copy(), np.empty(xy.shape[0], np.int64)
    for i in range(xy.shape[0]):
        order[place[cell[i]]] = i
        place[cell[i]] += 1
    return order, cells, across


@compiled
def _window(xy: Float, order: Int, cells: Int, across: int, a: int, b: int) -> Float:
    """The points of a cell and of the next ones along x and y."""
    n = 0
    for i in range(a, min(a + 2, across)):
        n += cells[i * across + min(b + 2, across)] - cells[i * across + b]
    part = np.empty((n, 2))
    n = 0
    for i in range(a, min(a + 2, across)):
        for m in range(cells[i * across + b], cells[i * across + min(b + 2, across)]):
            part[n] = xy[order[m]]
            n += 1
    return part


@compiled
def _peel(
    xy: Float, tolerance: float, r_min: float, r_max: float, k: float, n: int, out: Float
) -> tuple[int, Float]:
    """Circles of one cluster, one after the other, what lies on one taken away before the next."""
    rest = xy
    row = np.zeros(FIGURES + 2)
    for _ in range(CIRCLES):
        if rest.shape[0] < LEAST or best_circle(rest, tolerance, r_min, r_max, row) < 0.5 * LEAST:
            break
        x, y, r = row[0], row[1], row[2]
        if fit_circle(rest, max(3.0 * tolerance, 0.25 * r), r_min, r_max, row):
            x, y, r = row[0], row[1], row[2]
            row[SLAB], row[INSIDE] = k, share_inside(rest, x, y, r)
            clear = row[7] <= min(SCATTER, max(SCATTER_OF_RADIUS * r, 0.01))
            if row[9] >= LEAST and row[8] >= ARC and row[INSIDE] <= HOLLOW and clear:
                if n == out.shape[0]:
                    out = np.concatenate((out, np.empty_like(out)))
                out[n] = row
                n += 1
        rest = rest[~on_circle(rest, x, y, r, 2.0 * tolerance)]
    return n, out
