"""Verdicts on clusters (section 3.3 of the paper): tree, or the reason for the rejection."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from pipeline.config.stages import Detection
from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Clusters, Detections, Verdict


def classify_clusters(clusters: Clusters, parameters: Detection) -> Clusters:
    """Return the clusters with new verdicts: that of the first check that fails, in the order of `checks`,
    else TREE. The argument is not changed; its verdicts have no effect, and its other columns are shared. A
    check of an unknown value (NaN) does not fail."""
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
        parameters: `sigma_range` [m] and `sigma_bearing` [degrees], whose covariance is added to that of the
            fit.
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


AT_LEAST: Final = "at least"
AT_MOST: Final = "at most"
NO_LIMIT: Final = ""


@dataclass(frozen=True, slots=True, eq=False)
class Check:
    """One check of all clusters.

    Attributes:
        verdict: Verdict of a cluster that fails this check and no earlier one.
        figure: Name of the checked quantity for people.
        unit: Unit of `value` and `limit`.
        value: Value of each cluster, shape (K,); NaN if unknown.
        relation: AT_LEAST or AT_MOST the limit, which passes; NO_LIMIT for a yes/no check, which fails for
            yes (1).
        limit: Limit of the value; NaN if there is none.
        parameter: Dotted name of the parameter that sets the limit; "" if there is none.
    """

    verdict: Verdict
    figure: str
    unit: str
    value: Float
    relation: Literal["at least", "at most", ""]
    limit: float = math.nan
    parameter: str = ""

    @property
    def fails(self) -> Bool:
        """Whether each cluster fails, shape (K,); a check of an unknown value does not fail."""
        if self.relation == AT_LEAST:
            return np.asarray(self.value < self.limit)
        return np.asarray(self.value > (self.limit if self.relation == AT_MOST else 0.0))


def checks(clusters: Clusters, parameters: Detection) -> tuple[Check, ...]:
    """Return the checks of `classify_clusters` in their order, with all values and limits, as an explanation.
    All checks are returned for all clusters, also those that come after a failed one; the verdicts of the
    clusters are not read. Radius and arc are NaN for clusters without a circle; `cut` counts as 0 unless the
    parameter `whole` is set."""
    p, c = parameters, clusters
    has_circle = np.isfinite(c.radius)
    radius = np.where(has_circle, c.radius, np.nan)
    arc = np.degrees(np.where(has_circle, c.arc, np.nan))
    cut, whole = c.cut & p.whole, "detection.whole" if p.whole else ""
    width, up = np.maximum(c.extent[:, 0], c.extent[:, 1]), c.extent[:, 2]
    e, spread, flat = c.eccentricity, c.radial_std, p.cylindrical_stddev_thresh
    return (
        Check(Verdict.HIDDEN, "edge hidden", "", c.hidden.astype(np.float64), NO_LIMIT),
        Check(Verdict.TOO_THICK, "width", "m", width, AT_MOST, p.size_max, "detection.size_max"),
        Check(
            Verdict.TOO_LOW, "visible height", "m", up, AT_LEAST, p.height_extent_min,
            "detection.height_extent_min",
        ),
        Check(
            Verdict.AT_BORDER, "cut off at the border", "", cut.astype(np.float64), NO_LIMIT, parameter=whole
        ),
        Check(Verdict.TOO_ROUND, "eccentricity", "", e, AT_LEAST, p.e_min, "detection.e_min"),
        Check(Verdict.TOO_LONG, "eccentricity", "", e, AT_MOST, p.e_max, "detection.e_max"),
        Check(
            Verdict.NOT_ROUND, "radial deviation", "m", spread, AT_MOST, flat,
            "detection.cylindrical_stddev_thresh",
        ),
        Check(Verdict.NO_ARC, "visible arc", "deg", arc, AT_LEAST, p.arc_min, "detection.arc_min"),
        Check(Verdict.TOO_THIN, "radius", "m", radius, AT_LEAST, p.radius_min, "detection.radius_min"),
        Check(Verdict.TOO_THICK, "radius", "m", radius, AT_MOST, p.radius_max, "detection.radius_max"),
    )  # fmt: skip
