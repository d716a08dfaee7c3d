"""Arrays of planar poses and covariances, one per row, and the correction of a path of poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Float, wrap_angle
from pipeline.jit import compiled

Int = NDArray[np.int64]


def composed(a: Float, b: Float) -> Float:
    """Return T_a_c = T_a_b T_b_c for each row, shape (N, 3), with wrapped yaw.

    Args:
        a: T_a_b as x, y [m], yaw [rad], shape (N, 3).
        b: T_b_c, shape (N, 3).
    """
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [
            a[:, 0] + c * b[:, 0] - s * b[:, 1],
            a[:, 1] + s * b[:, 0] + c * b[:, 1],
            wrap_angle(a[:, 2] + b[:, 2]),
        ]
    )


def inverse(a: Float) -> Float:
    """Return T_b_a for each row of T_a_b, x, y [m], yaw [rad], shape (N, 3)."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack([-c * a[:, 0] - s * a[:, 1], s * a[:, 0] - c * a[:, 1], wrap_angle(-a[:, 2])])


def interpolated(keyframes: Float, motions: Float, scans: Int, keyframe: Int, since: Float) -> Float:
    """Return the pose of each scan between corrected keyframes, x, y [m], yaw [rad], shape (N, 3).

    Each pose is its keyframe composed with the odometry since then. The remaining difference to the next
    keyframe is distributed linearly over the scans between the two; before the first keyframe and after the
    last one nothing is distributed.

    Args:
        keyframes: Corrected poses, shape (K, 3).
        motions: Motion by odometry from keyframe k - 1 to k, shape (K, 3); NaN if there is no odometry, then
            nothing is distributed.
        scans: Scan of each keyframe, int64, shape (K,), ascending.
        keyframe: Row of the last keyframe before or at each scan, int64, shape (N,); 0 before the first one.
        since: Motion by odometry from this keyframe to the scan, shape (N, 3).
    """
    lacking = np.zeros_like(keyframes)
    if len(keyframes) > 1:
        between = composed(inverse(keyframes[:-1]), keyframes[1:])
        lacking[:-1] = composed(inverse(motions[1:]), between)
    lacking[np.isnan(lacking).any(axis=1)] = 0.0
    after = np.maximum(np.arange(len(keyframe)) - scans[keyframe], 0)
    part = after / np.diff(scans, append=len(keyframe))[keyframe]
    return composed(composed(keyframes[keyframe], since), part[:, None] * lacking[keyframe])


def rotated_rows(covariance: Float, turn: Float) -> Float:
    """Return covariances xx, xy, yy, shape (N, 3), rotated by angles [rad], shape (N,)."""
    c, s = np.cos(turn), np.sin(turn)
    xx, xy, yy = covariance.T
    return np.column_stack(
        [
            c * c * xx - 2.0 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2.0 * c * s * xy + c * c * yy,
        ]
    )


SPACING = 1.0  # m of path between two poses that move objects; the correction changes little in between
NEAR = 20.0  # m of path before and after the scan of an object; other passes have other corrections


@dataclass(frozen=True, slots=True, eq=False)
class PathCorrection:
    """The path before and after a correction.

    Attributes:
        before, after: Pose x, y [m], yaw [rad] of every scan in the map, shape (N, 3).
    """

    before: Float
    after: Float

    def largest(self, reach: float) -> float:
        """Return an upper bound [m] of the displacement of objects up to `reach` [m] from the pose with
        which they move: the maximum over the scans of displacement + `reach` |rotation|; 0 if there are no
        scans."""
        step = self.after - self.before
        arc = reach * np.abs(wrap_angle(step[:, 2]))
        return float((np.hypot(*step[:, :2].T) + arc).max(initial=0.0))

    def followed_by(self, later: PathCorrection) -> PathCorrection:
        """Return this correction and a later one as one correction. The path of `later`, shape (M, 3) with M
        >= N, begins with the scans of this correction."""
        return PathCorrection(np.concatenate([self.before, later.before[len(self.before) :]]), later.after)

    def moved(self, place: Float, scan: Int) -> tuple[Float, Float]:
        """Return the corrected positions of objects, shape (N, 2) [m], and their rotations, shape (N,) [rad].

        Each object moves rigidly with one pose of the path `before`: the nearest to the object of the poses
        within NEAR along the path of the scan that observed it, of which one per SPACING is considered. If
        the path has no scans, positions are copied and rotations are 0. The arguments are unchanged.

        Args:
            place: Positions x, y in the map before the correction, shape (N, 2) [m].
            scan: Number of the scan that observed each object, int64, shape (N,). Numbers beyond the path
                mean the last scan.
        """
        if not len(self.before):
            return place.copy(), np.zeros(len(place))
        step = np.hypot(*np.diff(self.before[:, :2], axis=0, prepend=self.before[:1, :2]).T)
        distance = np.cumsum(step)
        _, anchors = np.unique((distance / SPACING).astype(np.int64), return_index=True)
        at = distance[np.minimum(scan, len(distance) - 1)]
        row = anchors[_nearest_poses(place, at, self.before[anchors], distance[anchors])]
        before, after = self.before[row], self.after[row]
        turn = wrap_angle(after[:, 2] - before[:, 2])
        return after[:, :2] + _rotated(place - before[:, :2], turn), turn

    def poses(self, pose: Float, scan: Int) -> Float:
        """Return poses x, y [m], yaw [rad] in the map, shape (N, 3), moved rigidly with the poses of the
        scans with the numbers `scan`, int64, shape (N,). Yaws are wrapped.

        Raises:
            IndexError: A scan is not in the path.
        """
        before, after = self.before[scan], self.after[scan]
        turn = after[:, 2] - before[:, 2]
        position = after[:, :2] + _rotated((pose - before)[:, :2], turn)
        return np.column_stack([position, wrap_angle(pose[:, 2] + turn)])


@compiled
def _nearest_poses(place: Float, at: Float, pose: Float, distance: Float) -> Int:
    """Return the row of the pose nearest to each object, int64, shape (N,), the first of equal ones, among
    those within NEAR of the object along the path.

    Args:
        place: Positions, shape (N, 2) [m].
        at: Distance along the path of each object, shape (N,) [m]; a pose is within NEAR of it.
        pose: Poses, x, y first, shape (A, 3) [m].
        distance: Distance along the path of each pose, ascending, shape (A,) [m].
    """
    nearest = np.empty(place.shape[0], np.int64)
    for k in range(place.shape[0]):
        a, least = int(np.searchsorted(distance, at[k] - NEAR)), np.inf
        nearest[k] = a
        while a < distance.shape[0] and distance[a] <= at[k] + NEAR:
            dx, dy = pose[a, 0] - place[k, 0], pose[a, 1] - place[k, 1]
            if dx * dx + dy * dy < least:
                nearest[k], least = a, dx * dx + dy * dy
            a += 1
    return nearest


def _rotated(v: Float, angle: Float) -> Float:
    """Return vectors, shape (N, 2), rotated by angles [rad], shape (N,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]])
