"""First and second moments of clusters (Eq. 3), and their size as seen from the sensor."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int, Int32


@compiled
def gather(label: Int32, clusters: int) -> tuple[Int, Int]:
    """The rows of each cluster side by side.

    Returns:
        order, shape (points in clusters,): rows, cluster after cluster, each in the points' order;
        bounds, shape (clusters + 1,): where each cluster begins in `order`.
    """
    bounds = np.zeros(clusters + 1, np.int64)
    for k in label:
        if k >= 0:
            bounds[k + 1] += 1
    bounds = np.cumsum(bounds)
    place = bounds[:-1].copy()
    order = np.empty(bounds[clusters], np.int64)
    for i in range(label.shape[0]):
        if label[i] >= 0:
            order[place[label[i]]] = i
            place[label[i]] += 1
    return order, bounds


@compiled
def moments(points: Float, bounds: Int) -> tuple[Float, Float, Float]:
    """Centroid (K, 3) [m], covariance (K, 3, 3) [m^2] with 1/N, and extent (K, 3) [m].

    The extent is measured along the ray from the sensor to the centroid, across it and upwards.
    """
    clusters = bounds.shape[0] - 1
    centroid = np.zeros((clusters, 3))
    covariance = np.zeros((clusters, 3, 3))
    extent = np.zeros((clusters, 3))
    for k in range(clusters):
        n = bounds[k + 1] - bounds[k]
        for i in range(bounds[k], bounds[k + 1]):
            for a in range(3):
                centroid[k, a] += points[i, a] / n
        rho = max(np.hypot(centroid[k, 0], centroid[k, 1]), 1e-9)
        ux, uy = centroid[k, 0] / rho, centroid[k, 1] / rho
        low = np.full(3, np.inf)
        high = np.full(3, -np.inf)
        d = np.empty(3)
        for i in range(bounds[k], bounds[k + 1]):
            for a in range(3):
                d[a] = points[i, a] - centroid[k, a]
            for a in range(3):
                for b in range(3):
                    covariance[k, a, b] += d[a] * d[b] / n
            along, across = ux * d[0] + uy * d[1], ux * d[1] - uy * d[0]
            low[0], high[0] = min(low[0], along), max(high[0], along)
            low[1], high[1] = min(low[1], across), max(high[1], across)
            low[2], high[2] = min(low[2], d[2]), max(high[2], d[2])
        extent[k] = high - low
    return centroid, covariance, extent


@compiled
def spread_about(points: Float, bounds: Int, centre: Float) -> Float:
    """Standard deviation of the points' horizontal distances to the centre, shape (K,) [m]."""
    clusters = bounds.shape[0] - 1
    spread = np.zeros(clusters)
    for k in range(clusters):
        n = bounds[k + 1] - bounds[k]
        total, squares = 0.0, 0.0
        for i in range(bounds[k], bounds[k + 1]):
            d = np.hypot(points[i, 0] - centre[k, 0], points[i, 1] - centre[k, 1])
            total += d
            squares += d * d
        mean = total / n
        spread[k] = np.sqrt(max(squares / n - mean * mean, 0.0))
    return spread
