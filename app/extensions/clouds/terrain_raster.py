"""Ground height of a plot: a raster below a whole cloud, computed in one pass over its points.

The lowest returns of each cell are kept. A single return below the others is noise, and so are few returns
below the neighbouring cells. A cell that is steeper above a lower one than the terrain can be is a stem, a
bush or a crown. The other cells are interpolated and smoothed. Heights are relative to the plane of the plot,
so that the checks have the same limits on a hillside and on flat ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float
from pipeline.ground.scan_ground import TOLERANCE
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int, Int32

UInt16 = NDArray[np.uint16]
UInt64 = NDArray[np.uint64]

CELL = 0.5  # m
KEPT = 8  # lowest returns of a cell
TOGETHER = 0.3  # m; a ground return has two more returns within this height above it
PIT = 0.5  # m; a cell this far below its neighbours is noise
AT_ONCE = 1_000_000  # points whose heights are computed at once, to bound the memory
#: Side of a column and height of its bins [m], and number of bins. Their counts distinguish the ground from
#: noise below it. A point 64 m higher counts in the same bin.
COLUMN, BIN, BINS = 2.0, 0.25, 256
#: Share of the points of a column that is more than noise in one bin (one per cent of noise is in several),
#: depth below this bin in which nothing but noise is, least depth of that on average [m], and least share of
#: the bins there that noise occupies. Of real plots, the depth is 0 to 0.5 m, and 3 m and more with noise.
DENSE, CLEARLY_BELOW, DEEP, OCCUPIED = 0.005, 1.0, 1.25, 0.05
#: Share of the points of a plot that noise below its ground may have: one per cent, and a margin of counts.
MOST_NOISE = 0.012
BLOCK = 32  # columns of the raster whose neighbours are sorted at once, likewise


@dataclass(frozen=True, slots=True, eq=False)
class TerrainRaster:
    """Heights of the ground at the centres of the cells of a raster.

    Attributes:
        low: Corner of the raster with the minimum x and y, shape (2,) [m].
        cell: Side of a cell [m].
        height: Heights at the centres of the cells, shape (columns, rows) [m]; interpolated where a cell
            has no ground returns.
        seen: Whether a cell has ground returns, shape (columns, rows).
        covered: Whether a cell has any point, shape (columns, rows).
    """

    low: Float
    cell: float
    height: Float
    seen: Bool
    covered: Bool

    def at(self, x: Float, y: Float) -> Float:
        """Return heights [m], shape (N,), at positions x, y of shape (N,) each [m], finite, by bilinear
        interpolation. Outside of the raster, the height at its border is returned."""
        return self.evaluate(x, y)[:, 0]

    def evaluate(self, x: Float, y: Float) -> Float:
        """Return height [m], dz/dx and dz/dy at positions x, y of shape (N,) each [m], finite; shape (N, 3).
        Outside of the raster, the values at its border are returned."""
        columns, rows = self.height.shape
        u = np.clip((x - self.low[0]) / self.cell - 0.5, 0.0, columns - 1.0)
        v = np.clip((y - self.low[1]) / self.cell - 0.5, 0.0, rows - 1.0)
        a = np.minimum(u.astype(np.int64), max(columns - 2, 0))
        b = np.minimum(v.astype(np.int64), max(rows - 2, 0))
        f, g = u - a, v - b
        a2, b2 = np.minimum(a + 1, columns - 1), np.minimum(b + 1, rows - 1)
        h = self.height
        h00, h10, h01, h11 = h[a, b], h[a2, b], h[a, b2], h[a2, b2]
        z = (1 - f) * (1 - g) * h00 + f * (1 - g) * h10 + (1 - f) * g * h01 + f * g * h11
        gx = ((1 - g) * (h10 - h00) + g * (h11 - h01)) / self.cell
        gy = ((1 - f) * (h01 - h00) + f * (h11 - h10)) / self.cell
        return np.column_stack([z, gx, gy])

    def covered_places(self) -> Float:
        """Return the centres of the cells with any point, shape (N, 2) [m]."""
        return self.low + (np.argwhere(self.covered) + 0.5) * self.cell

    def cells_seen_around(self, places: Float) -> Int:
        """Return the number of cells with ground returns among the 3 x 3 cells around each position, shape
        (N,); outside of the raster, around its nearest cell. `places` have the shape (N, 2) [m]."""
        from scipy.ndimage import convolve

        count = convolve(self.seen.astype(np.int64), np.ones((3, 3), np.int64), mode="constant")
        found: Int = count[tuple(self.cell_of(places).T)]
        return found

    def cell_of(self, places: Float | Float32) -> Int:
        """Return the column and row of the cell at each position of shape (N, 2) [m], int64, shape (N, 2);
        outside of the raster, those of its nearest cell."""
        cell = np.floor((places - self.low) / self.cell).astype(np.int64)
        nearest: Int = np.clip(cell, 0, np.array(self.height.shape) - 1)
        return nearest


class NoiseBelow:
    """Finds the level below which the points of a plot are noise, such as reflections of wet ground.

    `LowestReturns` leaves out a few noise points of a cell, but not one per cent of the points of a dense
    cloud. Noise is spread over the heights, and the ground is in few bins.

    Args:
        low, high: Corners of the plot, shape (2,) [m]; points outside are ignored.
    """

    def __init__(self, low: Float, high: Float) -> None:
        shape = np.maximum(np.ceil((high - low) / COLUMN).astype(np.int64), 1)
        self._low = low.astype(np.float64)
        self._count = np.zeros((shape[0], shape[1], BINS), np.uint16)
        self._lowest = np.full((shape[0], shape[1]), np.inf)

    def add(self, points: Float32) -> None:
        """Add points of shape (N, 3) [m], finite."""
        _count_bins(points, self._low, self._count, self._lowest)

    def floor(self) -> Float | None:
        """Return the level of each column below which points are noise, shape (columns, rows) [m], inf for a
        column without others; None if there is hardly any noise, as in most plots.

        Noise is in the bins CLEARLY_BELOW the lowest bin with DENSE of the points of its column. Its mean is
        known by the share of these bins that is occupied (Poisson); if they have more points, they are no
        noise. The level is the lowest bin with 5 standard deviations and 3 points more.
        """
        known = np.isfinite(self._lowest)
        first = np.floor(self._lowest[known] / BIN).astype(np.int64)
        bins = (first[:, None] + np.arange(BINS)) % BINS
        n = np.take_along_axis(self._count[known], bins, axis=1).astype(np.float64)
        dense = (n >= DENSE * n.sum(axis=1, keepdims=True)).argmax(axis=1)
        # The lowest bin of a column has a point by its choice.
        is_below = (np.arange(BINS) >= 1) & (np.arange(BINS) < dense[:, None] - round(CLEARLY_BELOW / BIN))
        below = n[is_below]
        is_shallow = len(below) * BIN < DEEP * len(n) or not len(n)
        # A larger share of the points is undergrowth over ground that is hardly seen.
        is_shallow |= bool(below.sum() > MOST_NOISE * n.sum())
        if is_shallow or (share := float((below > 0.0).mean())) < OCCUPIED:
            return None
        noise = max(-np.log(max(1.0 - share, 0.01)), float(np.median(below)))  # nearly all may be occupied
        most = noise + 5.0 * np.sqrt(noise) + 3.0
        if np.percentile(below[below > 0.0], 80) > most:  # stems below crowns, whose ground is hardly seen
            return None
        is_more = n >= most
        floor = np.full(known.shape, np.inf)
        floor[known] = np.where(is_more.any(axis=1), (first + is_more.argmax(axis=1)) * BIN, np.inf)
        return floor

    def is_above(self, points: Float32, floor: Float) -> Bool:
        """Return whether points of shape (N, 3) [m] are above the floor of their column, shape (N,)."""
        place = np.floor((points[:, :2] - self._low) / COLUMN).astype(np.int64)
        column = np.clip(place, 0, np.array(floor.shape) - 1)
        above: Bool = points[:, 2] >= floor[column[:, 0], column[:, 1]]
        return above


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
        """Return the memory that a raster between two corners, shape (2,) [m], needs with the columns of
        `NoiseBelow` [bytes], before it is taken."""
        columns, rows = (max(int(np.ceil(v / CELL)), 1) for v in (high - low).tolist())
        return columns * rows * (12 * KEPT + 4 + 8) + int(columns * rows * (CELL / COLUMN) ** 2) * 2 * BINS

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
        upright = _continues_upwards(ground[:, :, 2], self._occupied)
        trend = _trend(ground)
        z = ground[:, :, 2] - ground[:, :, :2] @ trend[:2] - trend[2]
        for _ in range(2):
            _remove_pits(z, upright)
        # A cell that is steeper above a lower one than the terrain can be is not ground.
        rise = float(np.tan(slope_max)) * CELL
        z[z > _lowest_cone(z, rise) + TOLERANCE + rise] = np.inf
        seen = np.isfinite(z)
        centre = self._low + (np.moveaxis(np.indices(z.shape), 0, -1) + 0.5) * CELL
        height = _interpolated(ground[seen][:, :2], z[seen], centre)
        height += centre @ trend[:2] + trend[2]
        return TerrainRaster(self._low, CELL, height, seen, self._count > 0)


def heights_above(points: Float32, ground: TerrainRaster) -> Float32:
    """Return the height of each point (N, 3) [m], finite, above the ground, float32, shape (N,) [m]; outside
    of the raster, above the ground at its border."""
    above = np.empty(len(points), np.float32)
    for first in range(0, len(points), AT_ONCE):
        x, y, z = points[first : first + AT_ONCE].T.astype(np.float64)
        above[first : first + AT_ONCE] = z - ground.at(x, y)
    return above


@compiled
def _count_bins(points: Float32, low: Float, count: UInt16, lowest: Float) -> None:
    """Add points to the tables of `NoiseBelow`, in place; points outside are ignored.

    Args:
        points: Points, float32, shape (N, 3) [m].
        low: Corner of the columns, shape (2,) [m].
        count: Number of points of each bin, at most 65535, shape (columns, rows, BINS).
        lowest: Lowest point of each column, shape (columns, rows) [m].
    """
    columns, rows = lowest.shape
    for i in range(points.shape[0]):
        a = int(np.floor((points[i, 0] - low[0]) / COLUMN))
        b = int(np.floor((points[i, 1] - low[1]) / COLUMN))
        if not (0 <= a < columns and 0 <= b < rows):
            continue
        z = float(points[i, 2])
        lowest[a, b] = min(lowest[a, b], z)
        bin_ = int(np.floor(z / BIN)) % BINS
        if count[a, b, bin_] < 65535:
            count[a, b, bin_] += 1


@compiled
def _keep_lowest(points: Float32, low: Float, lowest: Float32, count: Int32, occupied: UInt64) -> None:
    """Add points to the tables of `LowestReturns`, in place; points outside are ignored.

    Args:
        points: Points, float32, shape (N, 3) [m].
        low: Corner of the raster, shape (2,) [m].
        lowest: KEPT lowest returns of each cell in ascending order, infinite where there are fewer, shape
            (columns, rows, KEPT, 3) [m].
        count: Number of returns of each cell, shape (columns, rows).
        occupied: Bits of the occupied height bins of each cell, half of PIT high and modulo 64, same shape.
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
        occupied[a, b] |= np.uint64(1) << np.uint64(int(np.floor(z / (0.5 * PIT))) & 63)
        if z >= cell[KEPT - 1, 2]:
            continue
        k = KEPT - 1
        while k > 0 and cell[k - 1, 2] > z:
            for c in range(3):
                cell[k, c] = cell[k - 1, c]
            k -= 1
        for c in range(3):
            cell[k, c] = points[i, c]


