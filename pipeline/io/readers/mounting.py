"""Tilt and height of a LiDAR whose mounting is not recorded, by the ground in its first scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.types.records import Scan

#: Points farther than this are not used [m]: the ground is rarely even beyond.
_NEAR = 10.0
#: Lowest and highest position of a LiDAR above the ground [m].
_LOW, _HIGH = 0.2, 4.0
#: Points up to this from the plane are ground: grass and waves [m].
_EVEN = 0.15
#: Part of the height of the LiDAR that they may be away from it: whatever is near a LiDAR just above the
#: ground would be ground otherwise.
_EVEN_SHARE = 1.0 / 3.0
#: Largest share of points below the ground: ghost echoes, and a ditch.
_BELOW = 0.05
#: Least share of points on the ground.
_ENOUGH = 0.2
#: Ground near the robot that is tilted up to _LEVEL against an upright LiDAR is usual; a LiDAR that is tilted
#: by less than _TILTED may be upright at the foot of a slope [rad].
_LEVEL, _TILTED = np.radians(10.0), np.radians(15.0)
#: A LiDAR whose tilt stays within _ALIKE over a drive, and is _KEPT or more, is tilted on its robot [rad].
_KEPT, _ALIKE = np.radians(6.0), np.radians(3.0)
_POINTS, _PLANES = 1000, 2000
#: Samples of a scan that must show the same ground, within _SAME [rad]: in clutter each shows another plane.
_SAMPLES, _SAME = 3, np.radians(6.0)


def mounting_by_ground(scan: Scan, least_tilt: float = _TILTED) -> Pose3 | None:
    """Return T_base_lidar of a tilted LiDAR; the base is on the ground below it, with the x axis of the LiDAR
    projected onto the ground. None for an upright LiDAR, or if the ground is not clear.

    Args:
        scan: The scan.
        least_tilt: A LiDAR that is tilted less is upright [rad].

    The ground is the plane with the most points which has few below it, in each of several samples of
    the points. A wall is such a plane too:
    the LiDAR is upright if a plane on which it would be upright has half as many points or more.
    """
    points = scan.points.astype(np.float64)
    points = points[np.linalg.norm(points, axis=1) < _NEAR]
    if len(points) < _POINTS // 10:
        return None
    rng = np.random.default_rng(0)
    order, each = rng.permutation(len(points)), min(len(points) // _SAMPLES, _POINTS)
    found = list[Pose3]()
    for k in range(_SAMPLES):
        T_base_lidar = _level_of(points[order[k * each : (k + 1) * each]], rng, least_tilt)
        if T_base_lidar is None or any(T_base_lidar.R[2] @ T.R[2] < np.cos(_SAME) for T in found):
            return None
        found.append(T_base_lidar)
    return found[0]


def _level_of(points: Float, rng: np.random.Generator, least_tilt: float) -> Pose3 | None:
    """Return T_base_lidar by some points of a scan, shape (N, 3) [m], see `mounting_by_ground`."""
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
    even = np.minimum(_EVEN, _EVEN_SHARE * height)
    share = np.mean(np.abs(above) < even, axis=0)
    allowed = (np.mean(above < -even, axis=0) < _BELOW) & (height > _LOW) & (height < _HIGH)
    share = np.where(allowed & (share > _ENOUGH), share, 0.0)
    level = normal[:, 2] > np.cos(_LEVEL)
    best = int(np.argmax(share))
    if share[best] <= 2.0 * share[level].max(initial=0.0) or normal[best, 2] > np.cos(least_tilt):
        return None
    return _standing(points[np.abs(above[:, best]) < even[best]], normal[best])


def assumed_mounting(scan: Scan) -> tuple[Pose3, tuple[str, ...]]:
    """Return T_base_lidar for a recording without any mounting, and messages for the user: by the ground
    (`mounting_by_ground`) with a message, else identity without one."""
    found = mounting_by_ground(scan)
    if found is None:
        return Pose3.identity(), ()
    return found, (f"the recording has no mounting: {tilt_text(found)}",)


def tilt_text(T_base_lidar: Pose3) -> str:
    """Return a message about a mounting that was found by the ground."""
    tilt = np.degrees(np.arccos(np.clip(T_base_lidar.R[2, 2], -1.0, 1.0)))
    return (
        f"by the ground in the first scan, the LiDAR is tilted by {tilt:.0f} degrees and "
        f"{T_base_lidar.t[2]:.1f} m high; --mount overrides this"
    )


def mounting_by_grounds(scans: Sequence[Scan]) -> Pose3 | None:
    """Return T_base_lidar by the ground in scans of a drive, as `mounting_by_ground` does for a LiDAR that is
    tilted by _KEPT or more. None unless the ground has the same tilt in all of them, as no slope is."""
    found = [mounting_by_ground(scan, _KEPT) for scan in scans]
    ups = np.array([T.R[2] for T in found if T is not None]).reshape(-1, 3)
    if not len(ups) or len(ups) < len(found):
        return None
    up = ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0))
    return found[len(found) // 2] if float((ups @ up).min()) > np.cos(_ALIKE) else None


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
