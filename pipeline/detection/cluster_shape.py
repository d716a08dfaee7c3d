"""Shape of clusters: moments, eccentricity (Eq. 3-4), extent, and the circle of the trunk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from pipeline.config.stages import Shape
from pipeline.detection.cluster_splitting import split_trunks
from pipeline.detection.cylinder_fit import COLUMNS, fit_stems
from pipeline.geometry.hash_grid import group_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Clusters, Float32, Int, Labels, Sensor, Verdict


@compiled
def moments(points: Float, bounds: Int) -> tuple[Float, Float, Float]:
    """Return the moments of each cluster (Eq. 3).

    Args:
        points: Points in the order of the clusters, shape (N, 3) [m], sensor frame.
        bounds: First row of each cluster, and N, shape (K + 1,); no cluster is empty.

    Returns:
        Centroid, shape (K, 3) [m]; descending eigenvalues of the horizontal covariance normalised by N, shape
        (K, 3) [m^2], of which the third is 0; and extent along the horizontal ray from the sensor to the
        centroid, across it and upwards, shape (K, 3) [m].
    """
    clusters = bounds.shape[0] - 1
    centroid = np.zeros((clusters, 3))
    eigenvalues = np.zeros((clusters, 3))
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
        xx, xy, yy = 0.0, 0.0, 0.0
        for i in range(bounds[k], bounds[k + 1]):
            x, y, z = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            xx += x * x
            xy += x * y
            yy += y * y
            along, across = ux * x + uy * y, ux * y - uy * x
            near, far = min(near, along), max(far, along)
            right, left = min(right, across), max(left, across)
            low, high = min(low, z), max(high, z)
        centroid[k, 0], centroid[k, 1], centroid[k, 2] = mx, my, mz
        middle, half = 0.5 * (xx / n + yy / n), 0.5 * (xx / n - yy / n)
        root = np.sqrt(half * half + (xy / n) * (xy / n))
        eigenvalues[k, 0], eigenvalues[k, 1] = max(middle + root, 0.0), max(middle - root, 0.0)
        extent[k, 0], extent[k, 1], extent[k, 2] = far - near, left - right, high - low
    return centroid, eigenvalues, extent


@compiled
def spread_about(points: Float, bounds: Int, centre: Float) -> Float:
    """Return the standard deviation of the horizontal distances of the points of each cluster to a centre,
    shape (K,) [m].

    Args:
        points: Points in the order of the clusters, shape (N, 2 or 3) [m].
        bounds: First row of each cluster, and N, shape (K + 1,); no cluster is empty.
        centre: Centres of the clusters, x, y first, shape (K, 2 or 3) [m].
    """
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


CENTROID_BIAS = 0.18  # m; centroid to trunk centre, measured on radii of 8 to 35 cm at 2 to 10 m
FLAT = 1e-12  # m^2; variance caused by rounding of 32-bit coordinates

# Of the centroids of clusters, shape (K, 3) [m]: returns heights above them, shape (K,) [m].
LiftOf = Callable[[Float], Float]


def no_lift(centroid: Float) -> Float:
    """Return the height 0 above each centroid, shape (K,) [m]."""
    return np.zeros(len(centroid))


def describe_stems(
    points: Float32,
    labels: Labels,
    sensor: Sensor,
    parameters: Shape,
    radius_bounds: tuple[float, float],
    lift_of: LiftOf = no_lift,
) -> tuple[Labels, Clusters]:
    """Describe each cluster, after trunks are separated from vegetation that is clustered with them.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        labels: Cluster of each point, -1 for none; no cluster is empty.
        sensor: Range sigma and azimuth step of the LiDAR.
        parameters: Choice of centre, and number of slices of `split_trunks`.
        radius_bounds: Smallest and largest radius of a trunk [m].
        lift_of: See `describe`.

    Returns:
        Labels in which the vegetation of a separated trunk forms a cluster of its own, numbered after all
        others; and the shape of each cluster, see `describe`. The labels are those passed in if nothing is
        separated, which is always so if `split_slices` is 0 or `centre` is not "circle".
    """
    whole = describe(points, labels, sensor, parameters, lift_of)
    if parameters.split_slices == 0 or parameters.centre != "circle":
        return labels, whole
    parted, changed = split_trunks(points, labels, whole, sensor, parameters.split_slices, radius_bounds)
    if not len(changed):
        return labels, whole
    number = np.full(parted.clusters + 1, -1, np.int32)  # the last entry is for noise, -1
    number[changed] = np.arange(len(changed), dtype=np.int32)
    some = Labels(number[parted.label], len(changed), parted.hidden[changed])
    return parted, _with_rows(whole, describe(points, some, sensor, parameters, lift_of), changed)


def _with_rows(clusters: Clusters, others: Clusters, rows: Int) -> Clusters:
    """Return the clusters with some rows replaced or appended; the arguments are not changed.

    Args:
        clusters: K clusters.
        others: The new rows, one for each of `rows`.
        rows: Ascending row numbers; those from K on are appended and must be K, K + 1, ... without a gap.
    """
    columns = []
    for column in fields(Clusters):
        old, new = getattr(clusters, column.name), getattr(others, column.name)
        joined = np.concatenate([old, new[rows >= len(old)]])
        joined[rows] = new
        columns.append(joined)
    return Clusters(*columns)


def describe(
    points: Float32, labels: Labels, sensor: Sensor, parameters: Shape, lift_of: LiftOf = no_lift
) -> Clusters:
    """Return the shape of each cluster; all verdicts are OTHER, `cut` is False, and `hidden` is the array of
    the labels.

    With the centre "centroid", radius and its sigma are NaN and the arc is 0; the same holds for clusters
    with fewer than five points, whose radial deviation by the circle fit is 0.

    Args:
        points: Points in the level sensor frame, float32, shape (N, 3) [m].
        labels: Cluster of each point, -1 for none; no cluster is empty.
        sensor: Range sigma and azimuth step of the LiDAR scale the fit.
        parameters: `centre`: circle fit or centroid.
        lift_of: Function of the centroids, shape (K, 3) [m], that returns the height above each centroid at
            which the centre of the circle is computed, shape (K,) [m]; not used with the centre "centroid".
    """
    order, bounds = group_rows(labels.label, labels.clusters)
    members = points[order].astype(np.float64)
    centroid, eigenvalues, extent = moments(members, bounds)
    size = np.diff(bounds)
    if parameters.centre == "circle":
        stem = fit_stems(members, bounds, sensor.range_sigma, sensor.azimuth_step, lift_of(centroid))
    else:
        stem = _centroids_as_stems(members, bounds, centroid, sensor.range_sigma)
    # Contiguous, like clusters that are read from a cache: kernels are compiled for one memory layout only.
    radius, radius_sigma, radial_std, arc = np.ascontiguousarray(stem[:, 5:9].T)
    return Clusters(
        size=size,
        centroid=centroid,
        eccentricity=eccentricity(eigenvalues),
        centre=np.ascontiguousarray(stem[:, 0:2]),
        covariance=np.take(stem, [2, 3, 3, 4], axis=1).reshape(-1, 2, 2),
        radius=radius,
        radius_sigma=radius_sigma,
        radial_std=radial_std,
        arc=arc,
        extent=extent,
        hidden=labels.hidden,
        cut=np.zeros(len(size), np.bool_),
        verdict=np.full(len(size), Verdict.OTHER, np.int32),
    )


@compiled
def eccentricity(eigenvalues: Float) -> Float:
    """Return the eccentricity e = lambda1 / lambda2 (Eq. 4) of each cluster, shape (K,).

    It is infinite for points on a line and 1 for coincident points (both up to the rounding error FLAT). The
    paper calls this ratio eccentricity; the geometric eccentricity is sqrt(1 - lambda2 / lambda1).

    Args:
        eigenvalues: Descending eigenvalues, shape (K, 2 or 3) [m^2].
    """
    ratio = np.ones(eigenvalues.shape[0])
    for k in range(eigenvalues.shape[0]):
        first, second = eigenvalues[k, 0], eigenvalues[k, 1]
        if second > FLAT * max(first, 1.0):
            ratio[k] = first / second
        elif first > FLAT:
            ratio[k] = np.inf
    return ratio


def _centroids_as_stems(members: Float, bounds: Int, centroid: Float, range_sigma: float) -> Float:
    """Return stems whose centre is the centroid of the visible arc, as in the paper.

    Args:
        members: Points in the order of the clusters, shape (N, 3) [m], level sensor frame.
        bounds: First row of each cluster, and N, shape (K + 1,); no cluster is empty.
        centroid: Centroids, shape (K, 3) [m].
        range_sigma: Standard deviation of a range [m]; it enters the covariance across the ray only.

    Returns:
        Stems, shape (K, COLUMNS), with the columns of `fit_stems`. The standard deviation of the centre along
        the ray is CENTROID_BIAS, since the centroid lies in front of the axis. Radius, its sigma and the lean
        are NaN, and the arc is 0. The radial deviation is the standard deviation of the horizontal distances
        of the points to the centroid [m].
    """
    stem = np.full((len(centroid), COLUMNS), np.nan)
    stem[:, 0:2] = centroid[:, :2]
    x, y = centroid[:, 0], centroid[:, 1]
    bearing = np.arctan2(y, x)
    ux, uy = np.cos(bearing), np.sin(bearing)
    # The centroid is in front of the centre by more than half of the unknown radius. Along the ray, this is
    # an error of that size that is equal in all scans from one side and does not average out.
    along = CENTROID_BIAS**2
    across = range_sigma**2 / np.maximum(np.diff(bounds), 1) + 0.02**2
    stem[:, 2] = along * ux * ux + across * uy * uy
    stem[:, 3] = (along - across) * ux * uy
    stem[:, 4] = along * uy * uy + across * ux * ux
    stem[:, 7] = spread_about(members, bounds, centroid)
    stem[:, 8] = 0.0
    return stem