def _supported(lowest: Float32, count: Int32) -> Float:
    """Return the lowest return of each cell that has two more returns close above it, shape (columns, rows,
    3) [m].

    Cells with fewer than three returns give their lowest return, and cells in which no return is supported
    the highest of the kept ones. An empty cell has the position 0 and infinite z.

    Args:
        lowest: Lowest returns of each cell, shape (columns, rows, KEPT, 3) [m].
        count: Number of returns of each cell, shape (columns, rows).
    """
    z, kept = lowest[:, :, :, 2], np.minimum(count, KEPT)
    together = np.zeros((*count.shape, KEPT), np.bool_)
    with np.errstate(invalid="ignore"):  # of two infinite heights
        together[:, :, :-2] = z[:, :, 2:] - z[:, :, :-2] < TOGETHER
    unsupported = np.where(kept < 3, 0, kept - 1)
    chosen = np.where(together.any(axis=2), together.argmax(axis=2), unsupported)
    ground = np.take_along_axis(lowest, chosen[:, :, None, None], axis=2)[:, :, 0].astype(np.float64)
    ground[kept == 0] = 0.0, 0.0, np.inf
    return ground


def _continues_upwards(z: Float, occupied: UInt64) -> Bool:
    """Return whether the height bins above the lowest return of each cell are occupied for the depth of a
    pit, shape (columns, rows).

    Args:
        z: Heights of the lowest returns [m], infinite for none, shape (columns, rows).
        occupied: Bits of the occupied height bins of each cell, half of PIT high and modulo 64, same shape.
    """
    lowest = np.floor(np.where(np.isfinite(z), z, 0.0) / (0.5 * PIT)).astype(np.int64)
    one = np.uint64(1)
    first, second = (occupied >> ((lowest + k) & 63).astype(np.uint64) & one for k in (1, 2))
    upright: Bool = np.isfinite(z) & (first & second).astype(np.bool_)
    return upright


