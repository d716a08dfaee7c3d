"""Ground height of a plot: a raster below a whole cloud, computed in one pass over its points.

The lowest returns of each cell are kept. A single return below the others is noise, and so is a single cell
below its neighbours. A cell that is steeper above a lower one than the terrain can be is a stem, a bush or a
crown. Planes are fitted to the other cells, and holes are interpolated. Heights are relative to the plane of
the plot, so that the checks have the same limits on a hillside and on flat ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int32

UInt64 = NDArray[np.uint64]

CELL = 0.5  # m
KEPT = 8  # lowest returns of a cell
TOGETHER = 0.3  # m; a ground return has two more returns within this height above it
PIT = 0.5  # m; a cell this far below its neighbours is noise
TOLERANCE = 0.15  # m; grass and noise above the steepest slope
WINDOW = 2  # cells to each side to which a plane is fitted


@dataclass(frozen=True, slots=True, eq=False)
class TerrainRaster:
    """Heights of the ground at the centres of the cells of a raster.

    Attributes:
        low: Corner of the raster, shape (2,) [m].
        cell: Side of a cell [m].
        height: Heights at the centres of the cells, shape (columns, rows) [m]; interpolated where a cell
            has no ground returns.
        seen: Whether a cell has ground returns, shape (columns, rows).
    """

    low: Float
    cell: float
    height: Float
    seen: Bool

    def at(self, x: Float, y: Float) -> Float:
        """Return heights [m], shape (N,), at positions x, y of shape (N,) each [m], finite, by bilinear
        interpolation. Outside of the raster, the height at its border is returned."""
        return self.evaluate(x, y)[:, 0]

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy at positions x, y of shape (N,) each [m], finite; shape (N, 3).
        Outside of the raster, the values at its border are returned."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        return _evaluate(self.height, self.low, self.cell, np.ascontiguousarray(x), np.ascontiguousarray(y))


class LowestReturns:
    """Collects the lowest returns of each cell.

    Args:
        low, high: Corners of the raster, shape (2,) [m]; points outside are ignored.
    """

    def __init__(self, low: Float, high: Float) -> None:
        shape = np.maximum(np.ceil((high - low) / CELL).astype(np.int64), 1)
        self._low = low.astype(np.float64)
        self._lowest = np.full((shape[0], shape[1], KEPT, 3), np.inf, np.float32)
        self._count = np.zeros((shape[0], shape[1]), np.int32)
        self._occupied = np.zeros((shape[0], shape[1]), np.uint64)  # a bit per height bin, modulo 64

    @staticmethod
    def room(low: Float, high: Float) -> int:
        """Return the memory that a raster between two corners, shape (2,) [m], needs [bytes], before it is
        taken."""
        columns, rows = (max(int(np.ceil(v / CELL)), 1) for v in (high - low).tolist())
        return columns * rows * (12 * KEPT + 4 + 8)

    def add(self, points: Float32) -> None:
        """Add points of shape (N, 3) [m], finite; points outside of the raster are ignored."""
        _keep_lowest(points, self._low, self._lowest, self._count, self._occupied)

    def ground(self, slope_max: float) -> TerrainRaster:
        """Return the ground below all points so far; more points may follow. Without any point, the height is
        0 and nothing is seen.

        Args:
            slope_max: Largest slope of the terrain against the plane of the plot [rad].
        """
        ground = _supported(self._lowest, self._count)
        continuous = _continues_upwards(ground, self._occupied)
        trend = _trend(ground)
        ground[:, :, 2] -= ground[:, :, 0] * trend[0] + ground[:, :, 1] * trend[1] + trend[2]
        for _ in range(2):
            _remove_pits(ground, continuous)
        _remove_overhanging(ground, float(np.tan(slope_max)))
        height, seen = _planes(ground, self._low)
        _fill(height)
        x = self._low[0] + (np.arange(height.shape[0]) + 0.5) * CELL
        y = self._low[1] + (np.arange(height.shape[1]) + 0.5) * CELL
        height += x[:, None] * trend[0] + y[None, :] * trend[1] + trend[2]
        return TerrainRaster(self._low, CELL, height, seen)


def heights_above(points: Float32, ground: TerrainRaster) -> Float32:
    """Return the height of each point (N, 3) [m], finite, above the ground, float32, shape (N,) [m]; outside
    of the raster, above the ground at its border."""
    return _heights_above(points, ground.height, ground.low, ground.cell)


@compiled
def _keep_lowest(points: Float32, low: Float, lowest: Float32, count: Int32, occupied: UInt64) -> None:
    """Add points to the tables of `LowestReturns`, in place; points outside are ignored.

    Args:
        points: float32, shape (N, 3) [m].
        low: Corner of the raster, shape (2,) [m].
        lowest: KEPT lowest returns of each cell in ascending order, infinite where there are fewer, shape
            (columns, rows, KEPT, 3) [m].
        count: Number of returns of each cell, shape (columns, rows).
        occupied: Bits of the occupied height bins, see `_height_bit`, shape (columns, rows).
    """
    columns, rows = count.shape
    for i in range(points.shape[0]):
        a = int(np.floor((points[i, 0] - low[0]) / CELL))
        b = int(np.floor((points[i, 1] - low[1]) / CELL))
        if not (0 <= a < columns and 0 <= b < rows):
            continue
        cell = lowest[a, b]
        count[a, b] += 1
        z = points[i, 2]
        occupied[a, b] |= _height_bit(z, 0)
        if z >= cell[KEPT - 1, 2]:
            continue
        k = KEPT - 1
        while k > 0 and cell[k - 1, 2] > z:
            for c in range(3):
                cell[k, c] = cell[k - 1, c]
            k -= 1
        for c in range(3):
            cell[k, c] = points[i, c]


@compiled
def _height_bit(z: float, bins_above: int) -> np.uint64:
    """Return a mask with the bit of one height bin; bins are half of PIT high, and 64 bins in a row share no
    bit.

    Args:
        z: Height [m].
        bins_above: Number of bins above the bin of z.
    """
    return np.uint64(1) << np.uint64((int(np.floor(z / (0.5 * PIT))) + bins_above) & 63)


@compiled
def _supported(lowest: Float32, count: Int32) -> Float:
    """Return the lowest return of each cell that has two more returns close above it, shape (columns, rows,
    3) [m].

    Cells with fewer than three returns give their lowest return, and cells in which no return is supported
    the highest of the kept ones. An empty cell has infinite z.

    Args:
        lowest: Lowest returns of each cell, shape (columns, rows, KEPT, 3) [m].
        count: Number of returns of each cell, shape (columns, rows).
    """
    columns, rows = count.shape
    ground = np.zeros((columns, rows, 3))
    ground[:, :, 2] = np.inf
    for a in range(columns):
        for b in range(rows):
            kept = min(count[a, b], KEPT)
            if kept == 0:
                continue
            chosen = 0 if kept < 3 else kept - 1
            for k in range(kept - 2):
                if lowest[a, b, k + 2, 2] - lowest[a, b, k, 2] < TOGETHER:
                    chosen = k
                    break
            for c in range(3):
                ground[a, b, c] = lowest[a, b, chosen, c]
    return ground


def _trend(ground: Float) -> Float:
    """Return a, b, c of the plane z = a x + b y + c through the lowest cells of squares of 4 m, fitted
    robustly, shape (3,). With fewer than six squares it is level at their median height, without any at 0.

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m], infinite z for none.
    """
    squares = 8
    columns, rows = (-(-n // squares) * squares for n in ground.shape[:2])
    padded = np.full((columns, rows, 3), np.inf)
    padded[: ground.shape[0], : ground.shape[1]] = ground
    blocks = padded.reshape(columns // squares, squares, rows // squares, squares, 3).swapaxes(1, 2)
    blocks = blocks.reshape(-1, squares * squares, 3)
    place = blocks[np.arange(len(blocks)), blocks[:, :, 2].argmin(axis=1)]
    place = place[np.isfinite(place[:, 2])]
    middle = np.median(place[:, 2]) if len(place) else 0.0
    if len(place) < 6:
        return np.array([0.0, 0.0, middle])
    A = np.column_stack([place[:, :2], np.ones(len(place))])
    weight = np.ones(len(place))
    plane = np.array([0.0, 0.0, middle])
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        # A weak prior for level ground: squares in a row do not determine the slope across them.
        G = np.vstack([A * root, np.diag([0.3, 0.3, 0.0])])
        plane = np.linalg.lstsq(G, np.append(place[:, 2] * root[:, 0], np.zeros(3)), rcond=None)[0]
        off = np.abs(place[:, 2] - A @ plane)
        scale = max(float(np.median(off)), 0.1)
        weight = 1.0 / (1.0 + (off / scale) ** 2)
    return np.asarray(plane)


@compiled
def _remove_pits(ground: Float, continuous: Bool) -> None:
    """Remove isolated returns far below nearly all neighbouring cells: noise below the ground.

    Returns that continue upwards without a gap for the depth of a pit are not noise but, for example, the
    foot of a stem. In a cloud with little ground, the neighbours of such a cell are crowns.

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m]; removed cells get infinite z.
        continuous: Result of `_continues_upwards`, shape (columns, rows).
    """
    columns, rows = ground.shape[0], ground.shape[1]
    before = ground[:, :, 2].copy()
    around = np.empty(25)
    for a in range(columns):
        for b in range(rows):
            if before[a, b] == np.inf or continuous[a, b]:
                continue
            n = 0
            for i in range(max(a - 2, 0), min(a + 3, columns)):
                for j in range(max(b - 2, 0), min(b + 3, rows)):
                    if before[i, j] < np.inf and (i != a or j != b):
                        around[n] = before[i, j]
                        n += 1
            # The lower quartile: among crowns few cells are ground, and these are no pits.
            if n >= 4 and before[a, b] < np.sort(around[:n])[n // 4] - PIT:
                ground[a, b, 2] = np.inf


@compiled
def _continues_upwards(ground: Float, occupied: UInt64) -> Bool:
    """Return whether the height bins above the lowest return of each cell are occupied for the depth of a
    pit, shape (columns, rows).

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m].
        occupied: Bits of the occupied height bins of each cell, see `_height_bit`.
    """
    columns, rows = occupied.shape
    continuous = np.zeros((columns, rows), np.bool_)
    for a in range(columns):
        for b in range(rows):
            z = ground[a, b, 2]
            if z < np.inf:
                first, second = occupied[a, b] & _height_bit(z, 1), occupied[a, b] & _height_bit(z, 2)
                continuous[a, b] = first != 0 and second != 0
    return continuous


@compiled
def _remove_overhanging(ground: Float, slope: float) -> None:
    """Remove cells that are steeper above a lower cell than the terrain can be, in place.

    The cone of the maximum slope of each cell is propagated over the raster by two passes in each direction
    (a chamfer distance).

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m]; removed cells get infinite z.
        slope: Maximum slope (rise over run).
    """
    columns, rows = ground.shape[0], ground.shape[1]
    cone = ground[:, :, 2].copy()
    straight, across = slope * CELL, slope * CELL * np.sqrt(2.0)
    for _ in range(2):
        for turn in (1, -1):
            for p in range(columns):
                a = p if turn == 1 else columns - 1 - p
                for q in range(rows):
                    b = q if turn == 1 else rows - 1 - q
                    best = cone[a, b]
                    before, beside = a - turn, b - turn
                    if 0 <= before < columns:
                        best = min(best, cone[before, b] + straight)
                        if b - 1 >= 0:
                            best = min(best, cone[before, b - 1] + across)
                        if b + 1 < rows:
                            best = min(best, cone[before, b + 1] + across)
                    if 0 <= beside < rows:
                        best = min(best, cone[a, beside] + straight)
                    cone[a, b] = best
    for a in range(columns):
        for b in range(rows):
            if ground[a, b, 2] > cone[a, b] + TOLERANCE + straight:
                ground[a, b, 2] = np.inf


@compiled
def _planes(ground: Float, low: Float) -> tuple[Float, Bool]:
    """Return the height [m] at the centre of each cell with ground, NaN elsewhere, and which cells have
    ground; shape (columns, rows) each.

    The height is that of a plane fitted to the lowest returns of the cells up to WINDOW away; with fewer than
    three of them, the cell included, it is that of the cell's own lowest return.

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m], with infinite z in cells without ground.
        low: Corner of the raster, shape (2,) [m].
    """
    columns, rows = ground.shape[0], ground.shape[1]
    height = np.full((columns, rows), np.nan)
    seen = np.zeros((columns, rows), np.bool_)
    H, g = np.empty((3, 3)), np.empty(3)
    for a in range(columns):
        for b in range(rows):
            if ground[a, b, 2] == np.inf:
                continue
            seen[a, b] = True
            x, y = low[0] + (a + 0.5) * CELL, low[1] + (b + 0.5) * CELL
            H[:] = 0.0
            g[:] = 0.0
            H[0, 0] = H[1, 1] = 0.02  # prior for level ground
            n = 0
            for i in range(max(a - WINDOW, 0), min(a + WINDOW + 1, columns)):
                for j in range(max(b - WINDOW, 0), min(b + WINDOW + 1, rows)):
                    z = ground[i, j, 2]
                    if z < np.inf:
                        dx, dy = ground[i, j, 0] - x, ground[i, j, 1] - y
                        w = 1.0 / (1.0 + 8.0 * (dx * dx + dy * dy))
                        _add_row(H, g, dx, dy, z, w)
                        n += 1
            height[a, b] = np.linalg.solve(H, g)[2] if n >= 3 else ground[a, b, 2]
    return height, seen


@compiled
def _add_row(H: Float, g: Float, dx: float, dy: float, z: float, w: float) -> None:
    """Add one point to normal equations of a plane, in place.

    Args:
        H: Normal matrix, shape (3, 3).
        g: Right side, shape (3,).
        dx, dy: Position from the middle [m].
        z: Height [m].
        w: Weight.
    """
    row = (dx, dy, 1.0)
    for k in range(3):
        g[k] += w * row[k] * z
        for m in range(3):
            H[k, m] += w * row[k] * row[m]


def _fill(height: Float) -> None:
    """Replace NaN in heights, shape (columns, rows), by interpolated means of coarser and coarser cells (a
    pyramid), in place; by 0 if all are NaN."""
    if not np.isfinite(height).any():
        height[:] = 0.0
        return
    unknown = np.isnan(height)
    if not unknown.any():
        return
    columns, rows = (-(-n // 2) * 2 for n in height.shape)
    padded = np.full((columns, rows), np.nan)
    padded[: height.shape[0], : height.shape[1]] = height
    blocks = padded.reshape(columns // 2, 2, rows // 2, 2).swapaxes(1, 2).reshape(columns // 2, rows // 2, 4)
    known = np.isfinite(blocks)
    count = known.sum(axis=2)
    coarse = np.where(count > 0, np.where(known, blocks, 0.0).sum(axis=2) / np.maximum(count, 1), np.nan)
    _fill(coarse)
    at = np.indices(height.shape).reshape(2, -1) + 0.5
    ahead = _evaluate(coarse, np.zeros(2), 2.0, at[0], at[1])[:, 0].reshape(height.shape)
    height[unknown] = ahead[unknown]


@compiled
def _evaluate(height: Float, low: Float, cell: float, x: Float, y: Float) -> Float:
    """Return `ground_at` for positions x, y of shape (N,) each [m], shape (N, 3); arguments as in it."""
    out = np.empty((x.shape[0], 3))
    for i in range(x.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = ground_at(height, low, cell, x[i], y[i])
    return out


@compiled
def ground_at(height: Float, low: Float, cell: float, x: float, y: float) -> tuple[float, float, float]:
    """Return the height [m] of the raster at a position and its slopes along x and y. Outside of the raster,
    the values at its border are returned.

    Args:
        height: Heights at the centres of the cells, shape (columns, rows) [m].
        low: Corner of the raster, shape (2,) [m].
        cell: Side of a cell [m].
        x, y: The position [m].
    """
    columns, rows = height.shape
    u = min(max((x - low[0]) / cell - 0.5, 0.0), columns - 1.0)
    v = min(max((y - low[1]) / cell - 0.5, 0.0), rows - 1.0)
    a, b = min(int(u), max(columns - 2, 0)), min(int(v), max(rows - 2, 0))
    f, g = u - a, v - b
    a2, b2 = min(a + 1, columns - 1), min(b + 1, rows - 1)
    h00, h10, h01, h11 = height[a, b], height[a2, b], height[a, b2], height[a2, b2]
    z = (1 - f) * (1 - g) * h00 + f * (1 - g) * h10 + (1 - f) * g * h01 + f * g * h11
    gx = ((1 - g) * (h10 - h00) + g * (h11 - h01)) / cell
    gy = ((1 - f) * (h01 - h00) + f * (h11 - h10)) / cell
    return z, gx, gy


@compiled
def _heights_above(points: Float32, height: Float, low: Float, cell: float) -> Float32:
    """Return the result of `heights_above`; arguments of the raster as in `ground_at`."""
    above = np.empty(points.shape[0], np.float32)
    for i in range(points.shape[0]):
        above[i] = points[i, 2] - ground_at(height, low, cell, points[i, 0], points[i, 1])[0]
    return above
