"""Covariance of a registration in the plane, by Gauss-Newton with the measured variance of its residuals.

A registration makes the residuals r = n . (p - mu) along the normals n of the surfaces small. If they are
independent, its covariance is s^2 (sum of J^T J)^-1 with their measured mean square s^2 (Censi, ICRA 2007,
for residuals of point to plane). Those of one surface share the error of its place in the map. So the points
of a cell count as one observation together.

In a direction in which all surfaces slide along themselves (a corridor, an open field) no residual changes.
There the variance is that of the possible motions.

The residuals also show whether the surfaces agree. The registration weights each point, the covariance
weights each cell: if the motion is one, the pose with equally weighted cells differs from the registered pose
by about its sigma. A large surface that moves beside the robot has most points and few cells, so that the
poses differ more.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Int

#: Distance after which the errors of two registrations are independent [m]; a radian counts as a metre.
#: Fitted to the errors of simulated drives over 1, 3 and 10 m (docs/results.md).
RENEWED = 0.5
#: Variance of float32 coordinates of some 10 m [m^2].
ROUNDING = 1e-12


def registration_covariance(
    points: Float, normals: Float, residual: Float, cell: Int, largest: Float
) -> tuple[Float, float]:
    """Return the covariance of a registration, x, y [m], yaw [rad] in the frame of the points, shape (3, 3),
    and the squared Mahalanobis distance of the pose with equally weighted cells from the registered pose:
    chi-square with 3 degrees of freedom if the residuals are those of one motion.

    Args:
        points: Registered points, shape (N, 3) [m].
        normals: Unit normals of their surfaces, shape (N, 3).
        residual: Distances of the points from the map along the normals, shape (N,) [m].
        cell: Number of the cell of each point from 0, shape (N,).
        largest: Sigmas of x, y [m], yaw [rad] without points, above 0, shape (3,).
    """
    size = np.bincount(cell)
    moment = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    J = np.column_stack([normals[:, :2], moment])
    cells = max(int(np.count_nonzero(size)), 1)
    variance = max(float(residual**2 @ (1.0 / size[cell])) / cells, ROUNDING)
    share = 1.0 / (variance * size[cell])
    covariance = np.linalg.inv((share[:, None] * J).T @ J + np.diag(largest**-2.0))
    gradient = J.T @ (share * residual)
    return 0.5 * (covariance + covariance.T), float(gradient @ covariance @ gradient)


def step_covariance(registration: Float, step: Float, largest: Float) -> Float:
    """Return the covariance of the step between two registered scans, x, y [m], yaw [rad] in the frame of the
    points of the first one, shape (3, 3).

    The errors of two registrations are those of the same surfaces in the map, so that they cancel in a short
    step, and are independent after RENEWED. In a direction that no surface determines, the step is the guess
    before the registration: P L^-1 P is the part of the covariance P that comes from it.

    Args:
        registration: Covariance P of the registration of the second scan, in its own frame, shape (3, 3).
        step: The step, shape (4, 4).
        largest: Sigmas L of the guess: x, y [m], yaw [rad], shape (3,).
    """
    yaw = np.arctan2(step[1, 0], step[0, 0])
    way = float(np.hypot(step[0, 3], step[1, 3]) + abs(yaw))
    of_guess = registration @ np.diag(largest**-2.0) @ registration
    c, s = np.cos(yaw), np.sin(yaw)
    turn: Float = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance: Float = turn @ (min(way / RENEWED, 1.0) * registration + of_guess) @ turn.T
    return covariance
