"""Stories of the stems of a whole cloud: cross-sections with their circles, height, and the checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.explain.history import half_axes
from app.explain.records import CheckResult, ClusterStory, CrossSection, TreeStory
from app.worker.inventory_run import InventoryRun
from pipeline.classification.column_extraction import BREAST
from pipeline.config import field_specs
from pipeline.detection.verdicts import Check
from pipeline.errors import StemmapError
from pipeline.geometry.columns import evenly_spaced
from pipeline.geometry.poses import Float
from pipeline.inventory import PlotMap
from pipeline.inventory.cross_sections import STEP, THICK, slice_heights
from pipeline.inventory.stem_model import stem_checks
from pipeline.types.records import Verdict

_PICTURES = 9  # cross-sections with points
_MOST_POINTS = 300  # of a cross-section
_REACH, _MARGIN = (
    1.6,
    0.1,
)  # a picture shows this multiple of the radius, and at least this margin around it [m]
_UNKNOWN_RADIUS = 0.15  # m, of a candidate without a circle


def cloud_tree_story(run: InventoryRun, number: int) -> TreeStory:
    """Return the explanation of a tree of a whole cloud.

    Args:
        run: The cloud.
        number: Number of the tree.

    Raises:
        StemmapError: There is no such tree, or the cloud is not mapped yet.
    """
    row, plot, frame = run.row_of(number), run.plot, run.frame
    if plot is None or frame is None:
        raise StemmapError("the cloud is not mapped yet", remedy="Wait until its stems are shown")
    trees = frame.trees
    major, minor, angle = half_axes(trees.covariance[row : row + 1])[0].tolist()
    candidate = int(plot.tree_candidate[row])
    return TreeStory(
        tree=number,
        scan=0,
        confirmed=True,
        position=(float(trees.position[row, 0]), float(trees.position[row, 1])),
        ellipse=(major, minor, angle),
        dbh=float(trees.dbh[row]),
        dbh_sigma=float(trees.dbh_sigma[row]),
        coverage_deg=float(np.degrees(trees.coverage[row])),
        dbh_arc_deg=run.parameters_at(0).tracking.dbh_arc_min,
        observations=int(trees.observations[row]),
        cluster=candidate,
        height=float(plot.crowns.height[row]),
        height_sigma=float(plot.crowns.sigma[row]),
        height_hidden=plot.crowns.hidden[row],
        lean_deg=float(np.degrees(trees.lean[row])) if trees.lean is not None else float("nan"),
        sections=cross_sections(plot, candidate),
    )


def cloud_cluster_story(run: InventoryRun, row: int) -> ClusterStory:
    """Return the explanation of a candidate of a whole cloud; without checks if no stem was fitted.

    Args:
        run: The cloud.
        row: Row of the candidate.

    Raises:
        StemmapError: There is no such candidate, or the cloud is not mapped yet.
    """
    plot, frame = run.plot, run.frame
    if plot is None or frame is None or not 0 <= row < len(plot.verdict):
        raise StemmapError(f"there is no candidate {row + 1} in the cloud", remedy="Select another")
    place = plot.place[row]
    tree = np.flatnonzero(plot.tree_candidate == row)
    detection = run.parameters_at(0).detection
    checks = stem_checks(plot.stems, plot.share, detection.radius_min, detection.radius_max)
    return ClusterStory(
        scan=0,
        cluster=row,
        verdict=Verdict(int(plot.verdict[row])).label,
        checks=check_results(checks, row) if np.isfinite(plot.stems["radius"][row]) else [],
        size=int(frame.clusters.size[row]),
        position=(float(place[0]), float(place[1])),
        tree=int(frame.trees.number[tree[0]]) if len(tree) else None,
        tree_distance=0.0 if len(tree) else float("nan"),
        sections=cross_sections(plot, row),
    )


def check_results(checks: Sequence[Check], row: int) -> list[CheckResult]:
    """Return the checks of one cluster or candidate, by its row, in the order in which they decide."""
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


def cross_sections(plot: PlotMap, row: int) -> list[CrossSection]:
    """Return the cross-sections of a candidate, lowest first. Of those with a circle, at most _PICTURES have
    points, that at breast height among them. A candidate without a circle has one section at breast height,
    without a radius.

    Args:
        plot: The map.
        row: Row of the candidate.
    """
    circles, place, heights = plot.circles[row], plot.place[row], slice_heights()
    rows = np.flatnonzero(np.isfinite(circles[:, 2]))
    if not len(rows):
        points = _points_around(plot, BREAST, place, _UNKNOWN_RADIUS)
        nan = float("nan")
        return [CrossSection(BREAST, 0.0, 0.0, nan, nan, 0.0, nan, points)]
    breast = int(np.argmin(np.abs(heights[rows] - BREAST)))
    pictures = {*evenly_spaced(len(rows), _PICTURES - 1).tolist(), breast}
    sections = []
    for k, slab in enumerate(rows.tolist()):
        circle, height = circles[slab], float(heights[slab])
        points = _points_around(plot, height, circle[:2], float(circle[2])) if k in pictures else []
        sections.append(
            CrossSection(
                height=round(height, 2),
                x=round(float(circle[0] - place[0]), 4),
                y=round(float(circle[1] - place[1]), 4),
                radius=float(circle[2]),
                radius_sigma=float(np.sqrt(circle[6])),
                coverage_deg=float(np.degrees(circle[8])),
                scatter=float(circle[7]),
                points=points,
            )
        )
    return sections


def _points_around(plot: PlotMap, height: float, centre: Float, radius: float) -> list[tuple[float, float]]:
    """Return points of a slice around a circle relative to its centre, at most _MOST_POINTS, in mm.

    Args:
        plot: The map.
        height: Middle of the slice above the ground [m].
        centre, radius: The circle [m].
    """
    reach = max(_REACH * radius, radius + _MARGIN)
    inside = np.abs(plot.points[:, 3] - height) < 0.5 * THICK * STEP
    offset = plot.points[inside, :2].astype(np.float64) - centre
    offset = offset[np.hypot(*offset.T) < reach]
    some = np.round(offset[evenly_spaced(len(offset), _MOST_POINTS)], 3)
    return [(x, y) for x, y in some.tolist()]
