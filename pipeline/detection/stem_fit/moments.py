"""First and second moments of clusters (Eq. 3), and their size as seen from the sensor."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Float32, Int, Int32


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
def take_rows(points: Float32, order: Int) -> Float:
    """The points in that order, in double precision, shape (M, 3)."""
    taken = np.empty((order.shape[0], 3))
    for k in range(order.shape[0]):
        i = order[k]
        taken[k, 0], taken[k, 1], taken[k, 2] = points[i, 0], points[i, 1], points[i, 2]
    return taken


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
        mx, my, mz = 0.0, 0.0, 0.0
        for i in range(bounds[k], bounds[k + 1]):
            mx += points[i, 0]
            my += points[i, 1]
            mz += points[i, 2]
        mx, my, mz = mx / n, my / n, mz / n
        rho = max(np.sqrt(mx * mx + my * my), 1e-9)
        ux, uy = mx / rho, my / rho
        near, far, right, left, low, high = np.inf, -np.inf, np.inf, -np.inf, np.inf, -np.inf
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(bounds[k], bounds[k + 1]):
            x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
            along, across = ux * x + uy * y, ux * y - uy * x
            near, far = min(near, along), max(far, along)
            right, left = min(right, across), max(left, across)
            low, high = min(low, z), max(high, z)
        centroid[k, 0], centroid[k, 1], centroid[k, 2] = mx, my, mz
        C = covariance[k]
        C[0, 0], C[1, 1], C[2, 2] = xx / n, yy / n, zz / n
        C[0, 1] = C[1, 0] = xy / n
        C[0, 2] = C[2, 0] = xz / n
        C[1, 2] = C[2, 1] = yz / n
        extent[k, 0], extent[k, 1], extent[k, 2] = far - near, left - right, high - low
    return centroid, covariance, extent


@compiled
def planar_eigenvalues(covariance: Float) -> Float:
    """Descending eigenvalues of the upper left 2 x 2 of each matrix, shape (K, 3); the third is 0."""
    values = np.zeros((covariance.shape[0], 3))
    for k in range(covariance.shape[0]):
        C = covariance[k]
        middle, half = 0.5 * (C[0, 0] + C[1, 1]), 0.5 * (C[0, 0] - C[1, 1])
        root = np.sqrt(half * half + C[0, 1] * C[0, 1])
        values[k, 0], values[k, 1] = max(middle + root, 0.0), max(middle - root, 0.0)
    return values


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