def _trend(ground: Float) -> Float:
    """Return a, b, c of the plane z = a x + b y + c through the lowest cells of squares of 4 m, fitted
    robustly, shape (3,). With fewer than six squares it is level at their median height; at 0 if there is
    none.

    Args:
        ground: Lowest returns, shape (columns, rows, 3) [m], infinite z for none.
    """
    places = ground[np.isfinite(ground[:, :, 2])]
    places = places[np.argsort(places[:, 2], kind="stable")]
    _, first = np.unique(np.floor(places[:, :2] / (8.0 * CELL)), axis=0, return_index=True)
    place = places[first]
    middle = np.median(place[:, 2]) if len(place) else 0.0
    plane = np.array([0.0, 0.0, middle])
    if len(place) < 6:
        return plane
    A = np.column_stack([place[:, :2], np.ones(len(place))])
    weight = np.ones(len(place))
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        # A weak prior for level ground: squares in a row do not determine the slope across them.
        G = np.vstack([A * root, np.diag([0.3, 0.3, 0.0])])
        plane = np.linalg.lstsq(G, np.append(place[:, 2] * root[:, 0], np.zeros(3)), rcond=None)[0]
        off = np.abs(place[:, 2] - A @ plane)
        scale = max(float(np.median(off)), 0.1)
        weight = 1.0 / (1.0 + (off / scale) ** 2)
    return np.asarray(plane)


