"""Stem inventory of a whole cloud of a plot by a terrestrial or mobile scanner.

The steps of `Inventory` are extent, ground, thinned points above it, slices, circles, stems, crowns. The
points are read three times in parts, so that the memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pipeline.classification import ForestOf, package_alone
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.geometry.poses import Float
from pipeline.inventory.cloud import ExtentFinder, SpooledCloud, Thinned, WholeCloud
from pipeline.inventory.cross_sections import FIGURES, HIGHEST, LOWEST, Slices, cut, find_circles
from pipeline.inventory.crowns import Crowns, Voxels, find_crowns, voxels_of
from pipeline.inventory.stem_model import (
    COVERAGE,
    FIRST,
    LAST,
    LEAN_X,
    LEAN_Y,
    POINTS,
    RADIUS,
    SCATTER,
    SLICES,
    TAPER,
    VAR_X,
    VAR_Y,
    X,
    Y,
    classify_stems,
    describe_stems,
    diameters,
    is_repeated,
    middles,
)
from pipeline.inventory.stem_tracing import CLASSES, chain, find_upright, follow
from pipeline.inventory.terrain_raster import LowestReturns, TerrainRaster, heights_above
from pipeline.types.records import Float32, Int, Int32, Trees, Verdict

MOST_RASTER = 96 << 20  # bytes
COARSE = 0.04  # m; coarser thinning makes diameters less precise
SURE = 0.5  # share of the votes for pole, person or wall that rejects a stem
SAME_OBJECT = 0.4  # m; a column within this distance of a stem is the stem
NEVER = -1  # an unknown time
LEAST_RADIUS = 0.02  # m; smaller circles are twigs
SHOWN, SHOWN_SIDE = 1 << 17, 0.02  # points of all heights that are kept, and smallest side of their cubes [m]

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Candidates for trees in the frame of the cloud minus its offset, as columns of length K.

    Attributes:
        place: Position, shape (K, 2) [m].
        radius, radial_std: [m].
        arc: Visible arc [rad].
        points: Median number of points on the circle of a slice.
        height: Distance between the lowest and the highest slice [m].
        verdict: See Verdict, int32.
        stems: Models of the stems, the first rows of this table, shape (N, COLUMNS), N at most K.
        slices: Circles of these stems, shape (N, S, FIGURES).
    """

    place: Float
    radius: Float
    radial_std: Float
    arc: Float
    points: Float
    height: Float
    verdict: Int32
    stems: Float
    slices: Float


@dataclass(frozen=True, slots=True, eq=False)
class PlotMap:
    """Map of a plot in the frame of the cloud minus its offset.

    Attributes:
        trees: All trees, confirmed; their observations are slices.
        slices: Circles of the trees, shape (T, S, FIGURES), see `fit_circle`.
        slice_height: Heights of the slices, shape (S,) [m].
        candidates: All candidates with their verdicts.
        ground: Height map.
        points: Thinned points between LOWEST and HIGHEST above the ground, shape (N, 4).
        counts: Numbers of points by name.
        voxel_size: Side of the voxels of the thinning [m].
        whole: Thinned points of all heights (x, y, z, height above the ground), shape (M, 4) [m].
        crowns: Tree of each of these points, and the heights of the trees.
        tree_candidate: Row of each tree in `candidates`, shape (T,).
        lean: Shift of the axis of each tree per metre of height, shape (T, 2).
        taper: Change of the radius of each tree per metre of height, shape (T,).
        warnings: Messages for the user.
    """

    trees: Trees
    slices: Float
    slice_height: Float
    candidates: Candidates
    ground: TerrainRaster
    points: Float32
    whole: Float32
    crowns: Crowns
    tree_candidate: Int
    counts: dict[str, int]
    voxel_size: float
    lean: Float
    taper: Float
    warnings: tuple[str, ...]


#: Parameters that change the map of a cloud.
PARAMETERS = (
    "detection.radius_min",
    "detection.radius_max",
    "tracking.dbh_arc_min",
    "ground.slope_max",
    "classification.forest",
)


