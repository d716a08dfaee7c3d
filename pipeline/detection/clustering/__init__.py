"""Clustering: which points belong together."""

from __future__ import annotations

import numpy as np

from pipeline.config.stages import Clustering
from pipeline.detection.clustering.engines import ENGINES
from pipeline.detection.clustering.range_jump import range_jump
from pipeline.detection.clustering.weights import weigh
from pipeline.types.records import Float32, Labels, Sensor


def cluster(points: Float32, sensor: Sensor, parameters: Clustering) -> Labels:
    """Cluster points of shape (N, 3) [m], level sensor frame."""
    if parameters.method == "range_jump":
        label, hidden = range_jump(points, parameters.eps, parameters.min_points, sensor.azimuth_step)
        return Labels(label, len(hidden), hidden)
    plane = np.ascontiguousarray(points[:, : parameters.dimensions])
    weight = weigh(points, sensor, parameters) if parameters.stem_area > 0.0 else None
    label = ENGINES[parameters.engine](plane, parameters.eps, parameters.min_points, weight).label
    clusters = int(label.max(initial=-1)) + 1
    return Labels(label, clusters, np.zeros(clusters, np.bool_))


__all__ = ["ENGINES", "cluster", "weigh"]
