"""Builds the stories: of a cluster from the frame of its scan, of a tree from the shown frame and the voxel
map; and a section at breast height for the 2D map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from app.explain.records import (
    CheckResult,
    Circle,
    ClusterStory,
    ColumnStory,
    FeatureEffect,
    MapSection,
    TreeStory,
    half_axes,
)
from app.store.forests import kept_forests
from pipeline.classification.features import NAMES
from pipeline.classification.forest import (
    CLASSES,
    TREE_IN_FREE_AIR,
    feature_effects,
    is_seen_all_around,
    standard_forest,
    tree_in_free_air,
)
from pipeline.classification.voxel_map import SIDE, TILE, VoxelMap
from pipeline.config import Parameters, field_specs
from pipeline.detection.cylinder_fit import StemFit, fit_one
from pipeline.detection.verdicts import Check, checks
from pipeline.errors import StemmapError
from pipeline.geometry.columns import evenly_spaced
from pipeline.geometry.poses import Float
from pipeline.types.records import Clusters, Frame, Sensor, Verdict
from pipeline.types.units import SECOND_NS

if TYPE_CHECKING:
    from app.worker.run import Run


_MOST_POINTS = 400
_MOST_FEATURES = 6
_COLUMN_REACH = 0.45  # [m]; a column farther away belongs to another object
_SIDES = 36


def warm_up(sensor: Sensor) -> None:
    """Compile the kernels of the explanations, so that the first one does not delay the mapping.

    Args:
        sensor: The LiDAR of the run.
    """
    angle = np.linspace(2.0, 4.0, 12)
    arc = np.column_stack([5.0 + 0.2 * np.cos(angle), 0.2 * np.sin(angle), np.linspace(0.0, 1.0, 12)])
    fit_one(arc, sensor)
    feature_effects(np.zeros(len(NAMES)), standard_forest(sensor.rings > 0), Verdict.TREE)


def cluster_story(run: Run | None, frame: Frame, cluster: int) -> ClusterStory:
    """Return the explanation of a cluster of a recent scan.

    Args:
        run: The open run, or None.
        frame: Results of the scan.
        cluster: Row of the cluster in the frame.

    Raises:
        StemmapError: `run` is None, the scan has no such cluster, or the forest in force cannot be read.
    """
    if run is None or not 0 <= cluster < len(frame.clusters.size):
        raise StemmapError(f"there is no cluster {cluster}", where=f"scan {frame.index}")
    parameters, sensor = run.parameters_at(frame.index), run.source.description.sensor
    clusters, pose = frame.clusters, frame.estimate.T_map_base
    points = frame.filtered[frame.labels == cluster].astype(np.float64)
    # Presets without circle fit have no sigma; the story shows only what the verdict used.
    fit = fit_one(points, sensor) if np.isfinite(clusters.radius_sigma[cluster]) else None
    to_picture = _to_picture(clusters.centre[cluster])
    offset = points[:, :2] - clusters.centre[cluster] if fit is None else fit.offset
    some = evenly_spaced(len(points), _MOST_POINTS)
    place = pose.apply(clusters.centre[cluster] + frame.sensor_offset[:2])
    return ClusterStory(
        scan=frame.index,
        cluster=cluster,
        time_s=(frame.stamp_ns - run.start_ns) / SECOND_NS,
        verdict=Verdict(int(clusters.verdict[cluster])).label,
        checks=checks_of(clusters, cluster, parameters),
        size=int(clusters.size[cluster]),
        eccentricity=float(clusters.eccentricity[cluster]),
        position=(float(place[0]), float(place[1])),
        distance=float(np.hypot(*clusters.centre[cluster])),
        sensor_sigma=sensor.range_sigma,
        points=[(float(x), float(y)) for x, y in offset[some] @ to_picture.T],
        residual=[] if fit is None else fit.residual[some].tolist(),
        circle=None if fit is None else _circle(fit, clusters.covariance[cluster], to_picture),
        axes=_axes(points[:, :2], to_picture),
        tree=_nearest_tree(frame, place, parameters.slam.distance_max),
        column=column_story(frame, place, parameters, _is_seen_all_around(run)),
    )


def tree_story(
    run: Run | None, frame: Frame | None, number: int, mapped: NDArray[np.float64] | None = None
) -> TreeStory:
    """Return the explanation of a tree after a scan.

    Args:
        run: The open run, or None.
        frame: Results of the scan, or None; a run of one step has its own.
        number: Number of the tree.
        mapped: Position of the tree among the accumulated points [m], shape (2,), if repairs have moved it.

    Raises:
        StemmapError: No run is open, no scan was mapped, there is no such tree at this time, or the forest in
            force cannot be read.
    """
    rows = np.flatnonzero(frame.trees.number == number) if frame else np.zeros(0, np.int64)
    if run is None or frame is None or not len(rows):
        raise StemmapError(
            f"tree {number} is not known at this time of the run", remedy="Play on, or select another"
        )
    parameters = run.parameters_at(frame.index)
    row = int(rows[0])
    trees = frame.trees
    major, minor, angle = half_axes(trees.covariance[row : row + 1])[0].tolist()
    sides = [] if trees.sides is None else [bool(int(trees.sides[row]) >> k & 1) for k in range(_SIDES)]
    return TreeStory(
        tree=int(trees.number[row]),
        scan=frame.index,
        time_s=(frame.stamp_ns - run.start_ns) / SECOND_NS,
        confirmed=bool(trees.confirmed[row]),
        position=(float(trees.position[row, 0]), float(trees.position[row, 1])),
        ellipse=(major, minor, angle),
        dbh=float(trees.dbh[row]),
        dbh_sigma=float(trees.dbh_sigma[row]),
        coverage_deg=float(np.degrees(trees.coverage[row])),
        dbh_arc_deg=parameters.tracking.dbh_arc_min,
        sides=sides,
        eccentricity=float(trees.eccentricity[row]),
        observations=int(trees.observations[row]),
        first_seen_s=(int(trees.first_seen_ns[row]) - run.start_ns) / SECOND_NS,
        last_seen_s=(int(trees.last_seen_ns[row]) - run.start_ns) / SECOND_NS,
        cluster=_cluster_of(frame, trees.position[row], parameters.slam.distance_max),
        column=column_story(frame, trees.position[row], parameters, _is_seen_all_around(run)),
        points=points_around(run.voxels, trees.position[row] if mapped is None else mapped),
        history=run.history(int(trees.number[row]), frame.index),
    )


def checks_of(clusters: Clusters, row: int, parameters: Parameters) -> list[CheckResult]:
    """Return the checks of one cluster in the order in which they decide; empty for an external stem.

    Args:
        clusters: Clusters of the scan.
        row: Row of the cluster.
        parameters: Parameters with which the scan was mapped.
    """
    if np.isnan(clusters.eccentricity[row]):  # an external stem
        return []
    return check_results(checks(clusters, parameters.detection), row)


def _is_seen_all_around(run: Run) -> bool:
    """Return whether the forest for sensors that see all around classifies the columns of a run up to its
    current scan."""
    path = run.path
    return is_seen_all_around(run.source.description.sensor.rings, np.column_stack([path.x, path.y]))


def column_story(frame: Frame, place: Float, parameters: Parameters, all_around: bool) -> ColumnStory | None:
    """Return the classification of the nearest voxel column within 0.45 m of a position, of the nearest one
    with the verdict TREE if there is one; None without such a column.

    Args:
        frame: Results of the newest scan, with its voxel columns.
        place: Position x, y in the map, shape (2,) [m].
        parameters: Parameters with which the scan was mapped.
        all_around: Which random forest classified the columns, see `is_seen_all_around`.

    Raises:
        StemmapError: The forest of the parameters cannot be read.
    """
    columns = frame.columns
    if columns is None or not len(columns.verdict):
        return None
    distance = np.linalg.norm(columns.axis[:, :2] - place, axis=1)
    tree = columns.verdict == Verdict.TREE
    # A tree is preferred to a bush next to it.
    row = int(np.argmin(np.where(tree & (distance <= _COLUMN_REACH), distance - _COLUMN_REACH, distance)))
    if distance[row] > _COLUMN_REACH:
        return None
    share, verdict = columns.share[row], Verdict(int(columns.verdict[row]))
    forest = kept_forests()(parameters.classification.forest, all_around)
    figures = columns.figures[row]
    in_free_air = float(tree_in_free_air(figures[None], forest)[0])
    refused = forest.free_end if in_free_air < TREE_IN_FREE_AIR else None
    effect = feature_effects(figures, refused or forest, Verdict.TREE)
    strongest = np.argsort(-np.abs(effect), kind="stable")[:_MOST_FEATURES]
    return ColumnStory(
        verdict=verdict.label,
        distance=float(distance[row]),
        votes={kind.label: float(share[k]) for k, kind in enumerate(CLASSES)},
        tree_share=parameters.classification.tree_share,
        tree_in_free_air=None if np.isnan(in_free_air) else in_free_air,
        by_votes=verdict in _decided_by(share, parameters.classification.tree_share),
        present=int(columns.present[row]),
        absent=int(columns.absent[row]),
        absent_lately=int(columns.absent_lately[row]),
        viewed=float(columns.viewed[row]),
        effects=[
            FeatureEffect(NAMES[k], float(figures[k]), float(effect[k]))
            for k in strongest.tolist()
            if effect[k] != 0.0
        ],
    )


def _decided_by(share: Float, tree_share: float) -> tuple[Verdict, ...]:
    """Return the verdict that the votes alone give, without a rule, as a tuple of one: TREE if its share is
    at least `tree_share`, even if another class has more votes; else the class with most votes, or OTHER if
    that is TREE.

    Args:
        share: Share of votes by class, in the order of CLASSES, in which TREE is first.
        tree_share: Minimum share of votes of a tree.
    """
    if share[0] >= tree_share:
        return (Verdict.TREE,)
    most = CLASSES[int(share.argmax())]
    return (Verdict.OTHER,) if most is Verdict.TREE else (most,)


def _nearest_tree(frame: Frame, place: Float, reach: float) -> int | None:
    """Return the number of the nearest confirmed tree; None if none is within `reach`.

    Args:
        frame: Results of the scan.
        place: Position x, y in the map, shape (2,) [m].
        reach: Maximum distance [m].
    """
    trees = frame.trees
    rows = np.flatnonzero(trees.confirmed)
    if not len(rows):
        return None
    distance = np.linalg.norm(trees.position[rows] - place, axis=1)
    nearest = int(np.argmin(distance))
    return int(trees.number[rows[nearest]]) if distance[nearest] <= reach else None


def _cluster_of(frame: Frame, place: Float, reach: float) -> int | None:
    """Return the row of the detected tree (cluster of a detection) nearest to a position within `reach`;
    without one, the row of the nearest cluster within `reach`; else None.

    Args:
        frame: Results of the scan.
        place: Position x, y in the map, shape (2,) [m].
        reach: Maximum distance [m].
    """
    centre = frame.estimate.T_map_base.apply(frame.clusters.centre + frame.sensor_offset[:2])
    distance = np.linalg.norm(centre - place, axis=1)
    for rows in (frame.detections.cluster, np.arange(len(distance))):
        if len(rows) and distance[rows].min() <= reach:
            return int(rows[np.argmin(distance[rows])])
    return None


def _to_picture(centre: Float) -> Float:
    """Return the rotation matrix from the level frame of the sensor to the picture, shape (2, 2): the
    direction from the sensor to the cluster becomes the y axis (up).

    Args:
        centre: Position x, y of the cluster in the level frame of the sensor, shape (2,) [m].
    """
    reach = max(float(np.hypot(*centre)), 1e-9)
    ux, uy = centre / reach
    return np.array([[uy, -ux], [ux, uy]])


def _circle(fit: StemFit, covariance: Float, to_picture: Float) -> Circle:
    """Return a fitted stem in the picture. `arc_end` is `arc_start` plus the arc; the angles are not wrapped.

    Args:
        fit: The fit in level sensor coordinates.
        covariance: Covariance of the centre in the same frame, shape (2, 2) [m^2].
        to_picture: Rotation to the picture, shape (2, 2).
    """
    turn = float(np.arctan2(to_picture[1, 0], to_picture[0, 0]))
    lean = to_picture @ fit.lean
    major, minor, angle = half_axes((to_picture @ covariance @ to_picture.T)[None])[0].tolist()
    start = fit.arc_start + turn
    return Circle(
        radius=fit.radius,
        radius_sigma=fit.radius_sigma,
        arc_deg=float(np.degrees(fit.arc)),
        arc_start=start,
        arc_end=start + fit.arc,
        lean=(float(lean[0]), float(lean[1])),
        lean_deg=float(np.degrees(np.arctan(np.hypot(*lean)))),
        ellipse=(major, minor, angle),
    )


def _axes(points: Float, to_picture: Float) -> list[tuple[float, float]]:
    """Return one standard deviation along the major and the minor principal axis of points, in this order, as
    (right, up) in the picture [m], with arbitrary sign; [] if there are no points.

    Args:
        points: x, y in level sensor coordinates, shape (N, 2) [m].
        to_picture: Rotation to the picture, shape (2, 2).
    """
    if not len(points):  # an external stem
        return []
    spread = points - points.mean(axis=0)
    values, vectors = np.linalg.eigh(spread.T @ spread / max(len(points), 1))
    arms = to_picture @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return [(float(arms[0, k]), float(arms[1, k])) for k in (1, 0)]


# Heights above the ground of the section and of the points at breast height, which is 1.3 m [m].
BREAST_LOW, BREAST_HIGH = 1.0, 1.6
REACH = 0.75  # [m] around the axis of a tree: the stem and what touches it
_MOST_AT_BREAST, _MOST_OTHERS = 600, 900  # points of a tree
_MOST_CELLS = 20_000  # 160 kB


def points_around(voxels: VoxelMap, place: NDArray[np.float64]) -> list[tuple[float, float, float]]:
    """Return the voxels around a position, see `nearest_points`.

    Args:
        voxels: Voxels of all scans.
        place: Position x, y in the map, shape (2,) [m].
    """
    mean, _ = voxels.around(np.floor(place / TILE).astype(np.int64), REACH)
    return nearest_points(mean, place)


def nearest_points(
    points: NDArray[np.floating], place: NDArray[np.float64]
) -> list[tuple[float, float, float]]:
    """Return the points within a horizontal distance of REACH of a position as tuples of x, y relative to the
    position and height above the ground [m], rounded to 1 cm: first at most 600 at breast height (see
    `_at_breast`), then at most 900 others.

    Args:
        points: x, y in the map and height above the ground, shape (N, 3) [m].
        place: Position x, y in the map, shape (2,) [m].
    """
    points = points.astype(np.float64) - [*place, 0.0]
    points = points[np.hypot(points[:, 0], points[:, 1]) <= REACH]
    at_breast = _at_breast(points[:, 2])
    chosen = [
        part[evenly_spaced(len(part), most)]
        for part, most in ((points[at_breast], _MOST_AT_BREAST), (points[~at_breast], _MOST_OTHERS))
    ]
    return [(x, y, z) for x, y, z in np.round(np.concatenate(chosen), 2).tolist()]


def section(accumulated: NDArray[np.floating]) -> MapSection:
    """Return the occupied cells between BREAST_LOW and BREAST_HIGH, seen from above; no cells without points
    there. The side of a cell is that of a voxel, doubled until there are at most 20,000 cells.

    Args:
        accumulated: Points of all scans, or of a run of one step: x, y in the map and height above the
            ground, shape (N, 3) [m].
    """
    points = accumulated[_at_breast(accumulated[:, 2]), :2].astype(np.float64)
    origin = np.floor(points.mean(axis=0) if len(points) else np.zeros(2))
    side = SIDE
    while True:
        cells = np.unique(np.floor((points - origin) / side).astype(np.int64), axis=0)
        if len(cells) <= _MOST_CELLS:
            return MapSection(side, (float(origin[0]), float(origin[1])), cells.astype(np.int32))
        side *= 2.0


def _at_breast(height: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which heights above the ground, shape (N,) [m], are at least BREAST_LOW and less than
    BREAST_HIGH."""
    return (height >= BREAST_LOW) & (height < BREAST_HIGH)


def check_results(checks: Sequence[Check], row: int) -> list[CheckResult]:
    """Return the checks of the cluster in `row`, in the order in which they decide. The title is
    "" for a check whose limit is not a parameter."""
    titles = {spec.name: spec.title for spec in field_specs()}
    return [
        CheckResult(
            figure=check.figure,
            unit=check.unit,
            value=float(check.value[row]),
            relation=check.relation,
            limit=check.limit,
            parameter=check.parameter,
            title=titles.get(check.parameter, ""),
            fails=bool(check.fails[row]),
            verdict=check.verdict.label,
        )
        for check in checks
    ]
