"""Tells the stories: of a cluster from its scan's frame, of a tree from the newest one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.explain.estimate_history import TreeHistory, half_axes
from app.explain.records import Asked, Circle, ClusterStory, Gathered, Told, TreeStory
from app.training.learned_forests import kept_forests
from pipeline.classification.feature_attribution import what_told
from pipeline.classification.features import NAMES
from pipeline.classification.forest import CLASSES, TREE_IN_FREE_AIR, standard_forest, tree_in_free_air
from pipeline.config import Parameters, field_specs
from pipeline.detection.cylinder_fit import StemFit, fit_one
from pipeline.detection.verdicts import checks
from pipeline.types.records import Clusters, Frame, Sensor, Verdict

Float = NDArray[np.float64]

_NS = 1_000_000_000
_MOST_POINTS = 400
_MOST_TOLD = 6
_COLUMN_REACH = 0.45  # m; what stands farther away is another thing
_SIDES = 36


def make_ready(sensor: Sensor) -> None:
    """Have compiled what stories need, so that the first one does not hold up the map."""
    angle = np.linspace(2.0, 4.0, 12)
    arc = np.column_stack([5.0 + 0.2 * np.cos(angle), 0.2 * np.sin(angle), np.linspace(0.0, 1.0, 12)])
    fit_one(arc, sensor)
    what_told(np.zeros(len(NAMES)), standard_forest(sensor.rings > 0), Verdict.TREE)


def tell_cluster(
    frame: Frame, row: int, parameters: Parameters, sensor: Sensor, start_ns: int
) -> ClusterStory:
    """The story of a cluster.

    Args:
        frame: The scan's results, `raw` not needed.
        row: Of the cluster in it.
        parameters: That the scan was mapped with.
        sensor: The LiDAR.
        start_ns: Time of the run's first scan.
    """
    clusters, pose = frame.clusters, frame.estimate.T_map_base
    points = frame.filtered[frame.labels == row].astype(np.float64)
    # Only presets that fit circles have a sigma; what the page is told must be what was judged.
    fit = fit_one(points, sensor) if np.isfinite(clusters.radius_sigma[row]) else None
    to_picture = _to_picture(clusters.centre[row])
    offset = points[:, :2] - clusters.centre[row] if fit is None else fit.offset
    some = _evenly(len(points), _MOST_POINTS)
    place = pose.apply(clusters.centre[row] + frame.sensor_offset[:2])
    tree, tree_distance = _nearest_tree(frame, place, parameters.tracking.distance_max)
    return ClusterStory(
        scan=frame.index,
        cluster=row,
        time_s=(frame.stamp_ns - start_ns) / _NS,
        verdict=Verdict(int(clusters.verdict[row])).label,
        checks=asked(clusters, row, parameters),
        size=int(clusters.size[row]),
        eccentricity=float(clusters.eccentricity[row]),
        position=(float(place[0]), float(place[1])),
        distance=float(np.hypot(*clusters.centre[row])),
        sensor_sigma=sensor.range_sigma,
        points=[(float(x), float(y)) for x, y in offset[some] @ to_picture.T],
        residual=[] if fit is None else fit.residual[some].tolist(),
        circle=None if fit is None else _circle(fit, clusters.covariance[row], to_picture),
        axes=_axes(points[:, :2], to_picture),
        tree=tree,
        tree_distance=tree_distance,
        gathered=gathered(frame, place, parameters, sensor),
    )


def tell_tree(
    frame: Frame,
    row: int,
    parameters: Parameters,
    sensor: Sensor,
    start_ns: int,
    history: TreeHistory,
) -> TreeStory:
    """The story of a tree: row `row` of the frame's trees; the other arguments as in `tell_cluster`."""
    trees = frame.trees
    major, minor, angle = half_axes(trees.covariance[row : row + 1])[0].tolist()
    sides = [] if trees.sides is None else [bool(int(trees.sides[row]) >> k & 1) for k in range(_SIDES)]
    return TreeStory(
        tree=int(trees.number[row]),
        scan=frame.index,
        time_s=(frame.stamp_ns - start_ns) / _NS,
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
        first_seen_s=(int(trees.first_seen_ns[row]) - start_ns) / _NS,
        last_seen_s=(int(trees.last_seen_ns[row]) - start_ns) / _NS,
        cluster=_cluster_of(frame, trees.position[row], parameters.tracking.distance_max),
        gathered=gathered(frame, trees.position[row], parameters, sensor),
        history=history.of(int(trees.number[row])),
    )


