"""The stages without a memory: from a scan to detections in the base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

Float = NDArray[np.float64]
Parameters = Mapping[str, Any]  # "stage.name" -> value


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A cluster accepted as a tree: position in the base frame (2,) [m], its covariance (2, 2) [m^2]."""

    place: Float
    covariance: Float
    eccentricity: float


def acquire(points: Float, rotation: Float, p: Parameters) -> Float:
    """Return the points within range, rotated into the axes of the base."""
    distance = np.linalg.norm(points, axis=1)
    kept = (distance >= p["acquisition.range_min"]) & (distance <= p["acquisition.range_max"])
    turned: Float = points[kept] @ rotation.T
    return turned


def pass_through(points: Float, p: Parameters) -> Float:
    """The points in the box."""
    kept = np.ones(len(points), dtype=bool)
    for axis, name in enumerate("xyz"):
        kept &= (points[:, axis] >= p[f"filters.{name}_min"]) & (points[:, axis] <= p[f"filters.{name}_max"])
    return points[kept]


def voxel_grid(points: Float, p: Parameters) -> Float:
    """Return one mean per voxel (Eq. 2)."""
    if len(points) == 0:
        return points
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    return np.asarray(cloud.voxel_down_sample(p["filters.voxel_size"]).points)


def cluster(points: Float, p: Parameters) -> NDArray[np.int32]:
    """DBSCAN labels, -1 for noise."""
    if len(points) == 0:
        return np.zeros(0, np.int32)
    plane = points.copy()
    plane[:, p["clustering.dimensions"] :] = 0.0
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(plane))
    return np.asarray(cloud.cluster_dbscan(p["clustering.eps"], p["clustering.min_points"]))


def detect(
    points: Float, labels: NDArray[np.int32], offset: Float, sigma: float, p: Parameters
) -> list[Detection]:
    """Eccentricity (Eq. 3-4) and the cylinder check of each cluster; those that pass."""
    found = []
    for k in range(labels.max(initial=-1) + 1):
        members = points[labels == k]
        centroid = members.mean(axis=0)
        ascending = np.linalg.eigvalsh(np.cov(members[:, :2].T, bias=True))
        eccentricity = ascending[-1] / ascending[-2] if ascending[-2] > 1e-12 else np.inf
        radial = np.linalg.norm(members[:, :2] - centroid[:2], axis=1)
        ray = centroid[:2] / max(float(np.linalg.norm(centroid[:2])), 1e-9)
        along = (members[:, :2] - centroid[:2]) @ ray
        across = (members[:, :2] - centroid[:2]) @ np.array([-ray[1], ray[0]])
        if max(np.ptp(along), np.ptp(across)) > p["detection.size_max"]:
            continue
        if np.ptp(members[:, 2]) < p["detection.height_extent_min"]:
            continue
        if not p["detection.e_min"] <= eccentricity <= p["detection.e_max"]:
            continue
        if radial.std() > p["detection.cylindrical_stddev_thresh"]:
            continue
        R = _covariance(centroid[:2], len(members), sigma, p)
        found.append(Detection(centroid[:2] + offset[:2], R, float(eccentricity)))
    return found


def _covariance(place: Float, size: int, sigma: float, p: Parameters) -> Float:
    """Return the covariance of a centroid: its noise and variation, and the error of the sensor along and
    across the ray."""
    distance = float(np.linalg.norm(place))
    c, s = place / max(distance, 1e-6)
    along = p["detection.sigma_range"] ** 2
    across = (distance * np.radians(p["detection.sigma_bearing"])) ** 2
    turn = np.array([[c, -s], [s, c]])
    wandering = (sigma**2 / size + 0.02**2) * np.eye(2)
    R: Float = turn @ np.diag([along, across]) @ turn.T + wandering
    return R
