"""Detection: which clusters are trees, and for each other one the reason why it is not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.config.stages import Detection
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Bool, Clusters, Detections, Int, Int32, Verdict


def judge(clusters: Clusters, parameters: Detection) -> Clusters:
    """The clusters with their verdicts: the first reason that holds, in the order below, else TREE."""
    p, c = parameters, clusters
    verdict = _verdicts(
        c.hidden,
        c.cut,
        c.extent,
        c.eccentricity,
        c.radial_std,
        c.radius,
        c.arc,
        p.size_max,
        p.height_extent_min,
        p.whole,
        p.e_min,
        p.e_max,
        p.cylindrical_stddev_thresh,
        float(np.radians(p.arc_min)),
        p.radius_min,
        p.radius_max,
    )
    return replace(clusters, verdict=verdict)


@compiled
def _verdicts(
    hidden: Bool,
    cut: Bool,
    extent: Float,
    eccentricity: Float,
    radial_std: Float,
    radius: Float,
    arc: Float,
    size_max: float,
    height_extent_min: float,
    whole: bool,
    e_min: float,
    e_max: float,
    deviation_max: float,
    arc_min: float,
    radius_min: float,
    radius_max: float,
) -> Int32:
    verdict = np.empty(len(hidden), np.int32)
    for k in range(len(hidden)):
        # What is not a number fails every comparison: without a circle its figures are not asked for.
        has_circle = np.isfinite(radius[k])
        if hidden[k]:
            verdict[k] = Verdict.HIDDEN
        elif max(extent[k, 0], extent[k, 1]) > size_max:
            verdict[k] = Verdict.TOO_THICK
        elif extent[k, 2] < height_extent_min:
            verdict[k] = Verdict.TOO_LOW
        elif whole and cut[k]:  # what comes below is told by a whole side of the trunk
            verdict[k] = Verdict.AT_BORDER
        elif eccentricity[k] < e_min:
            verdict[k] = Verdict.TOO_ROUND
        elif eccentricity[k] > e_max:
            verdict[k] = Verdict.TOO_LONG
        elif radial_std[k] > deviation_max:
            verdict[k] = Verdict.NOT_ROUND
        elif has_circle and arc[k] < arc_min:
            verdict[k] = Verdict.NO_ARC
        elif has_circle and radius[k] < radius_min:
            verdict[k] = Verdict.TOO_THIN
        elif has_circle and radius[k] > radius_max:
            verdict[k] = Verdict.TOO_THICK
        else:
            verdict[k] = Verdict.TREE
    return verdict


def detections(clusters: Clusters, sensor_offset: Float, parameters: Detection) -> Detections:
    """The clusters judged to be trees, in the base frame (Eq. 8: p_base = T_base_lidar p_lidar)."""
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
    """Centres of the clusters in these rows in the base frame, shape (D, 2) [m], and covariances, shape
    (D, 2, 2) [m^2]: the fit's and what it does not know of, an error of `sigma_range` along the ray and
    of `sigma_bearing` times the distance across it."""
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
    """One question that every cluster is asked.

    Attributes:
        verdict: Of a cluster that fails, when no earlier check failed.
        figure: What is looked at, in words.
        unit: Of `value` and `limit`.
        value: shape (K,), NaN where it cannot be told.
        relation: "at least" or "at most" the limit; empty where yes (1) fails and no (0) passes.
        limit: NaN where there is none.
        parameter: Dotted name of the limit, empty where there is none.
        fails: shape (K,); what cannot be told does not fail.
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
    """What `judge` asks, in its order, with every figure and limit: for who wants to know why."""
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