def asked(clusters: Clusters, row: int, parameters: Parameters) -> list[Asked]:
    """The checks of one cluster; none of a stem that another program found."""
    titles = {spec.name: spec.title for spec in field_specs()}
    if np.isnan(clusters.eccentricity[row]):  # a stem that another program found is asked nothing
        return []
    return [
        Asked(
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
        for check in checks(clusters, parameters.detection)
    ]


def gathered(frame: Frame, place: Float, parameters: Parameters, sensor: Sensor) -> Gathered | None:
    """What was gathered at a place (x, y) of the map; None where no column stands there."""
    columns = frame.columns
    if columns is None or not len(columns.verdict):
        return None
    distance = np.linalg.norm(columns.axis[:, :2] - place, axis=1)
    tree = columns.verdict == Verdict.TREE
    # A tree is meant rather than the bush beside it.
    row = int(np.argmin(np.where(tree & (distance <= _COLUMN_REACH), distance - _COLUMN_REACH, distance)))
    if distance[row] > _COLUMN_REACH:
        return None
    share, verdict = columns.share[row], Verdict(int(columns.verdict[row]))
    forest = kept_forests()(parameters.classification.forest, sensor.rings > 0)
    figures = columns.figures[row]
    in_free_air = float(tree_in_free_air(figures[None], forest)[0])
    refused = forest.free_end if in_free_air < TREE_IN_FREE_AIR else None
    effect = what_told(figures, refused or forest, Verdict.TREE)
    strongest = np.argsort(-np.abs(effect), kind="stable")[:_MOST_TOLD]
    return Gathered(
        verdict=verdict.label,
        distance=float(distance[row]),
        votes={kind.label: float(share[k]) for k, kind in enumerate(CLASSES)},
        tree_share=parameters.classification.tree_share,
        tree_in_free_air=None if np.isnan(in_free_air) else in_free_air,
        by_votes=verdict in _decided_by(share, parameters.classification.tree_share),
        present=int(columns.present[row]),
        absent=int(columns.absent[row]),
        viewed=float(columns.viewed[row]),
        told=[
            Told(NAMES[k], float(figures[k]), float(effect[k]))
            for k in strongest.tolist()
            if effect[k] != 0.0
        ],
    )


def _decided_by(share: Float, tree_share: float) -> tuple[Verdict, ...]:
    """The verdict that the votes alone give."""
    if share[0] >= tree_share:
        return (Verdict.TREE,)
    most = CLASSES[int(share.argmax())]
    return (Verdict.OTHER,) if most is Verdict.TREE else (most,)


def _nearest_tree(frame: Frame, place: Float, reach: float) -> tuple[int | None, float]:
    trees = frame.trees
    rows = np.flatnonzero(trees.confirmed)
    if not len(rows):
        return None, float("nan")
    distance = np.linalg.norm(trees.position[rows] - place, axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > reach:
        return None, float("nan")
    return int(trees.number[rows[nearest]]), float(distance[nearest])


def _cluster_of(frame: Frame, place: Float, reach: float) -> int | None:
    """The cluster nearest to a tree's place, one that was taken for a tree if there is one in reach."""
    centre = frame.estimate.T_map_base.apply(frame.clusters.centre + frame.sensor_offset[:2])
    distance = np.linalg.norm(centre - place, axis=1)
    for rows in (frame.detections.cluster, np.arange(len(distance))):
        if len(rows) and distance[rows].min() <= reach:
            return int(rows[np.argmin(distance[rows])])
    return None


def _to_picture(centre: Float) -> Float:
    """Turns level sensor coordinates into the picture's: up is away from the sensor, shape (2, 2)."""
    reach = max(float(np.hypot(*centre)), 1e-9)
    ux, uy = centre / reach
    return np.array([[uy, -ux], [ux, uy]])


def _circle(fit: StemFit, covariance: Float, to_picture: Float) -> Circle:
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
    if not len(points):  # a stem that another program found
        return []
    spread = points - points.mean(axis=0)
    values, vectors = np.linalg.eigh(spread.T @ spread / max(len(points), 1))
    arms = to_picture @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    return [(float(arms[0, k]), float(arms[1, k])) for k in (1, 0)]


def _evenly(n: int, most: int) -> NDArray[np.int64]:
    """Rows of a table of n rows, at most `most` of them and none twice."""
    return np.arange(n) if n <= most else np.arange(most) * n // most
