"""Stem inventory of a whole cloud of a plot by a terrestrial or mobile scanner.

The steps of `Inventory` are extent, ground, thinned points above it, upright columns, the circles along them,
stems, crowns. The points are read several times in parts, so that the memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.extensions.clouds.cloud_frame import TURNED, UNNAMED
from app.extensions.clouds.inventory.cross_sections import (
    FIGURES,
    HIGHEST,
    LOWEST,
    Sampling,
    Slices,
    cut,
    find_columns,
    measure_sampling,
    slice_heights,
    strongest_first,
    trace,
    upper_end,
)
from app.extensions.clouds.inventory.crowns import Crowns, Voxels, find_crowns, voxels_of, without_heights
from app.extensions.clouds.inventory.spooled_cloud import SpooledCloud
from app.extensions.clouds.inventory.stem_model import (
    Stems,
    are_stumps,
    classify_stems,
    describe_stems,
    diameters,
    ends_are_seen,
    is_repeated,
)
from app.extensions.clouds.plot_ground import ground_steps
from app.extensions.clouds.records import CloudDescription, WholeCloud
from app.extensions.clouds.terrain_raster import TerrainRaster
from app.extensions.clouds.thinning import Thinned
from app.sources.one_step import finish
from pipeline.classification import ForestOf, package_alone
from pipeline.classification.forest import vote
from pipeline.config import Parameters
from pipeline.geometry.poses import Float
from pipeline.types.records import Float32, Int, Int32, Trees, Verdict

COARSE = 0.04  # m; coarser thinning makes diameters less precise
NEVER = -1  # an unknown time
TRACED = 8  # columns between two reports of progress
LEAST_RADIUS = 0.02  # m; smaller circles are twigs
THINNER = 0.01  # m; by which the radius of a stem is smaller a metre or two above breast height
#: First words of the warning about a cloud narrower than NARROW [m] and more than LONG_SIDE times as long.
SECTION = "the cloud is a section through a plot"
#: First words of the warning about a cloud that is lower than BREAST_HEIGHT [m] and has little ground.
SLICE = "the cloud is a slice of stems without ground"
BREAST_HEIGHT, LITTLE_GROUND = 1.3, 0.1
NARROW, LONG_SIDE = 0.5, 4.0  # stems are as thick, and the cloud of a single one is as wide as long
#: The highest tree that is known [m] (a coast redwood, 2019), and the distance from equator to pole [m],
#: which no northing in metres exceeds.
HIGHEST_TREE, LARGEST_NORTHING = 116.0, 1e7
#: Only 5 % of the land has trees above 30 m (Lang et al. 2023, Nature Ecology & Evolution 7, 1778), and a
#: pine of 13 m and 0.2 m has both values [m] if its feet are taken as metres.
GIANT_HEIGHT, GIANT_DBH = 40.0, 0.6
#: First words of the warning about a unit, about stems that stand twice, and about upright objects of which
#: none is a tree.
UNIT_DOUBT = "the coordinates may be feet"
TWICE = "stems stand twice in the cloud"
NO_TREE = "no tree was found"
#: Verdicts about upright objects that ground, noise or a wrong unit can also give to stems, and their fewest.
UPRIGHT = (Verdict.POLE, Verdict.OTHER, Verdict.NO_ARC, Verdict.TOO_THICK, Verdict.STUMP)
FEWEST_UPRIGHT = 3
#: Longest shift between two passes of a scanner that is searched (twin rows of plantations are 0.75 m apart),
#: its precision from pair to pair, the largest difference of two diameters of a stem [m], and the largest
#: probability that as many of the pairs of the same distance have the same direction, which four pairs reach.
SHIFT_MAX, SHIFT_SIGMA, SAME_DBH, BY_CHANCE = 0.6, 0.04, 0.04, 2e-3
SHOWN, SHOWN_SIDE = 1 << 17, 0.02  # points of all heights that are kept, and smallest side of their cubes [m]


@dataclass(frozen=True, slots=True, eq=False)
class PlotMap:
    """Map of a plot in the frame of the cloud minus its offset.

    Attributes:
        trees: All trees, confirmed; their observations are slices.
        stems: Models of all candidates for trees, STEM of shape (K,); NaN for a candidate with fewer than two
            circles.
        place: Positions of the candidates, shape (K, 2) [m].
        circles: Circles of the candidates, shape (K, S, FIGURES), see `fit_circle` and `slice_heights`.
        share: Shares of the votes of the random forest for the candidates, in the order of CLASSES, shape (K,
            6).
        verdict: Verdict of each candidate, int32, shape (K,).
        tree_candidate: Row of each tree in the tables of the candidates, shape (T,).
        ground: Height map.
        points: Thinned points between LOWEST and HIGHEST above the ground: x, y, z, height above the ground,
            shape (N, 4) [m].
        counts: Dict from "read", "apart from the plot", "below the ground", "thinned" and "in slices" to
            numbers of points.
        voxel_size: Side of the voxels of the thinning [m].
        whole: Thinned points of all heights (x, y, z, height above the ground), shape (M, 4) [m].
        crowns: Tree of each point of `whole`, and the heights of the trees.
        warnings: Messages for the user.
    """

    trees: Trees
    stems: Stems
    place: Float
    circles: Float
    share: Float
    verdict: Int32
    tree_candidate: Int
    ground: TerrainRaster
    points: Float32
    whole: Float32
    crowns: Crowns
    counts: dict[str, int]
    voxel_size: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PlotPoints:
    """The points of a plot, and what only depends on the slope of the ground.

    Attributes:
        ground: Height map.
        near: Points between LOWEST and HIGHEST above the ground, x, y, z, height [m].
        slices: The points of `near` by height.
        axes, features, unseen: Axes and both tables of features of the columns, see `find_columns`, strongest
            first.
        voxels: Points of all heights.
        counts: Dict from names to numbers of points, as in `PlotMap`.
    """

    ground: TerrainRaster
    near: Thinned
    slices: Slices
    axes: Float
    features: Float
    unseen: Float
    voxels: Voxels
    counts: dict[str, int]


#: Parameters that change the map of a cloud.
PARAMETERS = (
    "detection.radius_min",
    "detection.cloud_radius_max",
    "tracking.dbh_arc_min",
    "ground.slope_max",
    "classification.forest",
)


def map_plot(cloud: WholeCloud, parameters: Parameters, forests: ForestOf = package_alone) -> PlotMap:
    """Return the map of the stems of a whole cloud.

    Args:
        cloud: The cloud, which is read once.
        parameters: All parameters; those named in PARAMETERS are used.
        forests: Function of the name of a random forest and `is_seen_all_around` that returns the forest.

    Raises:
        SourceError: The cloud cannot be read, has no points, or is larger than a plot.
        StemmapError: There is no such forest.
        OSError: The temporary file of the points cannot be read.
    """
    with closing(Inventory(cloud, forests)) as inventory:
        return finish(inventory.steps(parameters))


class Inventory:
    """Maps the stems of a whole cloud, also again with other parameters. The points are not read again if the
    slope is the same as before.

    Args:
        cloud: The cloud; it is read once.
        forests: Function of the name of a random forest and `is_seen_all_around` that returns the forest.
        folder: Folder of the temporary file with the points; None for that of the system.
    """

    def __init__(
        self, cloud: WholeCloud, forests: ForestOf = package_alone, folder: Path | None = None
    ) -> None:
        self._cloud, self._forests = SpooledCloud(cloud, folder), forests
        self._kept: tuple[float, PlotPoints] | None = None

    def steps(self, parameters: Parameters) -> Generator[float, None, PlotMap]:
        """Map the cloud; yield the share of the work that is done, from 0 to 1, at least every few tenths of
        a second, and return the map. The generator may be left before its end. The points of a finished
        reading are kept, and read again only for another slope.

        Args:
            parameters: All parameters; those named in PARAMETERS are used.

        Raises:
            SourceError: The cloud cannot be read, has no points, or is larger than a plot.
            StemmapError: There is no such forest.
            OSError: The temporary file of the points cannot be read.
        """
        r_max = parameters.detection.cloud_radius_max
        r_min = max(parameters.detection.radius_min - THINNER, LEAST_RADIUS)
        slope = parameters.ground.slope_max
        if self._kept is None or self._kept[0] != slope:
            self._kept = (slope, (yield from self._points(slope)))
        p = self._kept[1]
        parts = [np.zeros((0, len(slice_heights()), FIGURES))]
        sampling = measure_sampling(p.slices, p.axes, r_min, r_max)
        for k in range(0, len(p.axes), TRACED):
            yield 0.5 + 0.4 * k / len(p.axes)
            parts.append(trace(p.slices, p.axes[k : k + TRACED], r_min, r_max, sampling))
        circles = np.concatenate(parts)
        stems = describe_stems(circles)
        yield 0.9
        seen = ends_are_seen(stems, p.features, parameters.detection.radius_min, r_max)
        rows = np.where(seen[:, None], p.features, p.unseen)
        share = vote(rows, self._forests(parameters.classification.forest, True))
        radii = parameters.detection.radius_min, r_max
        verdict = classify_stems(stems, share, *radii)
        verdict[are_stumps(stems, rows, share, *radii)] = Verdict.STUMP
        yield from _find_thick(p, sampling, circles, stems, share, verdict, r_max)
        kept = np.flatnonzero(~is_repeated(stems, p.axes, verdict))
        circles, stems, share, verdict = circles[kept], stems[kept], share[kept], verdict[kept]
        place = np.column_stack([stems["x"], stems["y"]])
        place = np.where(np.isfinite(place), place, p.axes[kept, :2])
        tree = np.flatnonzero(verdict == Verdict.TREE)
        order = tree[np.lexsort((place[tree, 1], place[tree, 0]))]  # numbers increase from west to east
        crowns = find_crowns(p.voxels, stems[order], p.ground)
        if self._cloud.description.cut_above:
            crowns = without_heights(crowns, "the sensor of the drive did not see above its field of view")
        trees = _trees(stems[order], np.radians(parameters.tracking.dbh_arc_min), crowns)
        doubt = _unit_doubt(self._cloud.description, trees.dbh, p.voxels.points[:, 3])
        doubt += _no_tree(verdict, self._cloud.description.up, float(p.ground.seen.mean()))
        doubt += _standing_twice(trees.position, trees.dbh)
        return PlotMap(
            trees=trees,
            stems=stems,
            place=place,
            circles=circles,
            share=share,
            verdict=verdict,
            tree_candidate=order,
            ground=p.ground,
            points=p.near.points,
            whole=p.voxels.points,
            crowns=crowns,
            counts=p.counts,
            voxel_size=p.near.side,
            warnings=(
                *_warnings(self._cloud, p),
                *_too_thick(verdict, r_max),
                *_too_thin(verdict, radii[0]),
                *doubt,
            ),
        )

    def close(self) -> None:
        """Delete the temporary file; another slope reads the source again."""
        self._cloud.close()

    def _points(self, slope_max: float) -> Generator[float, None, PlotPoints]:
        """Read the points, and find the ground, the slices and the columns; yield the share of the whole work
        that is done.

        Args:
            slope_max: Largest slope of the terrain against the plane of the plot [degrees].

        Raises:
            SourceError: The cloud cannot be read, has no points, or its raster needs more than MOST_RASTER
                bytes.
            OSError: The temporary file of the points cannot be read.
        """
        whole = Thinned(SHOWN, SHOWN_SIDE)
        ground, near, counts = yield from ground_steps(
            self._cloud, slope_max, band=(LOWEST, HIGHEST), whole=whole
        )
        yield 0.38
        voxels = voxels_of(whole.points, whole.side)
        yield 0.4
        slices = cut(near.points)
        counts = {**counts, "thinned": len(near.points), "in slices": len(slices.xy)}
        tiles = []
        for tile in find_columns(near.points, ground, upper_end(whole.points, ground)):
            tiles.append(tile)
            yield 0.45
        return PlotPoints(ground, near, slices, *strongest_first(tiles), voxels, counts)


def _trees(stems: Stems, arc_min: float, crowns: Crowns) -> Trees:
    """Return the tree table of stems, numbered from 1 in their order, all confirmed; eccentricities are NaN,
    times NEVER, and the observations are the slices.

    Args:
        stems: Models of the trees, shape (T,).
        arc_min: Minimum visible arc of a diameter [rad]; DBH is NaN below it, see `diameters`.
        crowns: Heights of the trees.
    """
    n = len(stems)
    dbh, sigma = diameters(stems, arc_min)
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = stems["var_x"], stems["var_y"]
    return Trees(
        number=np.arange(1, n + 1),
        position=np.column_stack([stems["x"], stems["y"]]),
        covariance=covariance,
        dbh=dbh,
        dbh_sigma=sigma,
        eccentricity=np.full(n, np.nan),
        observations=stems["slices"].astype(np.int64),
        coverage=stems["coverage"].copy(),
        first_seen_ns=np.full(n, NEVER),
        last_seen_ns=np.full(n, NEVER),
        confirmed=np.ones(n, np.bool_),
        height=crowns.height,
        height_sigma=crowns.sigma,
        lean=np.arctan(np.hypot(stems["lean_x"], stems["lean_y"])),
    )


def _find_thick(
    points: PlotPoints,
    sampling: Sampling,
    circles: Float,
    stems: Stems,
    share: Float,
    verdict: Int32,
    r_max: float,
) -> Generator[float, None, None]:
    """Search the columns without a stem for one up to twice as thick as the limit, and enter it as TOO_THICK,
    in place; yield the share of the work that is done.

    Args:
        points: Points of the plot.
        sampling: Noise and density of the points.
        circles, stems, share, verdict: Results for all columns.
        r_max: Maximum radius of a tree [m].
    """
    rest = np.flatnonzero(np.isnan(stems["radius"]))
    for k in range(0, len(rest), TRACED):
        yield 0.9
        rows = rest[k : k + TRACED]
        wide = trace(points.slices, points.axes[rows], r_max, 2.0 * r_max, sampling)
        found = describe_stems(wide)
        thick = classify_stems(found, share[rows], 0.0, 2.0 * r_max) == Verdict.TREE
        thick &= (found["radius"] > r_max) & (found["coverage"] > np.pi)  # a wall shows less of a circle
        circles[rows[thick]], stems[rows[thick]] = wide[thick], found[thick]
        verdict[rows[thick]] = Verdict.TOO_THICK


def _too_thick(verdict: Int32, r_max: float) -> list[str]:
    """Return a warning that names the limit if stems are too thick for it."""
    n = int(np.count_nonzero(verdict == Verdict.TOO_THICK))
    words = "1 stem is" if n == 1 else f"{n} stems are"
    return [
        f"{words} thicker than the limit of {2.0 * r_max:g} m and not in the map; the parameter of the limit "
        "is detection.cloud_radius_max (a radius)"
    ] * (n > 0)


def _too_thin(verdict: Int32, r_min: float) -> list[str]:
    """Return a warning that names the limit if more stems are too thin for it than there are trees."""
    n, trees = (int(np.count_nonzero(verdict == kind)) for kind in (Verdict.TOO_THIN, Verdict.TREE))
    return [
        f"{n} stems are thinner than the limit of {2.0 * r_min:g} m and not in the map; the parameter of the "
        "limit is detection.radius_min (a radius)"
    ] * (n >= FEWEST_UPRIGHT and n > trees)


def _unit_doubt(about: CloudDescription, dbh: Float, above: Float32) -> list[str]:
    """Return a warning if the numbers of a cloud whose file names no unit are implausible in metres.

    Args:
        about: Description of the cloud.
        dbh: Diameters of the trees [m], NaN where unknown.
        above: Heights of its points above the ground [m].
    """
    if about.unit != UNNAMED or not len(above):
        return []
    high, known = float(np.percentile(above, 99.9)), dbh[np.isfinite(dbh)]
    wide = float(np.median(known)) if len(known) else 0.0
    if about.offset[1] > LARGEST_NORTHING:
        reason = f"northings of {about.offset[1]:,.0f} m, and on Earth there are none above 10,000,000 m"
    elif high > HIGHEST_TREE:
        reason = f"a height of {high:.0f} m above the ground, and no tree is higher than {HIGHEST_TREE:.0f} m"
    elif high > GIANT_HEIGHT and wide > GIANT_DBH:
        reason = f"a height of {high:.0f} m and a median DBH of {wide:.1f} m, which only giant trees have"
    else:
        return []
    return [f"{UNIT_DOUBT}: as metres they give {reason}; name the unit with --unit m or --unit ft"]


def _no_tree(verdict: Int32, up: str, ground_seen: float) -> list[str]:
    """Return a warning if no candidate is a tree, though several are upright, the cloud was turned, or hardly
    any ground is seen: what is wrong with the cloud can hide all trees.

    Args:
        verdict: Verdicts of the candidates, shape (K,).
        up: Words about the axis that points up, see `CloudDescription`.
        ground_seen: Share of the plot with visible ground.
    """
    upright = int(np.isin(verdict, UPRIGHT).sum())
    reasons = [f"{upright} upright objects were refused"] * (upright >= FEWEST_UPRIGHT)
    reasons += [f"the cloud was turned (up is {up})"] * (TURNED in up)
    reasons += ["hardly any ground is visible"] * (ground_seen < LITTLE_GROUND)
    if (verdict == Verdict.TREE).any() or not reasons:
        return []
    return [
        f"{NO_TREE}, but {', and '.join(reasons)}: look for noise below the ground and at --unit and --up"
    ]


def _standing_twice(place: Float, dbh: Float) -> list[str]:
    """Return a warning if several pairs of stems have the same shift and alike diameters: two passes of the
    scanner that do not fit. In rows of a plantation the shift has another stem at its end.

    Args:
        place: Positions of the trees, shape (T, 2) [m].
        dbh: Their diameters, NaN where unknown, shape (T,) [m].
    """
    from scipy.spatial import cKDTree
    from scipy.special import bdtrc

    if not len(place):
        return []
    pairs = cKDTree(place).query_pairs(SHIFT_MAX, output_type="ndarray")
    unlike = np.abs(dbh[pairs[:, 0]] - dbh[pairs[:, 1]]) > SAME_DBH  # False where one is unknown
    pairs = pairs[~unlike]
    n = len(pairs)
    if not n:
        return []
    shift = place[pairs[:, 1]] - place[pairs[:, 0]]
    both = np.concatenate([shift, -shift])  # the stems of a pair have no order
    shifts = cKDTree(both)
    fullest = int(shifts.query_ball_point(shift, SHIFT_SIGMA, return_length=True).argmax())
    most = np.array(shifts.query_ball_point(shift[fullest], SHIFT_SIGMA))
    # Twin stems of a tree are all about as far apart, in directions that are random.
    apart = np.hypot(*shift.T)
    alike = int(np.count_nonzero(np.abs(apart - apart[fullest]) < SHIFT_SIGMA))
    share = min(2.0 * SHIFT_SIGMA / (np.pi * max(float(apart[fullest]), SHIFT_SIGMA)), 1.0)
    chance = n * bdtrc(len(most) - 2.0, max(alike - 1, 1), share)
    # In a row, the second stem of a pair is the first one of the next.
    if len(np.unique(pairs[most % n])) < 2 * len(most) or chance > BY_CHANCE:
        return []
    x, y = np.median(both[most], axis=0).tolist()
    return [
        f"{TWICE}: {len(most)} pairs are {x:.2f}, {y:.2f} m apart, so two passes of the scanner do not fit; "
        "register the scans again"
    ]


def _sides(place: Float) -> tuple[float, float]:
    """Return the shorter and the longer side of the smallest rectangle, in any direction, around points of
    shape (N, 2) [m]; zeros without points."""
    import shapely

    if not len(place):
        return 0.0, 0.0
    # One line is one object; points would be one for each.
    line = shapely.linestrings(np.concatenate([place, place[:1]]))
    corners = shapely.get_coordinates(shapely.oriented_envelope(line))
    sides = np.hypot(*np.diff(corners, axis=0).T)[:2].tolist()  # fewer for points on a line
    narrow, long = sorted([0.0, 0.0, *sides])[-2:]
    return narrow, long


def _warnings(cloud: WholeCloud, points: PlotPoints) -> tuple[str, ...]:
    """Return the warnings of the cloud and those about coarse thinning, a narrow cloud, missing points above
    the ground and little visible ground."""
    warnings = list(cloud.description.warnings)
    if points.near.side > COARSE:
        warnings.append(
            f"the cloud was thinned to {100.0 * points.near.side:.0f} cm, which makes diameters less sharp: "
            "cut it into smaller plots"
        )
    narrow, long = _sides(points.voxels.points[:, :2].astype(np.float64))
    if narrow < NARROW and long > LONG_SIDE * narrow:
        warnings.append(
            f"{SECTION}, only {narrow:.2f} m wide and {long:.1f} m long: its sides cut the stems, which "
            "are missing or have no diameter"
        )
    high = float(points.voxels.points[:, 3].max(initial=0.0))
    if high < BREAST_HEIGHT and points.ground.seen.mean() < LITTLE_GROUND:
        warnings.append(
            f"{SLICE}, {high:.1f} m high: heights above the ground are unknown, so no stem is measured at "
            "breast height; export it with the ground, or from 0.5 to 2.5 m above it"
        )
    if len(points.slices.xy) == 0:
        warnings.append("there are no points higher than 0.2 m above the lowest returns")
    if points.ground.seen.mean() < LITTLE_GROUND:
        warnings.append("the ground is visible in less than 10 % of the plot: heights are uncertain")
    return tuple(warnings)
