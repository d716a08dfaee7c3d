"""The ground of a plot below its cloud of points, which is read in parts."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from app.extensions.clouds.records import WholeCloud
from app.extensions.clouds.terrain_raster import LowestReturns, NoiseBelow, TerrainRaster, heights_above
from app.extensions.clouds.thinning import Thinned
from pipeline.errors import SourceError
from pipeline.geometry.poses import Float
from pipeline.types.records import Float32

MOST_RASTER = 128 << 20  # bytes
SQUARE = 8.0  # m
#: Reason of points that are left out.
FAR_FROM_PLOT = "points far from the plot"
LEAST = 20  # points of a square that belongs to the plot with its neighbours
MOST_SQUARES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Extent of a plot.

    Attributes:
        low, high: Minimum and maximum x, y of the plot, shape (2,) [m].
        points: Number of all points.
        apart: Number of points in sparse squares outside of the plot.
    """

    low: Float
    high: Float
    points: int
    apart: int


class ExtentFinder:
    """Finds the extent of a cloud. Points in sparse squares that have no dense neighbour are outside of it
    and counted; if no square is dense, all points are inside."""

    def __init__(self) -> None:
        self._squares: dict[int, tuple[int, Float]] = {}

    def add(self, part: Float32, where: str) -> None:
        """Add points of shape (N, 3) [m], finite; N may be 0.

        Raises:
            SourceError: The points are in more than MOST_SQUARES squares; `where` is the name of the cloud.
        """
        if len(part):
            _count(part, self._squares)
        if len(self._squares) > MOST_SQUARES:
            raise SourceError("the points are spread too widely for a plot", where=where)

    def extent(self, where: str) -> Extent:
        """Return the bounds of the points in squares with at least LEAST points and those next to them (of
        all points if there is no such square), and the numbers of all points and of those in other squares.

        Raises:
            SourceError: There are no points; `where` is the name of the cloud.
        """
        squares = self._squares
        if not squares:
            raise SourceError("the cloud has no points", where=where, remedy="Export it again")
        count = np.array([n for n, _ in squares.values()])
        bounds = np.array([bound for _, bound in squares.values()])
        key = np.array(list(squares))
        dense = set(key[count >= LEAST].tolist()) or set(key.tolist())
        steps = [(a << 32) + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
        part_of = np.array([any(k + step in dense for step in steps) for k in key.tolist()])
        total = int(count.sum())
        return Extent(
            bounds[part_of, :2].min(axis=0),
            bounds[part_of, 2:].max(axis=0),
            total,
            total - int(count[part_of].sum()),
        )


def _count(part: Float32, squares: dict[int, tuple[int, Float]]) -> None:
    """Add the points of a part to the counts of squares, in place.

    Args:
        part: Points, shape (N, 3) [m], N at least 1.
        squares: Dict from the key of a square to its number of points and their bounds x min, y min, x max, y
            max, shape (4,) [m].
    """
    cell = np.floor(part[:, :2] / SQUARE).astype(np.int64) + (1 << 30)
    key = (cell[:, 0] << 32) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    key, xy = key[order], part[order, :2].astype(np.float64)
    starts = np.flatnonzero(np.concatenate(([True], key[1:] != key[:-1])))
    low, high = np.minimum.reduceat(xy, starts), np.maximum.reduceat(xy, starts)
    sizes = np.diff(np.append(starts, len(key)))
    for k, n, a, b in zip(key[starts].tolist(), sizes.tolist(), low, high, strict=True):
        before, bound = squares.get(k, (0, np.append(a, b)))
        squares[k] = (before + n, np.append(np.minimum(bound[:2], a), np.maximum(bound[2:], b)))


def ground_steps(
    cloud: WholeCloud,
    slope_max: float,
    *,
    band: tuple[float, float],
    most: int = 1 << 21,
    whole: Thinned | None = None,
) -> Generator[float, None, tuple[TerrainRaster, Thinned, dict[str, int]]]:
    """Return the ground below a cloud, the thinned points of the cloud (x, y, z, height above the ground) in
    a band, and counts; yield the share of the whole work on the
    cloud that is done, up to 0.35, after each part.

    Args:
        cloud: The cloud, which is read three times, or four times if it has noise below the ground.
        slope_max: Largest slope of the terrain against the plane of the plot [degrees].
        band: Lowest and highest height above the ground that is kept, both exclusive [m].
        most: Maximum number of points after thinning, a power of two.
        whole: Table to which the points of all heights in the plot are added; None for none.

    Returns:
        Ground; points, of which there may be none; and a dict from "read", "apart from the plot" (left out)
        and "below the ground" (by more than 0.3 m) to numbers of points.

    Raises:
        SourceError: The cloud cannot be read, has no points, or its raster needs more than MOST_RASTER bytes.
        OSError: The temporary file of the points cannot be read.
    """
    finder, of = ExtentFinder(), max(cloud.description.points, 1)
    read = 0
    for part in cloud.parts():
        finder.add(part, cloud.description.uri)
        read += len(part)
        yield min(0.2 * read / of, 0.2)
    extent = finder.extent(cloud.description.uri)
    room = LowestReturns.room(extent.low, extent.high)
    if room > MOST_RASTER:
        wide, long = (extent.high - extent.low).tolist()
        raise SourceError(
            f"the cloud is too large for one plot: {wide:.0f} x {long:.0f} m",
            where=cloud.description.uri,
            remedy="Cut it into plots of at most 400 x 400 m; if its coordinates are no metres, name their "
            "unit with --unit",
        )
    lowest, noise = LowestReturns(extent.low, extent.high), NoiseBelow(extent.low, extent.high)
    for part in cloud.parts():
        lowest.add(part)
        noise.add(part)
        yield 0.2
    if (floor := noise.floor()) is not None:
        lowest = LowestReturns(extent.low, extent.high)
        for part in cloud.parts():
            lowest.add(part[noise.is_above(part, floor)])
            yield 0.25
    ground = lowest.ground(float(np.radians(slope_max)))
    del lowest
    near, below = Thinned(most), 0
    yield 0.3
    for part in cloud.parts():
        inside = ((part[:, :2] >= extent.low) & (part[:, :2] <= extent.high)).all(axis=1)
        part = part[inside]
        above = heights_above(part, ground)
        below += int(np.count_nonzero(above < -0.3))
        chosen = (above > band[0]) & (above < band[1])
        near.add(np.column_stack([part[chosen], above[chosen]]))
        if whole is not None:
            whole.add(np.column_stack([part, above]))
        yield 0.35
    counts = {"read": extent.points, "apart from the plot": extent.apart, "below the ground": below}
    return ground, near, counts