def _remove_pits(z: Float, upright: Bool) -> None:
    """Remove returns more than PIT below the lower quartile of the 24 cells around, noise below the ground,
    in place. At least four of these must be known.

    The lower quartile decides, because among crowns few cells are ground. Returns that continue upwards are
    no noise but, for example, the foot of a stem, whose neighbours can be crowns.

    Args:
        z: Lowest returns above the trend, shape (columns, rows) [m]; removed cells become infinite.
        upright: Result of `_continues_upwards`, same shape.
    """
    before = np.pad(z, 2, constant_values=np.inf)
    for first in range(0, len(z), BLOCK):
        part, rows = z[first : first + BLOCK], slice(first, first + BLOCK + 4)
        around = np.lib.stride_tricks.sliding_window_view(before[rows], (5, 5))
        around = np.sort(np.delete(around.reshape(*part.shape, 25), 12, axis=2), axis=2)
        known = np.isfinite(around).sum(axis=2)
        quartile = np.take_along_axis(around, np.minimum(known // 4, 23)[:, :, None], axis=2)[:, :, 0]
        part[(known >= 4) & ~upright[first : first + BLOCK] & (part < quartile - PIT)] = np.inf


@compiled
def _lowest_cone(z: Float, rise: float) -> Float:
    """Return the height of the lowest of the cones that rise from all cells, shape (columns, rows) [m].

    The cones are propagated by one pass over the raster in each direction (a chamfer distance).

    Args:
        z: Heights of the cells, shape (columns, rows) [m], infinite for none.
        rise: Rise of a cone from a cell to the next one [m].
    """
    columns, rows = z.shape
    cone, across = z.copy(), rise * np.sqrt(2.0)
    for turn in (1, -1):
        for p in range(columns):
            a = p if turn == 1 else columns - 1 - p
            before = a - turn
            for q in range(rows):
                b = q if turn == 1 else rows - 1 - q
                best = cone[a, b]
                if 0 <= before < columns:
                    best = min(best, cone[before, b] + rise)
                    if b > 0:
                        best = min(best, cone[before, b - 1] + across)
                    if b + 1 < rows:
                        best = min(best, cone[before, b + 1] + across)
                if 0 <= b - turn < rows:
                    best = min(best, cone[a, b - turn] + rise)
                cone[a, b] = best
    return cone


def _interpolated(places: Float, z: Float, centre: Float) -> Float:
    """Return heights at the centres of cells, shape (columns, rows) [m]: linear between the ground returns,
    that of the nearest return beyond them, smoothed over neighbouring cells; 0 if there are no returns.

    Args:
        places: Positions of the ground returns, shape (N, 2) [m].
        z: Heights of the ground returns, shape (N,) [m].
        centre: Centres of the cells, shape (columns, rows, 2) [m].
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import QhullError, cKDTree

    if not len(z):
        return np.zeros(centre.shape[:2])
    height: Float = z[cKDTree(places).query(centre)[1]]
    try:
        inside = LinearNDInterpolator(places, z)(centre)
        height = np.where(np.isfinite(inside), inside, height)
    except QhullError:  # fewer than three returns, or returns in a row
        pass
    smooth: Float = gaussian_filter(height, 1.0, mode="nearest")
    return smooth
