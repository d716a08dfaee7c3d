"""Explanations of the trees and candidates of a whole cloud by their cross-sections."""

from __future__ import annotations

import msgspec
import numpy as np

from app.explain.build import check_results, nearest_points
from app.explain.records import ClusterStory, TreeStory, half_axes
from app.extensions.clouds.inventory import PlotMap
from app.extensions.clouds.inventory.cross_sections import STEP, THICK, slice_heights
from app.extensions.clouds.inventory.stem_model import stem_checks
from pipeline.classification.column_extraction import BREAST
from pipeline.classification.forest import CLASSES
from pipeline.config import Parameters
from pipeline.geometry.columns import evenly_spaced
from pipeline.geometry.poses import Float
from pipeline.types.records import Frame, Verdict

NAME = "clouds"
_SECTION_PICTURES = 9  # cross-sections with points
_MOST_SECTION_POINTS = 300  # of a cross-section
# A picture shows this multiple of the radius, and at least this margin around it [m].
_REACH, _MARGIN = 1.6, 0.1
_UNKNOWN_RADIUS = 0.15  # m, of a candidate without a circle


class CrossSection(msgspec.Struct, frozen=True):
    """Horizontal slice through a stem of a whole cloud, with the fitted circle.

    Attributes:
        height: Height of its middle above the ground [m].
        x, y: Centre of the circle relative to the axis at breast height [m].
        radius, radius_sigma: Radius of the circle and its standard deviation [m]; NaN if there is no circle.
        coverage_deg: Part of the circumference with points on it.
        scatter: Standard deviation of the points from the circle [m].
        points: Points relative to the centre of the circle [m]; empty where the section has no picture.
    """

    height: float
    x: float
    y: float
    radius: float
    radius_sigma: float
    coverage_deg: float
    scatter: float
    points: list[tuple[float, float]]


class StemOfCloud(msgspec.Struct, frozen=True):
    """Explanation of a stem of a whole cloud.

    Attributes:
        sections: Cross-sections of the candidate, lowest first.
        height, height_sigma: Height of the tree and its standard deviation [m]; NaN if the top is not seen.
        height_hidden: Reason why the height is unknown; empty if it is known.
        lean_deg: Angle of the stem from the vertical [deg]; NaN if it is not measured.
        votes: Of a candidate: dict from the label of each class to its share of the votes.
        around: Of a candidate: points around it, see `nearest_points`.
    """

    sections: list[CrossSection]
    height: float = float("nan")
    height_sigma: float = float("nan")
    height_hidden: str = ""
    lean_deg: float = float("nan")
    votes: dict[str, float] = {}
    around: list[tuple[float, float, float]] = []


def tree_story(plot: PlotMap, frame: Frame, row: int, parameters: Parameters) -> TreeStory:
    """Return the explanation of a tree.

    Args:
        plot: The map.
        frame: The map as a frame, with the numbers that are shown.
        row: Row of the tree.
        parameters: Parameters with which the cloud was mapped.
    """
    trees = frame.trees
    major, minor, angle = half_axes(trees.covariance[row : row + 1])[0].tolist()
    candidate = int(plot.tree_candidate[row])
    stem = StemOfCloud(
        cross_sections(plot, candidate),
        float(plot.crowns.height[row]),
        float(plot.crowns.sigma[row]),
        plot.crowns.hidden[row],
        float(np.degrees(trees.lean[row])) if trees.lean is not None else float("nan"),
    )
    return TreeStory(
        tree=int(trees.number[row]),
        scan=0,
        confirmed=True,
        position=(float(trees.position[row, 0]), float(trees.position[row, 1])),
        ellipse=(major, minor, angle),
        dbh=float(trees.dbh[row]),
        dbh_sigma=float(trees.dbh_sigma[row]),
        coverage_deg=float(np.degrees(trees.coverage[row])),
        dbh_arc_deg=parameters.tracking.dbh_arc_min,
        observations=int(trees.observations[row]),
        cluster=candidate,
        extensions={NAME: stem},
    )


def cluster_story(plot: PlotMap, frame: Frame, row: int, parameters: Parameters) -> ClusterStory:
    """Return the explanation of the candidate in a row; `checks` is empty if no stem was fitted, and `tree`
    is the number of the tree of this candidate, or None. Fields of a scan keep their defaults. Arguments as
    in `tree_story`."""
    place = plot.place[row]
    tree = np.flatnonzero(plot.tree_candidate == row)
    detection = parameters.detection
    checks = stem_checks(plot.stems, plot.share, detection.radius_min, detection.cloud_radius_max)
    stem = StemOfCloud(
        cross_sections(plot, row),
        votes={kind.label: float(share) for kind, share in zip(CLASSES, plot.share[row], strict=True)},
        around=nearest_points(plot.points[:, [0, 1, 3]], place),
    )
    return ClusterStory(
        scan=0,
        cluster=row,
        verdict=Verdict(int(plot.verdict[row])).label,
        checks=check_results(checks, row) if np.isfinite(plot.stems["radius"][row]) else [],
        size=int(frame.clusters.size[row]),
        position=(float(place[0]), float(place[1])),
        tree=int(frame.trees.number[tree[0]]) if len(tree) else None,
        extensions={NAME: stem},
    )


def cross_sections(plot: PlotMap, row: int) -> list[CrossSection]:
    """Return the cross-sections of a candidate that have a circle, lowest first. At most `_SECTION_PICTURES`
    of them have points, among them the one nearest to breast height. A candidate without any circle has one
    section at breast height, with points and the radius NaN.

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
    pictures = {*evenly_spaced(len(rows), _SECTION_PICTURES - 1).tolist(), breast}
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
    """Return at most _MOST_SECTION_POINTS points of a slice around a circle as (x, y) relative to the centre
    of the circle [m], rounded to 1 mm. The points are less than _REACH radii, or less than the radius plus
    _MARGIN if that is more, from the centre.

    Args:
        plot: The map.
        height: Middle of the slice above the ground [m].
        centre, radius: The circle [m].
    """
    reach = max(_REACH * radius, radius + _MARGIN)
    inside = np.abs(plot.points[:, 3] - height) < 0.5 * THICK * STEP
    offset = plot.points[inside, :2].astype(np.float64) - centre
    offset = offset[np.hypot(*offset.T) < reach]
    some = np.round(offset[evenly_spaced(len(offset), _MOST_SECTION_POINTS)], 3)
    return [(x, y) for x, y in some.tolist()]
