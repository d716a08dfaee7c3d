"""Shape: covariance and eccentricity of each cluster (Eq. 3-4), and the circle of its trunk."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from pipeline.config.stages import Shape
from pipeline.detection.stem_fit.cluster_splitting import take_apart
from pipeline.detection.stem_fit.cylinder_fit import COLUMNS, fit_stems
from pipeline.detection.stem_fit.moments import gather, moments, planar_eigenvalues, spread_about, take_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Clusters, Float32, Int, Labels, Sensor, Verdict

CENTROID_BIAS = 0.18  # m; measured on trunks of 8 to 35 cm radius at 2 to 10 m
FLAT = 1e-12  # m^2; rounding of 32-bit coordinates leaves such a variance to what has none


def describe_stems(
    points: Float32, labels: Labels, sensor: Sensor, parameters: Shape
) -> tuple[Labels, Clusters]:
    """The figures of each cluster, as `describe`, after a trunk was taken out of those in which something
    else is joined to it; and the labels, in which that is a cluster of its own."""
    whole = describe(points, labels, sensor, parameters)
    if parameters.split_slices == 0 or parameters.centre != "circle":
        return labels, whole
    parted, changed = take_apart(points, labels, whole, sensor, parameters.split_slices)
    if not len(changed):
        return labels, whole
    number = np.full(parted.clusters + 1, -1, np.int32)  # the last entry serves noise, -1
    number[changed] = np.arange(len(changed), dtype=np.int32)
    some = Labels(number[parted.label], len(changed), parted.hidden[changed])
    return parted, _with_rows(whole, describe(points, some, sensor, parameters), changed)


def _with_rows(clusters: Clusters, others: Clusters, rows: Int) -> Clusters:
    """The clusters, in these ascending rows the others; rows beyond the last are added."""
    columns = []
    for column in fields(Clusters):
        old, new = getattr(clusters, column.name), getattr(others, column.name)
        joined = np.concatenate([old, new[rows >= len(old)]])
        joined[rows] = new
        columns.append(joined)
    return Clusters(*columns)


def describe(points: Float32, labels: Labels, sensor: Sensor, parameters: Shape) -> Clusters:
    """The figures of each cluster; the verdict is left open (OTHER).

    Args:
        points: float32, shape (N, 3) [m], level sensor frame.
        labels: The cluster of each point.
        sensor: Its range sigma and azimuth step scale the fit.
        parameters: Of this stage.
    """
    order, bounds = gather(labels.label, labels.clusters)
    members = take_rows(points, order)
    centroid, covariance, extent = moments(members, bounds)
    eigenvalues = _eigenvalues(covariance, parameters.plane)
    size = np.diff(bounds)
    if parameters.centre == "circle":
        stem = fit_stems(members, bounds, sensor.range_sigma, sensor.azimuth_step)
    else:
        stem = _centroids_as_stems(members, bounds, centroid, sensor.range_sigma)
    return Clusters(
        size=size,
        centroid=centroid,
        eigenvalues=eigenvalues,
        eccentricity=eccentricity(eigenvalues),
        centre=stem[:, 0:2],
        covariance=stem[:, [2, 3, 3, 4]].reshape(-1, 2, 2),
        radius=stem[:, 5],
        radius_sigma=stem[:, 6],
        radial_std=stem[:, 7],
        arc=stem[:, 8],
        extent=extent,
        hidden=labels.hidden,
        cut=np.zeros(len(size), np.bool_),
        verdict=np.full(len(size), Verdict.OTHER, np.int32),
    )


@compiled
def eccentricity(eigenvalues: Float) -> Float:
    """e = lambda1 / lambda2 (Eq. 4) of descending eigenvalues, shape (K, 2 or 3) [m^2].

    It is inf for points on a line and 1 for points in one place.

    This is the paper's word. The eccentricity of geometry, sqrt(1 - lambda2 / lambda1), is another.
    """
    ratio = np.ones(eigenvalues.shape[0])
    for k in range(eigenvalues.shape[0]):
        first, second = eigenvalues[k, 0], eigenvalues[k, 1]
        if second > FLAT * max(first, 1.0):
            ratio[k] = first / second
        elif first > FLAT:
            ratio[k] = np.inf
    return ratio


def _eigenvalues(covariance: Float, dimensions: int) -> Float:
    """Descending eigenvalues of shape (K, 3); the third is 0 when only x and y are taken."""
    if dimensions == 2:
        return planar_eigenvalues(covariance)
    values: Float = np.maximum(np.linalg.eigvalsh(covariance)[:, ::-1], 0.0)
    return values


def _centroids_as_stems(members: Float, bounds: Int, centroid: Float, range_sigma: float) -> Float:
    """The paper's choice: the centroid of the visible arc stands for the trunk's centre."""
    stem = np.full((len(centroid), COLUMNS), np.nan)
    stem[:, 0:2] = centroid[:, :2]
    x, y = centroid[:, 0], centroid[:, 1]
    bearing = np.arctan2(y, x)
    ux, uy = np.cos(bearing), np.sin(bearing)
    # It lies before the centre by more than half of a radius that nobody knows: along the ray this is
    # an error of that size, the same in each scan from one side, and not a noise that averages out.
    along = CENTROID_BIAS**2
    across = range_sigma**2 / np.maximum(np.diff(bounds), 1) + 0.02**2
    stem[:, 2] = along * ux * ux + across * uy * uy
    stem[:, 3] = (along - across) * ux * uy
    stem[:, 4] = along * uy * uy + across * ux * ux
    stem[:, 7] = spread_about(members, bounds, centroid)
    stem[:, 8] = 0.0
    return stem
