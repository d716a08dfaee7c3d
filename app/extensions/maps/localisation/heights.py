"""Height and tilt of one map in another, from the terrain that both have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.poses import Float, Pose2, Pose3

REACH = 15.0  # m around the robot; ground farther away is seen at a grazing angle
CELLS_MIN = 40  # cells that both maps have
CELL_SIGMA = 0.05  # m; of the difference of two heights: grass, and the rounding of a stored cell
ROUNDS = 3  # iterations without outliers


@dataclass(frozen=True, slots=True, eq=False)
class HeightFix:
    """Difference of two maps at the robot: height [m], and its gradient along x and y of the map [m/m].

    Attributes:
        z: Height of the ground in the stored map less that in the local one, at the robot [m].
        gradient: Its gradient, shape (2,).
        covariance: Covariance of z and the gradient, shape (3, 3).
        at: Position of the robot in the stored map, shape (2,) [m].
    """

    z: float
    gradient: Float
    covariance: Float
    at: Float

    def pose3(self, T_map_odom: Pose2) -> Pose3:
        """Return the planar pose of the local frame in the map with its height, roll and pitch."""
        gx, gy = T_map_odom.rotation().T @ self.gradient
        origin = np.array([T_map_odom.x, T_map_odom.y])
        z = self.z + float(self.gradient @ (origin - self.at))
        return Pose3.from_euler(
            np.append(origin, z), float(np.arctan(gy)), float(-np.arctan(gx)), T_map_odom.yaw
        )


def align_heights(
    T_map_odom: Pose2, local: Float, tree: cKDTree | None, height: Float, at: Float
) -> HeightFix | None:
    """Return height and tilt of the local frame in the map; None if they have too little ground in common.

    Args:
        T_map_odom: Planar pose of the local frame in the map.
        local: x, y, z of the local terrain, shape (K, 3) [m].
        tree: Positions of the cells of the stored terrain; None without a terrain.
        height: Their heights, shape (M,) [m].
        at: Position of the robot in the map, shape (2,) [m].
    """
    if tree is None or not len(local):
        return None
    place = T_map_odom.apply(local[:, :2])
    near = np.hypot(*(place - at).T) <= REACH
    distance, row = tree.query(place[near], distance_upper_bound=1.0)
    known = np.isfinite(distance)
    if np.count_nonzero(known) < CELLS_MIN:
        return None
    arm = place[near][known] - at
    difference = height[row[known]] - local[near, 2][known]
    design = np.column_stack([np.ones(len(arm)), arm])
    kept = np.ones(len(arm), np.bool_)
    solution, spread = np.zeros(3), CELL_SIGMA
    for _ in range(ROUNDS):
        solution, *_ = np.linalg.lstsq(design[kept], difference[kept], rcond=None)
        residual = difference - design @ solution
        spread = max(1.4826 * float(np.median(np.abs(residual[kept]))), CELL_SIGMA)
        kept = np.abs(residual) <= 3.0 * spread
        if np.count_nonzero(kept) < CELLS_MIN:
            return None
    information = design[kept].T @ design[kept] / spread**2
    if np.linalg.cond(information) > 1e9:
        return None
    return HeightFix(float(solution[0]), solution[1:], np.linalg.inv(information), at)
