"""Plots of a stand: circles, rectangles and polygons in the frame of the map, circles along a path, and their
stand figures.

The probability that a tree is found depends on the distance from which it was in view: half-normal distance
sampling (Buckland et al. 2001; Astrup et al. 2014 for laser scanning).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.extensions.stand.figures import PlotTrees, StandFigures, stand_figures
from app.extensions.stand.parameters import Stand
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.seen_area import SeenArea
from pipeline.types.records import Bool

PLOTS_MAX = 2000
AREA_MAX = 1e6  # m^2
_ARC = 64  # segments of a quarter circle
_SAMPLES = 4  # along each side of a cell


@dataclass(frozen=True, slots=True, eq=False)
class SamplePlot:
    """A plot.

    Attributes:
        name: Name for people, unique in a list of plots.
        shape: Area of the plot, a shapely Polygon or MultiPolygon in the frame of the map [m].
    """

    name: str
    shape: Any

    def contains(self, points: Float) -> Bool:
        """Return whether the plot contains each point, shape (N,); points on its border count. `points` are
        positions in the map, shape (N, 2) [m]."""
        points = np.reshape(points, (-1, 2))
        inside: Bool = shapely.intersects_xy(self.shape, points[:, 0], points[:, 1])
        return inside


def circle(name: str, x: float, y: float, radius: float) -> SamplePlot:
    """Return a circle around x, y [m] with the exact area of its radius [m].

    Raises:
        StemmapError: A number is not finite, the radius is not above 0, or the area is larger than AREA_MAX.
    """
    _check_finite(name, x=x, y=y, radius=radius)
    # A regular polygon inside of the circle is smaller than it; its corners are moved outwards.
    k = 4 * _ARC
    larger = radius * math.sqrt(2.0 * math.pi / (k * math.sin(2.0 * math.pi / k)))
    return checked(SamplePlot(name, shapely.Point(x, y).buffer(max(larger, 0.0), quad_segs=_ARC)))


def rectangle(name: str, x: float, y: float, length: float, width: float, turn: float = 0.0) -> SamplePlot:
    """Return a rectangle.

    Args:
        name: Name of the plot.
        x, y: Centre in the map [m].
        length, width: Sides along and across the axis of the rectangle [m].
        turn: Angle of the axis from x towards y [rad].

    Raises:
        StemmapError: A number is not finite, or the area is 0 or larger than AREA_MAX.
    """
    _check_finite(name, x=x, y=y, length=length, width=width, turn=turn)
    corners = 0.5 * np.array([[-length, -width], [length, -width], [length, width], [-length, width]])
    c, s = math.cos(turn), math.sin(turn)
    return checked(SamplePlot(name, shapely.Polygon(corners @ np.array([[c, s], [-s, c]]) + [x, y])))


def _check_finite(name: str, **values: float) -> None:
    """Raise a StemmapError that names the first value that is not finite, of the plot `name`."""
    for key, value in values.items():
        if not math.isfinite(value):
            raise StemmapError(f"plot {name}: its {key} is not a number", remedy=f"Give {key} as a number")


def plot_of(name: str, shape: Mapping[str, Any]) -> SamplePlot:
    """Return the plot of a shape as it is stored.

    Args:
        name: Name of the plot.
        shape: Dict with the key `kind`: "circle" with x, y, radius [m]; "rectangle" with x, y, length, width
            [m] and turn_deg; or "polygon" (as any other kind) with `polygons`, the coordinates of a GeoJSON
            MultiPolygon [m].

    Raises:
        StemmapError: The plot cannot be used, see `checked`.
        KeyError, TypeError: A value is missing or unknown.
    """
    values = {key: value for key, value in shape.items() if key not in ("kind", "turn_deg")}
    if shape["kind"] == "circle":
        return circle(name, **values)
    if shape["kind"] == "rectangle":
        return rectangle(name, **values, turn=math.radians(shape["turn_deg"]))
    try:
        parts = [shapely.Polygon(rings[0], rings[1:]) for rings in shape["polygons"]]
    except (ValueError, IndexError, shapely.errors.GEOSException):
        parts = []  # too few corners
    return checked(SamplePlot(name, parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)))


def checked(plot: SamplePlot) -> SamplePlot:
    """Return the plot itself, if it can be used.

    Raises:
        StemmapError: The plot is not an area, crosses itself, is empty, is larger than AREA_MAX or has
            coordinates that are not finite.
    """
    shape, problem = plot.shape, ""
    if shape is None or shape.is_empty or shape.geom_type not in ("Polygon", "MultiPolygon"):
        problem = "is not an area"
    elif not np.isfinite(shapely.get_coordinates(shape)).all():
        problem = "has coordinates that are not finite"
    elif not shape.is_valid:
        problem = f"is not valid: {shapely.is_valid_reason(shape)}"
    elif shape.area <= 0.0:
        problem = "has an area of 0"
    elif shape.area > AREA_MAX:
        problem = f"has {shape.area:,.0f} m2, more than {AREA_MAX / 1e4:g} ha"
    if problem:
        raise StemmapError(f"plot {plot.name} {problem}", remedy="Correct its border; units are metres")
    return plot


def along(path: Float, every: float, radius: float) -> list[SamplePlot]:
    """Return circles "path 1", "path 2", ... along a path, the first at half the distance between two.

    Args:
        path: Positions, shape (N, 2) [m].
        every: Distance along the path between the centres of two neighbouring circles [m].
        radius: Radius of the circles [m].

    Raises:
        StemmapError: See `centres_along`, or the radius is not a number above 0.
    """
    centres = centres_along(path, every).tolist()
    return [circle(f"path {k + 1}", x, y, radius) for k, (x, y) in enumerate(centres)]


def centres_along(path: Float, every: float) -> Float:
    """Return positions on a path of shape (N, 2) [m] at multiples of `every` [m], the first at half of it;
    shape (K, 2) [m], K at least 1.

    Raises:
        StemmapError: `every` is not a number above 0, the path is shorter than half of it, or there are more
            than PLOTS_MAX circles.
    """
    if not (math.isfinite(every) and every > 0.0):
        raise StemmapError(
            f"plots cannot be {every:g} m apart along the path", remedy="Give a distance above 0 m"
        )
    steps = np.hypot(*np.diff(path, axis=0).T) if len(path) > 1 else np.zeros(0)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    count = int((driven[-1] + 0.5 * every) // every)
    if not 0 < count <= PLOTS_MAX:
        raise StemmapError(
            f"the path of {driven[-1]:.1f} m has {count or 'no'} plots every {every:g} m",
            remedy="Choose another distance" if count else "Choose a shorter distance",
        )
    at = every * (np.arange(count) + 0.5)
    return np.stack([np.interp(at, driven, path[:, axis]) for axis in (0, 1)], axis=1)


def seen_plot(name: str, seen: SeenArea) -> SamplePlot:
    """Return the whole observed area as a plot with the name `name`.

    Raises:
        StemmapError: Nothing was observed, or the area is larger than AREA_MAX.
    """
    low = seen.place * seen.cell
    return checked(SamplePlot(name, shapely.union_all(shapely.box(*low.T, *(low + seen.cell).T))))


def within_reach(seen: SeenArea, parameters: Stand) -> SeenArea:
    """Return the cells that count as observed: nearest view at most `reach` away, and at least `views_min`
    views, with gaps closed (`SeenArea.closed`), since stems hide the cells behind them. An unknown distance
    (NaN) or number of views (0), as for a whole cloud, excludes no cell.
    """
    near = ~(seen.nearest > parameters.reach)
    return seen.where(near & ((seen.views >= parameters.views_min) | (seen.views == 0))).closed()


LEAST_TREES = 20
# Gain of the log-likelihood over constant detection that the half-normal model needs (chi-square, one degree
# of freedom, 5 %). Without this rule a complete map would be corrected upwards by the noise of the fit.
GAIN = 1.92


@dataclass(frozen=True, slots=True)
class DetectionFunction:
    """Probability of detection g(r) = exp(-r^2 / (2 sigma^2)).

    Attributes:
        sigma: Scale [m]; inf if detection does not decrease with distance.
        sigma_se: Standard error of `sigma` [m]; 0 for inf.
        trees: Number of trees of the fit; 0 if every tree counts as found without one.
        reason: Why there is no fit: "correction" (the parameter is "none"), "whole_cloud" (no distances are
            known) or "few_trees"; "" if there is one.
    """

    sigma: float
    sigma_se: float
    trees: int
    reason: str = ""

    def at(self, distance: Float) -> Float:
        """Return the probability at distances [m], in their shape; 1 for an infinite `sigma`, NaN for a
        distance of NaN."""
        return (
            np.exp(-0.5 * np.square(distance / self.sigma)) if math.isfinite(self.sigma) else distance * 0 + 1
        )

    def mean(self, available: Float) -> tuple[float, float]:
        """Return the mean probability over an area and its standard error (delta method), NaN for an infinite
        `sigma`, with which trees that are missed at every distance are not noticed; both NaN if `available`
        is empty.

        Args:
            available: Distance of each cell of the area [m], cells of equal size, shape (K,).
        """
        if not len(available):
            return math.nan, math.nan
        g = self.at(available)
        p = float(g.mean())
        if not math.isfinite(self.sigma):
            return p, math.nan
        slope = float((g * np.square(available)).mean()) / self.sigma**3
        return p, slope * self.sigma_se


def fit_half_normal(distance: Float, available: Float) -> DetectionFunction | None:
    """Fit the half-normal function by maximum likelihood, given the distances that the area offers.

    The likelihood of a distance is g(r) A(r) / sum g A, where A(r) is the number of cells at that distance,
    so it holds for plots of any shape. With A(r) proportional to r (one position) the estimate is sigma^2 =
    sum r^2 / (2 n); with constant A(r) (a straight path) it is sum r^2 / n.

    Args:
        distance: Distance of each tree found [m], shape (N,); finite.
        available: Distance of each cell of the area [m], shape (K,); finite.

    Returns:
        The function; sigma is inf if constant detection explains the distances as well, else from 1/20 to 20
        times the largest distance of the area. None if there are fewer than LEAST_TREES trees or no cells.
    """
    from scipy.optimize import minimize_scalar

    n = len(distance)
    if n < LEAST_TREES or not len(available):
        return None
    trees = np.square(distance)
    cells, counts = np.unique(np.round(np.square(available), 3), return_counts=True)
    share = counts / counts.sum()

    def loss(log_sigma: float) -> float:
        k = 0.5 * math.exp(-2.0 * log_sigma)
        return float(k * trees.sum() + n * math.log(float(np.sum(share * np.exp(-k * cells)))))

    farthest = math.sqrt(max(float(cells[-1]), 1e-6))
    bounds = (math.log(farthest / 20.0), math.log(farthest * 20.0))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    if -float(found.fun) < GAIN:  # the loss of constant detection is 0
        return DetectionFunction(math.inf, 0.0, n)
    h = 1e-3
    curvature = (loss(found.x + h) - 2.0 * float(found.fun) + loss(found.x - h)) / h**2
    sigma = math.exp(float(found.x))
    se = sigma / math.sqrt(curvature) if curvature > 0.0 else math.inf
    return DetectionFunction(sigma, se, n)


def detection_function(trees: PlotTrees, seen: SeenArea, parameters: Stand) -> DetectionFunction:
    """Return the probability of detection over distance, fitted to all trees of the map in cells of known
    distance, of at least the minimum diameter or without one. It is 1 if the parameter `correction` is
    "none", if no distance is known, or if there are fewer than LEAST_TREES such trees. Trees that a person
    added were not detected.

    The cells are not limited to the hull of the trees: trees that are missed far from the path shrink it, so
    that the decrease would vanish from the fit.
    """
    if parameters.correction == "none":
        return _assumed("correction")
    known = seen.where(np.isfinite(seen.nearest))
    if not len(known.nearest):
        return _assumed("whole_cloud")
    rows = known.rows(trees.position[trees.of_map & ~(trees.dbh < parameters.dbh_min)])
    return fit_half_normal(known.nearest[rows[rows >= 0]], known.nearest) or _assumed("few_trees")


def _assumed(reason: str) -> DetectionFunction:
    return DetectionFunction(math.inf, 0.0, 0, reason)


def figures_of(
    plots: Sequence[SamplePlot], trees: PlotTrees, seen: SeenArea, parameters: Stand
) -> dict[str, StandFigures]:
    """Return a dict from the names of the plots to their stand parameters. A plot of which more than 99.5 %
    was observed counts as observed completely. The probability of detection is 1, without a known error, in a
    plot with a cell of unknown distance.

    Args:
        plots: Plots with unique names.
        trees: All trees; those in the observed area and the others count separately.
        seen: Cells that count as observed (`within_reach`).
        parameters: Limits, and whether detection is corrected.
    """
    observed = seen.rows(trees.position) >= 0
    detection = detection_function(trees, seen, parameters)
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    result = {}
    for plot in plots:
        shape = plot.shape
        shapely.prepare(shape)
        low, high = np.array(shape.bounds[:2]), np.array(shape.bounds[2:])
        corner = seen.place * seen.cell
        cells = np.flatnonzero(np.all((corner + seen.cell >= low) & (corner <= high), axis=1))
        samples = (corner[cells, None, :] + seen.cell * offsets).reshape(-1, 2)
        inside = plot.contains(samples).reshape(len(cells), len(offsets)).mean(axis=1)
        area = float(shape.area)
        part = min(float(inside.sum()) * seen.cell**2, area)
        if part > 0.995 * area:  # less than the accuracy of the raster
            part = area
        available = np.repeat(seen.nearest[cells], np.round(inside * len(offsets)).astype(int))
        probability = detection.mean(available) if np.isfinite(available).all() else (1.0, math.nan)
        of_plot = plot.contains(trees.position)
        result[plot.name] = stand_figures(
            trees.where(of_plot & observed),
            trees.where(of_plot & ~observed),
            area=area,
            seen=part,
            perimeter=float(min(shape.length, shape.convex_hull.length)) * math.sqrt(part / area),
            detection=probability,
            parameters=parameters,
        )
    return result
