"""One cluster's stem with the residual of each of its points, to be looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.detection.stem_fit.cylinder_fit import MOST_POINTS, fit_stems
from pipeline.geometry.poses import Float
from pipeline.types.records import Sensor


@dataclass(frozen=True, slots=True, eq=False)
class StemFit:
    """A leaning cylinder through the points of one cluster, in the level sensor frame.

    Attributes:
        centre: Of the axis at the points' mean height, shape (2,) [m].
        lean: Shift of the axis in x and y per metre of height, shape (2,).
        radius, radius_sigma: [m].
        arc: Visible part of the circle [rad]; arc_start: where it begins, counter-clockwise [rad].
        offset: Horizontally from the axis at its own height to each point, shape (N, 2) [m].
        residual: Distance of each point from the cylinder, outside positive, shape (N,) [m].
    """

    centre: Float
    lean: Float
    radius: float
    radius_sigma: float
    arc: float
    arc_start: float
    offset: Float
    residual: Float


def fit_one(points: Float, sensor: Sensor) -> StemFit | None:
    """The fit of `describe` for the points (N, 3) of one cluster; None where they are too few for it."""
    if not len(points):
        return None
    stem = fit_stems(points, np.array([0, len(points)]), sensor.range_sigma, sensor.azimuth_step)[0]
    if not np.isfinite(stem[5]):
        return None
    lean = stem[9:11]
    n = min(len(points), MOST_POINTS)
    fitted = np.arange(n) * len(points) // n  # the points that the fit itself takes
    height = points[:, 2] - points[fitted, 2].mean()
    offset: Float = points[:, :2] - stem[:2] - height[:, None] * lean
    return StemFit(
        centre=stem[:2],
        lean=lean,
        radius=float(stem[5]),
        radius_sigma=float(stem[6]),
        arc=float(stem[8]),
        arc_start=arc_start(np.arctan2(offset[fitted, 1], offset[fitted, 0])),
        offset=offset,
        residual=np.hypot(offset[:, 0], offset[:, 1]) - stem[5],
    )


def arc_start(angle: Float) -> float:
    """Where the arc that directions (N,) fill begins, counter-clockwise: after their largest gap [rad]."""
    ordered = np.sort(angle)
    gaps = np.diff(np.append(ordered, ordered[0] + 2.0 * np.pi))
    return float(ordered[(int(np.argmax(gaps)) + 1) % len(ordered)])
