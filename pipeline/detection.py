"""Detection: which clusters are trees, and for each other one the reason why it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.geometry import Float
from pipeline.parameters.stages import Detection
from pipeline.records import Bool, Clusters, Detections, Verdict


def judge(clusters: Clusters, parameters: Detection) -> Clusters:
    """The clusters with their verdicts: the first reason that holds, in the order below, else TREE."""
    p, c = parameters, clusters
    across, up = c.extent[:, 1], c.extent[:, 2]
    has_circle = np.isfinite(c.radius)
    reasons: list[tuple[Verdict, Bool]] = [
        (Verdict.HIDDEN, c.hidden),
        (Verdict.TOO_THICK, np.maximum(across, c.extent[:, 0]) > p.size_max),
        (Verdict.TOO_LOW, up < p.height_extent_min),
        (Verdict.TOO_ROUND, c.eccentricity < p.e_min),
        (Verdict.TOO_LONG, c.eccentricity > p.e_max),
        (Verdict.NOT_ROUND, c.radial_std > p.cylindrical_stddev_thresh),
        (Verdict.NO_ARC, has_circle & (c.arc < np.radians(p.arc_min))),
        (Verdict.TOO_THIN, has_circle & (c.radius < p.radius_min)),
        (Verdict.TOO_THICK, has_circle & (c.radius > p.radius_max)),
    ]
    verdict = np.full(len(c.size), Verdict.TREE, np.int32)
    for reason, holds in reversed(reasons):
        verdict[holds] = reason
    return replace(clusters, verdict=verdict)


def detections(clusters: Clusters, sensor_offset: Float, parameters: Detection) -> Detections:
    """The clusters judged to be trees, in the base frame (Eq. 8: p_base = T_base_lidar p_lidar)."""
    rows = np.flatnonzero(clusters.verdict == Verdict.TREE)
    return Detections(
        cluster=rows,
        centre=clusters.centre[rows] + sensor_offset[:2],
        covariance=clusters.covariance[rows] + _sensor_covariance(clusters.centre[rows], parameters),
        radius=clusters.radius[rows],
        radius_sigma=clusters.radius_sigma[rows],
        arc=clusters.arc[rows],
        eccentricity=clusters.eccentricity[rows],
    )


def _sensor_covariance(centre: Float, p: Detection) -> Float:
    """What the fit does not know of: an error along and across the ray, shape (D, 2, 2) [m^2].

    Args:
        centre: shape (D, 2) [m], seen from the sensor.
        p: sigma_range along the ray, sigma_bearing times the distance across it.
    """
    reach = np.maximum(np.hypot(centre[:, 0], centre[:, 1]), 1e-6)
    ux, uy = centre[:, 0] / reach, centre[:, 1] / reach
    along = p.sigma_range**2
    across = (reach * np.radians(p.sigma_bearing)) ** 2
    R = np.empty((len(centre), 2, 2))
    R[:, 0, 0] = along * ux * ux + across * uy * uy
    R[:, 0, 1] = R[:, 1, 0] = (along - across) * ux * uy
    R[:, 1, 1] = along * uy * uy + across * ux * ux
    return R