def map_plot(cloud: WholeCloud, parameters: Parameters, forests: ForestOf = package_alone) -> PlotMap:
    """Return the map of the stems of a whole cloud, see `Inventory`.

    Raises:
        SourceError: The cloud cannot be read, has no points, or is larger than a plot.
        StemmapError: There is no such forest.
    """
    with closing(Inventory(cloud, forests)) as inventory:
        return finish(inventory.steps(parameters))


class Inventory:
    """Maps the stems of a whole cloud, also again with other parameters. Stages whose parameters are the same
    as before are not computed again.

    Args:
        cloud: The cloud; it is read once.
        forests: Returns the random forest by its name.
        folder: Folder of the temporary file with the points; None for that of the system.
    """

    def __init__(
        self, cloud: WholeCloud, forests: ForestOf = package_alone, folder: Path | None = None
    ) -> None:
        self._cloud, self._forests = SpooledCloud(cloud, folder), forests
        self._kept: dict[str, tuple[object, Any]] = {}

    def steps(self, parameters: Parameters) -> Generator[float, None, PlotMap]:
        """Map the cloud; yield the share of the work that is done, from 0 to 1, at least every few tenths of
        a second, and return the map. The generator may be left before its end.

        Args:
            parameters: All parameters; those named in PARAMETERS are used.

        Raises:
            SourceError: The cloud cannot be read, has no points, or is larger than a plot.
            StemmapError: There is no such forest.
        """
        r_min, r_max = parameters.detection.radius_min, parameters.detection.radius_max
        slope, forest = parameters.ground.slope_max, parameters.classification.forest
        ground, near, slices, whole, counts = yield from self._keep(
            "points", slope, lambda: self._points(slope)
        )
        circles = yield from self._keep(
            "circles", (slope, r_min, r_max), lambda: _circles(slices, r_min, r_max)
        )
        number, stems = chain(circles)
        fits = follow(slices, circles, number, stems, max(r_min, LEAST_RADIUS), r_max)
        yield 0.9
        height = middles(slices)
        figures = describe_stems(fits, height)
        _place_by_circles(figures, circles, number)
        verdict = classify_stems(figures, r_min, r_max)
        kept = ~is_repeated(figures, verdict)
        fits, figures, verdict = fits[kept], figures[kept], verdict[kept]
        places, share = yield from self._keep("upright", (slope, forest), lambda: self._upright(near, forest))
        _reject_other_objects(figures, verdict, places, share)
        tree = verdict == Verdict.TREE
        # Numbers increase from west to east.
        order = np.flatnonzero(tree)[np.lexsort((figures[tree, Y], figures[tree, X]))]
        crowns = find_crowns(whole, figures[order], fits[order], ground)
        return PlotMap(
            trees=_trees(figures[order], np.radians(parameters.tracking.dbh_arc_min), crowns),
            slices=fits[order],
            slice_height=height,
            candidates=_candidates(figures, fits, verdict, places, share),
            tree_candidate=order,
            ground=ground,
            points=near.points,
            whole=whole.points,
            crowns=crowns,
            counts={**counts, "thinned": len(near.points), "in slices": len(slices.points)},
            voxel_size=near.side,
            lean=figures[order][:, [LEAN_X, LEAN_Y]],
            taper=figures[order, TAPER],
            warnings=_warnings(self._cloud, near, slices, ground),
        )

    def close(self) -> None:
        """Delete the temporary file."""
        self._cloud.close()

    def _keep(
        self, stage: str, key: object, compute: Callable[[], Generator[float, None, T]]
    ) -> Generator[float, None, T]:
        """Return the kept result of a stage, or compute it if its parameters differ.

        Args:
            stage: Name of the stage.
            key: Parameters on which the result depends.
            compute: Computes it in steps.
        """
        known = self._kept.get(stage)
        if known is None or known[0] != key:
            known = self._kept[stage] = (key, (yield from compute()))
        result: T = known[1]
        return result

    def _points(
        self, slope_max: float
    ) -> Generator[float, None, tuple[TerrainRaster, Thinned, Slices, Voxels, dict[str, int]]]:
        """Read the points; return ground, points near the ground, their slices, all points, and counts."""
        whole = Thinned(SHOWN, SHOWN_SIDE)
        ground, near, counts = yield from ground_steps(self._cloud, slope_max, whole=whole)
        yield 0.38
        voxels = voxels_of(whole.points, whole.side)
        yield 0.4
        return ground, near, cut(near.points), voxels, counts

    def _upright(self, near: Thinned, forest: str) -> Generator[float, None, tuple[Float, Float]]:
        """Return the result of `find_upright`."""
        yield 0.92
        return find_upright(near.points, self._forests(forest, True))


