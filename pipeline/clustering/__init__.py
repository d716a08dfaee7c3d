"""Clustering: which points belong together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.clustering.engines import ENGINES
from pipeline.clustering.range_jump import range_jump
from pipeline.parameters.stages import Clustering
from pipeline.records import Bool, Float32, Int32, Sensor


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Which cluster each point belongs to.

    Attributes:
        label: int32, shape (N,): 0..clusters-1 in the order of their first point, -1 for noise.
        clusters: Number of clusters.
        hidden: shape (clusters,): whether something nearer hides an edge of the cluster; told by
            `range_jump` only, else False.
    """

    label: Int32
    clusters: int
    hidden: Bool


def cluster(points: Float32, sensor: Sensor, parameters: Clustering) -> Labels:
    """Cluster points of shape (N, 3) [m], level sensor frame."""
    if parameters.method == "range_jump":
        label, hidden = range_jump(points, parameters.eps, parameters.min_points, sensor.azimuth_step)
        return Labels(label, len(hidden), hidden)
    plane = np.ascontiguousarray(points[:, : parameters.dimensions])
    label = ENGINES[parameters.engine](plane, parameters.eps, parameters.min_points).label
    clusters = int(label.max(initial=-1)) + 1
    return Labels(label, clusters, np.zeros(clusters, np.bool_))


__all__ = ["ENGINES", "Labels", "cluster"]
