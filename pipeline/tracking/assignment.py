"""Which detection is which tree, and which trees were missed."""

from __future__ import annotations

import numpy as np

from pipeline.detection.free_space import is_in_free_view
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.association import associate
from pipeline.tracking.kalman import expected_positions
from pipeline.tracking.miss_suppression import beyond_doubt
from pipeline.tracking.track_table import Rows
from pipeline.tracking.tracking_inputs import Found, Limits, Sight
from pipeline.types.records import Bool, Int


@compiled
def assign(
    rows: Rows, count: int, sight: Sight, found: Found, limits: Limits
) -> tuple[Int, Bool, Float, Float, Float]:
    """The tree of each detection; trees in free view without one lose `miss` of their score, in place, but
    for those that the robot may look for at a wrong place.

    Args:
        rows: Of which the first `count` are trees.

    Returns:
        Row of the tree, -1 for none, shape (D,); which trees have a detection, shape (T,); the
        detections in the frame of the map, shape (D, 2), and their covariances, shape (D, 2, 2): their own,
        and what the pose adds.
    """
    pose, x, P = sight.pose, rows.x[:count], rows.P[:count]
    position, R, B, packed = in_map(found.centre, found.covariance, pose, sight.covariance, sight.relative)
    expected, spread = expected_positions(
        x, P, rows.shared, rows.hits, rows.stamp_ns, sight.stamp_ns, limits.acceleration_sigma
    )
    row_of, _ = associate(position, packed, expected, spread, limits.gate, limits.distance_max)
    touched = np.zeros(count, np.bool_)
    for d in range(row_of.shape[0]):
        if row_of[d] >= 0:
            touched[row_of[d]] = True
    spared = beyond_doubt(x, P, pose, sight.covariance, limits.distance_max, sight.view_range)
    _miss(x, rows.score, touched, spared, pose, sight.clear_range, sight.view_range, limits.miss)
    return row_of, touched, position, R, B


@compiled_borrowing
def _miss(
    x: Float,
    score: Float,
    touched: Bool,
    spared: Bool,
    pose: Float,
    clear_range: Float,
    view_range: float,
    miss: float,
) -> None:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for t in range(x.shape[0]):
        if touched[t] or spared[t]:
            continue
        if is_in_free_view(x[t], pose, c, s, clear_range, view_range):
            score[t] -= miss


@compiled
def in_map(
    centre: Float, covariance: Float, pose: Float, pose_covariance: Float, relative: Float
) -> tuple[Float, Float, Float, Float]:
    """Detections in the frame of the map: centres, shape (D, 2) [m]; their own covariances, turned, shape
    (D, 2, 2); those by the pose, J Sigma J^T with J = d(position) / d(x, y, yaw); and how far they
    may lie from where the trees around have them, xx, xy, yy, shape (D, 3).

    Args:
        centre: Base frame, shape (D, 2) [m]; covariance: shape (D, 2, 2).
        pose: x, y [m], yaw [rad], shape (3,); pose_covariance: shape (3, 3).
    """
    D = centre.shape[0]
    place, packed = np.empty((D, 2)), np.empty((D, 3))
    R, B = np.empty((D, 2, 2)), np.empty((D, 2, 2))
    _put_in_map(centre, covariance, pose, pose_covariance, relative, place, R, B, packed)
    return place, R, B, packed


@compiled_borrowing
def _put_in_map(
    centre: Float,
    covariance: Float,
    pose: Float,
    Sigma: Float,
    relative: Float,
    place: Float,
    R: Float,
    B: Float,
    packed: Float,
) -> None:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for d in range(centre.shape[0]):
        x, y = c * centre[d, 0] - s * centre[d, 1], s * centre[d, 0] + c * centre[d, 1]
        a, b, e = covariance[d, 0, 0], covariance[d, 0, 1], covariance[d, 1, 1]
        xx = c * c * a - 2.0 * c * s * b + s * s * e
        xy = c * s * (a - e) + (c * c - s * s) * b
        yy = s * s * a + 2.0 * c * s * b + c * c * e
        R[d, 0, 0], R[d, 0, 1], R[d, 1, 0], R[d, 1, 1] = xx, xy, xy, yy
        bxx, bxy, byy = by_pose(x, y, Sigma)
        gxx, gxy, gyy = by_pose(x, y, relative)
        place[d, 0], place[d, 1] = pose[0] + x, pose[1] + y
        packed[d, 0], packed[d, 1], packed[d, 2] = xx + gxx, xy + gxy, yy + gyy
        B[d, 0, 0], B[d, 0, 1], B[d, 1, 0], B[d, 1, 1] = bxx, bxy, bxy, byy


@compiled_borrowing
def by_pose(x: float, y: float, Sigma: Float) -> tuple[float, float, float]:
    """J Sigma J^T, xx, xy, yy, of what lies x, y [m] from the robot along the axes of the map."""
    return (
        Sigma[0, 0] - 2.0 * y * Sigma[0, 2] + y * y * Sigma[2, 2],
        Sigma[0, 1] + x * Sigma[0, 2] - y * Sigma[1, 2] - x * y * Sigma[2, 2],
        Sigma[1, 1] + 2.0 * x * Sigma[1, 2] + x * x * Sigma[2, 2],
    )
