"""Detection of truncated clusters: clusters cut off by the box, the range limits or the sides of the field of
view.

The circle of a truncated cluster does not describe the trunk. Trunks also leave the field of view at the top
and at the bottom, which does not affect their circle; these sides do not count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.config.stages import Acquisition, Filters
from pipeline.detection.free_space import BINS, directions
from pipeline.geometry.azimuth_bins import bin_direction
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Float32, Int32, Labels, Sensor, UInt16

SHOTS = 2.0  # between the last return and a border; the next one would have lain beyond it
BLIND = BINS // 4  # bins without a return in a row, about a quarter of a turn: there the sensor does not look
EDGE = 2  # bins of about a degree, whose returns show where the view ends
OTHERS = 5  # returns of other things that end there too, or else it is the trunk's own edge
APART = 0.5  # m; what lies so much nearer or farther is another thing


class View(NamedTuple):
    """Where a field of view ends at its sides.

    Attributes:
        c, s: Direction of its middle, cosine and sine.
        right, left: Its last returns there, from the middle, positive to the left [rad]; infinite when the
            sensor looks all around.
        at_right, at_left: How far away the returns beside these lie [m].
    """

    c: float
    s: float
    right: float
    left: float
    at_right: Float
    at_left: Float


def is_cut(
    points: Float32,
    labels: Labels,
    raw: Float32,
    sensor: Sensor,
    filters: Filters,
    acquisition: Acquisition,
) -> Bool:
    """Whether each cluster reaches to within two shots of a border, shape (K,).

    Args:
        points: float32, shape (N, 3) [m], level sensor frame.
        labels: The cluster of each point.
        raw: float32, shape (M, 3) [m], same frame: the whole scan, which tells the field of view.
        sensor: Its angle between shots, and how far it reaches.
        filters: The pass-through box, of which the upright faces are borders.
        acquisition: The least and greatest range.
    """
    box = np.array([filters.x_min, filters.x_max, filters.y_min, filters.y_max])
    ranges = np.array([acquisition.range_min, min(acquisition.range_max, sensor.range_max)])
    least = sensor.range_sigma
    return _touches(
        points, labels.label, labels.clusters, box, ranges, sensor.azimuth_step, least, view_of(raw)
    )


def view_of(raw: Float32) -> View:
    """Where a scan's field of view ends; points of shape (M, 3) [m], sensor frame."""
    bins = directions(raw, np.zeros(3))
    first, blind = _widest_gap(bins)
    if blind < BLIND:
        return View(1.0, 0.0, -np.inf, np.inf, np.zeros(0), np.zeros(0))
    c, s = bin_direction(first + blind + (BINS - blind) // 2, BINS)
    right, at_right = _end(raw[_within(bins, first + blind)], c, s, -1.0)
    left, at_left = _end(raw[_within(bins, first - EDGE)], c, s, 1.0)
    return View(c, s, -right, left, at_right, at_left)


@compiled
def _widest_gap(bins: UInt16) -> tuple[int, int]:
    """The first of the most bins in a row without a return, and how many; none of a scan without any."""
    lit = np.zeros(BINS, np.bool_)
    for k in bins:
        lit[k] = True
    first, most, run = 0, 0, 0
    for k in range(2 * BINS):  # twice around, so that a gap over the seam counts as one
        run = 0 if lit[k % BINS] else run + 1
        if most < run <= BINS:
            first, most = k + 1 - run, run
    return first % BINS, most if most < BINS else 0


def _within(bins: UInt16, first: int) -> Bool:
    """Which returns lie in the EDGE bins from that one on."""
    inside: Bool = (bins.astype(np.int64) - first) % BINS < EDGE
    return inside


def _end(beside: Float32, c: float, s: float, side: float) -> tuple[float, Float]:
    """How far to that side (1 left, -1 right) returns lie [rad], and how far away they all are [m]."""
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
    view: View,
) -> Bool:
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
    """Whether enough other things end at the edge too."""
    others = 0
    for d in away:
        others += abs(d - reach) > APART
    return others >= OTHERS
