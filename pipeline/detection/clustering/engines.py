"""DBSCAN (Ester et al. 1996) by three engines that agree on cores, noise and core clusters.

A border point in reach of two clusters goes to either of them, depending on the order of points, in
scikit-learn and Open3D; ours gives it to its nearest core.

Each takes a weight per point, a whole number: for how many neighbours it counts.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from pipeline.detection.clustering.grid import dbscan_grid
from pipeline.types.records import Bool, Float32, Int32


class Dbscan(NamedTuple):
    """Labels (int32, shape (N,), -1 for noise) and which points are cores (None: not told)."""

    label: Int32
    core: Bool | None


class Engine(Protocol):
    """Clusters points (N, 2 or 3) [m]; the weights are int32, shape (N,), None for 1 each."""

    def __call__(
        self, points: Float32, eps: float, min_points: int, weight: Int32 | None = None
    ) -> Dbscan: ...


def _grid(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Dbscan:
    return Dbscan(*dbscan_grid(points.astype(np.float64), eps, min_points, weight))


def _sklearn(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Dbscan:
    from sklearn.cluster import DBSCAN

    if len(points) == 0:
        return Dbscan(np.zeros(0, np.int32), np.zeros(0, np.bool_))
    fitted = DBSCAN(eps=eps, min_samples=min_points).fit(points.astype(np.float64), sample_weight=weight)
    core = np.zeros(len(points), np.bool_)
    core[fitted.core_sample_indices_] = True
    return Dbscan(in_order_of_first_point(fitted.labels_.astype(np.int32)), core)


def _open3d(points: Float32, eps: float, min_points: int, weight: Int32 | None = None) -> Dbscan:
    import open3d

    if len(points) == 0:
        return Dbscan(np.zeros(0, np.int32), None)
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points
    # It knows no weights, but a point that is there twice counts twice.
    times = np.ones(len(points), np.int32) if weight is None else weight
    space, first = np.repeat(space, times, axis=0), np.cumsum(times) - times
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(space))
    # Its neighbours are nearer than the radius, those of the others at most as far away.
    radius = float(np.nextafter(eps, np.inf))
    label = np.asarray(cloud.cluster_dbscan(radius, min_points), np.int32)[first]
    return Dbscan(in_order_of_first_point(label), None)


ENGINES: dict[str, Engine] = {
    "grid": _grid,
    "sklearn": _sklearn,
    "open3d": _open3d,
}


def in_order_of_first_point(label: Int32) -> Int32:
    """The same partition with clusters numbered in the order of their first point."""
    found, first = np.unique(label, return_index=True)
    number = np.full(int(label.max(initial=-1)) + 2, -1, np.int32)  # the last entry serves noise, -1
    by_first = found[np.argsort(first)]
    by_first = by_first[by_first >= 0]
    number[by_first] = np.arange(len(by_first), dtype=np.int32)
    ordered: Int32 = number[label]
    return ordered
