"""Verdicts on clusters (section 3.3 of the paper): tree, or the reason for the rejection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.config.stages import Detection
from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Clusters, Detections, Verdict


def classify_clusters(clusters: Clusters, parameters: Detection) -> Clusters:
    """Return the clusters with new verdicts: that of the first check that fails, in the order of `checks`,
    else TREE. The argument is not changed; its verdicts have no effect. A check of an unknown value (NaN)
    does not fail."""
    verdict = np.full(len(clusters.size), Verdict.TREE, np.int32)
    for check in reversed(checks(clusters, parameters)):  # the first check that fails is written last
        verdict[check.fails] = check.verdict
    return replace(clusters, verdict=verdict)


def detections(clusters: Clusters, sensor_offset: Float, parameters: Detection) -> Detections:
    """Return the clusters with the verdict TREE in the base frame (Eq. 8: p_base = T_base_lidar p_lidar), in
    their order; the arrays are copies.

    Args:
        clusters: Clusters with verdicts, level sensor frame.
        sensor_offset: Position of the sensor in the level base frame, x, y first [m].
        parameters: `sigma_range` and `sigma_bearing`, whose covariance is added to that of the fit.
    """
    rows = np.flatnonzero(clusters.verdict == Verdict.TREE)
    place, covariance = clusters.centre[rows], clusters.covariance[rows]
    reach = np.maximum(np.sqrt(place[:, 0] * place[:, 0] + place[:, 1] * place[:, 1]), 1e-6)
    ux, uy = (place / reach[:, None]).T
    along = parameters.sigma_range * parameters.sigma_range
    across = (reach * np.radians(parameters.sigma_bearing)) ** 2
    covariance[:, 0, 0] = covariance[:, 0, 0] + along * ux * ux + across * uy * uy
    covariance[:, 0, 1] += (along - across) * ux * uy
    covariance[:, 1, 0] += (along - across) * ux * uy
    covariance[:, 1, 1] = covariance[:, 1, 1] + along * uy * uy + across * ux * ux
    return Detections(
        cluster=rows,
        centre=place + sensor_offset[:2],
        covariance=covariance,
        radius=clusters.radius[rows],
        radius_sigma=clusters.radius_sigma[rows],
        arc=clusters.arc[rows],
        eccentricity=clusters.eccentricity[rows],
    )


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
    """Return the checks of `classify_clusters` in their order, with all values and limits, as an explanation.
    All checks are returned for all clusters, also those that come after a failed one; the verdicts of the
    clusters are not read. Radius and arc are NaN for clusters without a circle."""
    p, c = parameters, clusters
    has_circle = np.isfinite(c.radius)
    radius = np.where(has_circle, c.radius, np.nan)
    arc = np.where(has_circle, c.arc, np.nan)
    cut = c.cut & p.whole
    width, up = np.maximum(c.extent[:, 0], c.extent[:, 1]), c.extent[:, 2]
    return (
        _flag(Verdict.HIDDEN, "edge hidden", c.hidden, ""),
        _at_most(Verdict.TOO_THICK, "width", "m", width, p.size_max, "size_max"),
        _at_least(Verdict.TOO_LOW, "visible height", "m", up, p.height_extent_min, "height_extent_min"),
        _flag(Verdict.AT_BORDER, "cut off at the border", cut, "detection.whole" if p.whole else ""),
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


def _flag(verdict: Verdict, figure: str, is_set: Bool, parameter: str) -> Check:
    """Return a yes/no check that fails where `is_set`, shape (K,), is true.

    Args:
        verdict: Verdict of a cluster that fails.
        figure: Name of the checked quantity.
        is_set: Whether each cluster fails.
        parameter: Dotted name of the parameter; empty without one.
    """
    return Check(verdict, figure, "", is_set.astype(np.float64), "", np.nan, parameter, is_set)


def _at_least(verdict: Verdict, figure: str, unit: str, value: Float, limit: float, name: str) -> Check:
    """Return a check that fails below a limit, not for NaN.

    Args:
        verdict: Verdict of a cluster that fails.
        figure, unit: Name and unit of the quantity.
        value: Quantity of each cluster, shape (K,).
        limit: The limit, which passes.
        name: Name of the parameter of the stage `detection` that sets it.
    """
    return Check(verdict, figure, unit, value, "at least", limit, f"detection.{name}", value < limit)


def _at_most(verdict: Verdict, figure: str, unit: str, value: Float, limit: float, name: str) -> Check:
    """Return a check that fails above a limit, not for NaN; arguments as in `_at_least`."""
    return Check(verdict, figure, unit, value, "at most", limit, f"detection.{name}", value > limit)
