"""Detection of truncated clusters: clusters cut off by the box, the range limits or the sides of the field of
view.

The circle of a truncated cluster does not describe the trunk. Trunks also leave the field of view at the top
and at the bottom, which does not affect their circle; these sides do not count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.config.stages import Acquisition, Filters
from pipeline.detection.free_space import BINS, directions, widest_gap
from pipeline.geometry.directions import bin_direction
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int32, Labels, Sensor, UInt16

SHOTS = 2.0  # a cluster within this many shots of a border is truncated
BLIND = BINS // 4  # empty bins in a row, about a quarter turn, outside of the field of view
EDGE = 2  # bins of about one degree at the edge of the field of view
OTHERS = 5  # returns at other ranges that end at the same edge; without them the edge is that of the trunk
APART = 0.5  # m; range difference that separates two objects


class FieldOfView(NamedTuple):
    """Horizontal field of view of a scan.

    Attributes:
        c, s: Cosine and sine of the bearing of its middle.
        right, left: Bearings of the outermost returns relative to the middle, positive to the left [rad];
            infinite for a field of view of 360 degrees.
        at_right, at_left: Ranges of the returns at the two edges [m].
    """

    c: float
    s: float
    right: float
    left: float
    at_right: Float
    at_left: Float


def is_truncated(
    points: Float32,
    labels: Labels,
    raw: Float32,
    sensor: Sensor,
    filters: Filters,
    acquisition: Acquisition,
) -> Bool:
    """Return whether each cluster may be cut off: a point of it is within two shots (at least the range
    sigma) of a vertical face of the box, of a range limit, or of an edge of the field of view at which OTHERS
    or more returns at other ranges end too; shape (K,).

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        labels: Cluster of each point, -1 for none.
        raw: The whole scan, from which the field of view is estimated, float32, shape (M, 3) [m], same frame.
        sensor: Angle between shots, range sigma and maximum range of the LiDAR.
        filters: The pass-through box, whose vertical faces are borders.
        acquisition: Minimum and maximum range; the smaller one of this maximum and that of the sensor counts.
    """
    box = np.array([filters.x_min, filters.x_max, filters.y_min, filters.y_max])
    ranges = np.array([acquisition.range_min, min(acquisition.range_max, sensor.range_max)])
    least = sensor.range_sigma
    return _touches(
        points, labels.label, labels.clusters, box, ranges, sensor.azimuth_step, least, field_of_view(raw)
    )


def field_of_view(raw: Float32) -> FieldOfView:
    """Estimate the horizontal field of view from the points of a scan, shape (M, 3) [m], sensor frame. It is
    360 degrees unless BLIND bins or more in a row have no return; also for an empty scan."""
    bins = directions(raw, np.zeros(3))
    first, blind = widest_gap(bins)
    if blind < BLIND:
        return FieldOfView(1.0, 0.0, -np.inf, np.inf, np.zeros(0), np.zeros(0))
    c, s = bin_direction(first + blind + (BINS - blind) // 2, BINS)
    right, at_right = _end(raw[_within(bins, first + blind)], c, s, -1.0)
    left, at_left = _end(raw[_within(bins, first - EDGE)], c, s, 1.0)
    return FieldOfView(c, s, -right, left, at_right, at_left)


def _within(bins: UInt16, first: int) -> Bool:
    """Return the mask of the returns in the EDGE bins from `first` on, shape (N,); `bins` are the bins of the
    returns, and `first` is taken modulo BINS."""
    inside: Bool = (bins.astype(np.int64) - first) % BINS < EDGE
    return inside


def _end(beside: Float32, c: float, s: float, side: float) -> tuple[float, Float]:
    """Return the largest bearing [rad] of returns to a side, and the horizontal ranges of all these returns,
    shape (N,) [m].

    Args:
        beside: Returns at one edge of the field of view, shape (N, 3) [m], N at least 1.
        c, s: Cosine and sine of the direction from which bearings are counted.
        side: 1 for bearings that increase to the left, -1 to the right.
    """
    x, y = beside[:, 0].astype(np.float64), beside[:, 1].astype(np.float64)
    turn = side * np.arctan2(c * y - s * x, c * x + s * y)
    return float(turn.max()), np.hypot(x, y)


@compiled
def _touches(
    points: Float32,
    label: Int32,
    clusters: int,
    box: Float,
    ranges: Float,
    azimuth_step: float,
    least: float,
    view: FieldOfView,
) -> Bool:
    """Return whether each cluster has a point at a border, see `is_truncated`, shape (K,).

    Args:
        points: Points in the sensor frame, float32, shape (N, 3) [m].
        label: Cluster of each point, -1 for none, shape (N,).
        clusters: Number of clusters K.
        box: Faces x_min, x_max, y_min, y_max of the box, shape (4,) [m].
        ranges: Minimum and maximum range, shape (2,) [m].
        azimuth_step: Angle between shots [rad].
        least: Lower bound of the distance from a border within which a point is at the border [m].
        view: Field of view; its edges count only if it is less than 360 degrees.
    """
    cut = np.zeros(clusters, np.bool_)
    one_way = np.isfinite(view.left)
    for i in range(points.shape[0]):
        k = label[i]
        if k < 0 or cut[k]:
            continue
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        reach = np.sqrt(x * x + y * y)
        away = np.sqrt(reach * reach + z * z)
        near = max(SHOTS * azimuth_step * reach, least)
        to_box = min(min(x - box[0], box[1] - x), min(y - box[2], box[3] - y))
        cut[k] = min(to_box, min(away - ranges[0], ranges[1] - away)) < near
        if one_way and not cut[k]:
            turn = np.arctan2(view.c * y - view.s * x, view.c * x + view.s * y)
            step = SHOTS * azimuth_step
            cut[k] = (turn - view.right < step and _others(view.at_right, reach)) or (
                view.left - turn < step and _others(view.at_left, reach)
            )
    return cut


@compiled
def _others(away: Float, reach: float) -> bool:
    """Return whether OTHERS or more returns at an edge have ranges `away`, shape (N,) [m], that differ by
    more than APART from `reach` [m]."""
    others = 0
    for d in away:
        others += abs(d - reach) > APART
    return others >= OTHERS