def _circles(slices: Slices, r_min: float, r_max: float) -> Generator[float, None, Float]:
    """Return the circles of all slices, shape (K, FIGURES + 2)."""
    found = [np.zeros((0, FIGURES + 2))]
    for circles in find_circles(slices, max(r_min, LEAST_RADIUS), r_max):
        found.append(circles)
        yield 0.4 + 0.5 * (len(found) - 1) / slices.count
    return np.concatenate(found)


def finish(steps: Generator[float, None, T]) -> T:
    """Return the result of a generator after all of its steps."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result


def find_ground(
    cloud: WholeCloud, slope_max: float, *, band: tuple[float, float] = (LOWEST, HIGHEST), most: int = 1 << 21
) -> tuple[TerrainRaster, Thinned, dict[str, int]]:
    """Return the result of `ground_steps`; arguments as in it."""
    return finish(ground_steps(cloud, slope_max, band=band, most=most))


def ground_steps(
    cloud: WholeCloud,
    slope_max: float,
    *,
    band: tuple[float, float] = (LOWEST, HIGHEST),
    most: int = 1 << 21,
    whole: Thinned | None = None,
) -> Generator[float, None, tuple[TerrainRaster, Thinned, dict[str, int]]]:
    """Return the ground below a cloud, its thinned points (x, y, z, height above the ground) in a band, and
    counts; yield the share of the whole inventory that is done after each part.

    Args:
        cloud: The cloud, which is read three times.
        slope_max: Largest slope of the terrain against the plane of the plot [degrees].
        band: Lowest and highest height above the ground that is kept, both exclusive [m].
        most: Largest number of points after thinning, a power of two.
        whole: Receives the points of all heights.

    Returns:
        Ground; points, of which there may be none; and the numbers of points "read", "apart from the plot"
        (left out) and "below the ground" (more than 0.3 m).

    Raises:
        SourceError: The cloud cannot be read, has no points, or its raster needs more than MOST_RASTER bytes.
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
            remedy="Cut it into plots of at most 400 x 400 m",
        )
    lowest = LowestReturns(extent.low, extent.high)
    for part in cloud.parts():
        lowest.add(part)
        yield 0.2
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


def _place_by_circles(figures: Float, circles: Float, number: Int) -> None:
    """Set the positions of stems without a model to the means of their circles, in place.

    Args:
        figures: Models of the stems, shape (K, COLUMNS).
        circles: Result of `find_circles`.
        number: Stem of each circle, see `chain`.
    """
    for stem in np.flatnonzero(np.isnan(figures[:, X])):
        figures[stem, [X, Y]] = circles[number == stem, :2].mean(axis=0)


def _reject_other_objects(figures: Float, verdict: Int32, places: Float, share: Float) -> None:
    """Change the verdict of trees that the forest classifies as poles, persons or walls, in place: the
    nearest column within SAME_OBJECT has more than the share SURE for that class. Stems with another verdict
    than TREE remain.

    Args:
        figures: Models of the stems, shape (K, COLUMNS).
        verdict: Verdicts of the stems, shape (K,), modified.
        places: Positions of upright columns, shape (C, 2) [m].
        share: Class shares of the columns, shape (C, 6).
    """
    from scipy.spatial import cKDTree

    tree = np.flatnonzero(verdict == Verdict.TREE)
    if len(tree) == 0 or len(places) == 0:
        return
    away, nearest = cKDTree(places).query(figures[tree][:, [X, Y]])
    votes = share[nearest]
    strongest = votes[:, 1:5].argmax(axis=1) + 1
    others = (Verdict.POLE, Verdict.PERSON, Verdict.WALL)
    kind = np.array(CLASSES, np.int32)[strongest]
    known = (away < SAME_OBJECT) & (votes[np.arange(len(votes)), strongest] > SURE) & np.isin(kind, others)
    verdict[tree[known]] = kind[known]


