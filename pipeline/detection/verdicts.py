"""Verdicts on clusters (section 3.3 of the paper): tree, or the reason for the rejection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.config.stages import Detection
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Clusters, Detections, Int, Verdict


def classify_clusters(clusters: Clusters, parameters: Detection) -> Clusters:
    """Return the clusters with their verdicts: the first check that fails, in the order of `checks`, else
    TREE."""
    verdict = np.full(len(clusters.size), Verdict.TREE, np.int32)
    for check in reversed(checks(clusters, parameters)):  # the first check that fails is written last
        verdict[check.fails] = check.verdict
    return replace(clusters, verdict=verdict)


def detections(clusters: Clusters, sensor_offset: Float, parameters: Detection) -> Detections:
    """Return the clusters with the verdict TREE in the base frame (Eq. 8: p_base = T_base_lidar p_lidar)."""
    rows = np.flatnonzero(clusters.verdict == Verdict.TREE)
    centre, covariance = _seen_from_base(
        rows,
        clusters.centre,
        clusters.covariance,
        sensor_offset,
        parameters.sigma_range,
        float(np.radians(parameters.sigma_bearing)),
    )
    return Detections(
        cluster=rows,
        centre=centre,
        covariance=covariance,
        radius=clusters.radius[rows],
        radius_sigma=clusters.radius_sigma[rows],
        arc=clusters.arc[rows],
        eccentricity=clusters.eccentricity[rows],
    )


@compiled
def _seen_from_base(
    rows: Int,
    centre: Float,
    covariance: Float,
    sensor_offset: Float,
    sigma_range: float,
    sigma_bearing: float,
) -> tuple[Float, Float]:
    """Return centres and covariances of the given clusters in the base frame.

    The covariance is that of the fit plus `sigma_range` along the ray and `sigma_bearing` times the range
    across it.

    Returns:
        Centres, shape (D, 2) [m]; covariances, shape (D, 2, 2) [m^2].
    """
    place, spread = np.empty((len(rows), 2)), np.empty((len(rows), 2, 2))
    for d in range(len(rows)):
        x, y = centre[rows[d], 0], centre[rows[d], 1]
        reach = max(np.sqrt(x * x + y * y), 1e-6)
        ux, uy = x / reach, y / reach
        along, across = sigma_range * sigma_range, (reach * sigma_bearing) ** 2
        C, R = covariance[rows[d]], spread[d]
        R[0, 0] = C[0, 0] + along * ux * ux + across * uy * uy
        R[0, 1] = C[0, 1] + (along - across) * ux * uy
        R[1, 0] = C[1, 0] + (along - across) * ux * uy
        R[1, 1] = C[1, 1] + along * uy * uy + across * ux * ux
        place[d, 0], place[d, 1] = x + sensor_offset[0], y + sensor_offset[1]
    return place, spread


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """One check of all clusters.

    Attributes:
        verdict: Verdict of a cluster that fails this check and no earlier one.
        figure: Name of the checked quantity.
        unit: Unit of `value` and `limit`.
        value: shape (K,), NaN if unknown.
        relation: "at least" or "at most" the limit; empty for a yes/no check, which fails for yes (1).
        limit: NaN without a limit.
        parameter: Dotted name of the parameter that sets the limit, empty without one.
        fails: shape (K,); a check of an unknown value does not fail.
    """

    verdict: Verdict
    figure: str
    unit: str
    value: Float
    relation: Literal["at least", "at most", ""]
    limit: float
    parameter: str
    fails: Bool


def checks(clusters: Clusters, parameters: Detection) -> tuple[Check, ...]:
    """Return the checks of `classify_clusters` in their order, with all values and limits, as an
    explanation."""
    p, c = parameters, clusters
    has_circle = np.isfinite(c.radius)
    radius = np.where(has_circle, c.radius, np.nan)
    arc = np.where(has_circle, c.arc, np.nan)
    cut = c.cut & p.whole
    width, up = np.maximum(c.extent[:, 0], c.extent[:, 1]), c.extent[:, 2]
    return (
        Check(Verdict.HIDDEN, "edge hidden", "", c.hidden.astype(np.float64), "", np.nan, "", c.hidden),
        _at_most(Verdict.TOO_THICK, "width", "m", width, p.size_max, "size_max"),
        _at_least(Verdict.TOO_LOW, "visible height", "m", up, p.height_extent_min, "height_extent_min"),
        Check(
            Verdict.AT_BORDER,
            "cut off at the border",
            "",
            cut.astype(np.float64),
            "",
            np.nan,
            "detection.whole" if p.whole else "",
            cut,
        ),
        _at_least(Verdict.TOO_ROUND, "eccentricity", "", c.eccentricity, p.e_min, "e_min"),
        _at_most(Verdict.TOO_LONG, "eccentricity", "", c.eccentricity, p.e_max, "e_max"),
        _at_most(
            Verdict.NOT_ROUND,
            "radial deviation",
            "m",
            c.radial_std,
            p.cylindrical_stddev_thresh,
            "cylindrical_stddev_thresh",
        ),
        Check(
            Verdict.NO_ARC,
            "visible arc",
            "deg",
            np.degrees(arc),
            "at least",
            p.arc_min,
            "detection.arc_min",
            arc < np.radians(p.arc_min),
        ),
        _at_least(Verdict.TOO_THIN, "radius", "m", radius, p.radius_min, "radius_min"),
        _at_most(Verdict.TOO_THICK, "radius", "m", radius, p.radius_max, "radius_max"),
    )


def _at_least(verdict: Verdict, figure: str, unit: str, value: Float, limit: float, name: str) -> Check:
    return Check(verdict, figure, unit, value, "at least", limit, f"detection.{name}", value < limit)


def _at_most(verdict: Verdict, figure: str, unit: str, value: Float, limit: float, name: str) -> Check:
    return Check(verdict, figure, unit, value, "at most", limit, f"detection.{name}", value > limit)
