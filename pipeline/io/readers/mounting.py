"""Tilt and height of a LiDAR whose mounting is not recorded, by the ground in its first scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.types.records import Scan

#: Points farther than this are not used [m]: the ground is rarely even beyond.
_NEAR = 10.0
#: Lowest and highest position of a LiDAR above the ground [m].
_LOW, _HIGH = 0.2, 4.0
#: Points up to this from the plane are ground: grass and waves [m].
_EVEN = 0.15
#: Largest share of points below the ground: ghost echoes, and a ditch.
_BELOW = 0.05
#: Least share of points on the ground.
_ENOUGH = 0.2
#: Ground near the robot that is tilted up to _LEVEL against an upright LiDAR is usual; a LiDAR that is tilted
#: by less than _TILTED may be upright at the foot of a slope [rad].
_LEVEL, _TILTED = np.radians(10.0), np.radians(15.0)
_POINTS, _PLANES = 1000, 2000


def mounting_by_ground(scan: Scan) -> Pose3 | None:
    """Return T_base_lidar of a tilted LiDAR; the base is on the ground below it, with the x axis of the LiDAR
    projected onto the ground. None for an upright LiDAR, or if the ground is not clear.

    The ground is the plane with the most points which has hardly any below it. A wall is such a plane too:
    the LiDAR is upright if a plane on which it would be upright has half as many points or more.
    """
    points = scan.points.astype(np.float64)
    points = points[np.linalg.norm(points, axis=1) < _NEAR]
    if len(points) < _POINTS // 10:
        return None
    rng = np.random.default_rng(0)
    points = points[rng.permutation(len(points))[:_POINTS]]
    a, b, c = points[rng.integers(len(points), size=(3, _PLANES))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    valid = length > 1e-3  # m^2; three points on a line have no normal
    if not valid.any():
        return None
    normal, a = normal[valid] / length[valid, None], a[valid]
    height = -np.einsum("ij,ij->i", normal, a)
    normal, height = normal * np.sign(height)[:, None], np.abs(height)
    above = points @ normal.T + height
    share = np.mean(np.abs(above) < _EVEN, axis=0)
    allowed = (np.mean(above < -_EVEN, axis=0) < _BELOW) & (height > _LOW) & (height < _HIGH)
    share = np.where(allowed & (share > _ENOUGH), share, 0.0)
    level = normal[:, 2] > np.cos(_LEVEL)
    best = int(np.argmax(share))
    if share[best] <= 2.0 * share[level].max(initial=0.0) or normal[best, 2] > np.cos(_TILTED):
        return None
    return _standing(points[np.abs(above[:, best]) < _EVEN], normal[best])


def _standing(ground: Float, normal: Float) -> Pose3:
    """Return T_base_lidar above the plane through ground points.

    Args:
        ground: Points on the ground in the sensor frame, shape (N, 3) [m].
        normal: Approximate unit normal of the ground, upwards, shape (3,).
    """
    middle = ground.mean(axis=0)
    up = np.linalg.svd(ground - middle, full_matrices=False)[2][2]
    up = up * np.sign(up @ normal)
    # A LiDAR that looks up or down has no x axis along the ground; then its y axis remains to the left.
    if abs(up[0]) < np.cos(np.radians(45.0)):
        left = np.cross(up, [1.0, 0.0, 0.0])
    else:
        left = np.array([0.0, 1.0, 0.0]) - up[1] * up
    left = left / np.linalg.norm(left)
    return Pose3(np.stack([np.cross(left, up), left, up]), np.array([0.0, 0.0, -float(up @ middle)]))