def _trees(stems: Float, arc_min: float, crowns: Crowns) -> Trees:
    """Return the tree table of stems, numbered from 1 in their order, all confirmed; velocities are 0,
    eccentricities NaN, times NEVER, and the observations are the slices.

    Args:
        stems: Models of the stems, shape (T, COLUMNS).
        arc_min: Least visible arc of a diameter [rad]; DBH is NaN otherwise, see `diameters`.
        crowns: Heights of the trees.
    """
    n = len(stems)
    dbh, sigma = diameters(stems, arc_min)
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = stems[:, VAR_X], stems[:, VAR_Y]
    return Trees(
        number=np.arange(1, n + 1),
        position=stems[:, [X, Y]],
        covariance=covariance,
        velocity=np.zeros((n, 2)),
        dbh=dbh,
        dbh_sigma=sigma,
        eccentricity=np.full(n, np.nan),
        observations=stems[:, SLICES].astype(np.int64),
        coverage=stems[:, COVERAGE],
        first_seen_ns=np.full(n, NEVER),
        last_seen_ns=np.full(n, NEVER),
        confirmed=np.ones(n, np.bool_),
        height=crowns.height,
        height_sigma=crowns.sigma,
        lean=np.arctan(np.hypot(stems[:, LEAN_X], stems[:, LEAN_Y])),
    )


def _candidates(figures: Float, fits: Float, verdict: Int32, places: Float, share: Float) -> Candidates:
    """Return the stems, and after them the upright columns farther than SAME_OBJECT from each stem, as
    candidates. A column has the verdict of its strongest class, NO_ARC in place of TREE, and NaN for all
    measures; arguments as in `_reject_other_objects`, not changed."""
    others = _away_from(places, figures[:, [X, Y]]) > SAME_OBJECT
    places, share = places[others], share[others]
    kind = np.array(CLASSES, np.int32)[share.argmax(axis=1)] if len(share) else np.zeros(0, np.int32)
    kind[kind == Verdict.TREE] = Verdict.NO_ARC  # upright like a stem, but without a circle
    nothing = np.full(len(places), np.nan)
    span = figures[:, LAST] - figures[:, FIRST]
    columns = (RADIUS, SCATTER, COVERAGE, POINTS)
    radius, scatter, arc, points = (np.append(figures[:, c], nothing) for c in columns)
    return Candidates(
        place=np.vstack([figures[:, [X, Y]], places]),
        radius=radius,
        radial_std=scatter,
        arc=arc,
        points=points,
        height=np.append(span, nothing),
        verdict=np.append(verdict, kind.astype(np.int32)),
        stems=figures,
        slices=fits,
    )


def _away_from(places: Float, others: Float) -> Float:
    """Return the distance of each position, shape (N, 2), from the nearest finite one of `others`, shape (M,
    2), shape (N,) [m]; infinite without one."""
    from scipy.spatial import cKDTree

    others = others[np.isfinite(others).all(axis=1)]
    if len(others) == 0 or len(places) == 0:
        return np.full(len(places), np.inf)
    away: Float = cKDTree(others).query(places)[0]
    return away


def _warnings(cloud: WholeCloud, near: Thinned, slices: Slices, ground: TerrainRaster) -> tuple[str, ...]:
    """Return the warnings of the cloud and those about coarse thinning, missing points above the ground and
    little visible ground."""
    warnings = list(cloud.description.warnings)
    if near.side > COARSE:
        warnings.append(
            f"the cloud was thinned to {100.0 * near.side:.0f} cm, which makes diameters less sharp: "
            "cut it into smaller plots"
        )
    if len(slices.points) == 0:
        warnings.append("there are no points higher than 0.2 m above the lowest returns")
    if ground.seen.mean() < 0.1:
        warnings.append("the ground is visible in less than 10 % of the plot: heights are uncertain")
    return tuple(warnings)


__all__ = ["PARAMETERS", "Candidates", "Inventory", "PlotMap", "find_ground", "finish", "map_plot"]
