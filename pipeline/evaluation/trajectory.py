"""Absolute trajectory error (ATE) of the path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Int, Path, TruthPath


@dataclass(frozen=True, slots=True)
class PathError:
    """Distances between the path and the true path at the times of the true path.

    Attributes:
        rms, median, largest: Over all compared positions [m].
        at_end: At the last common time [m].
        compared: Number of true positions within the time of the path.
        aligned: Whether a rigid motion was fitted first.
    """

    rms: float
    median: float
    largest: float
    at_end: float
    compared: int
    aligned: bool


def path_error(path: Path, truth: TruthPath, *, align: bool | None = None) -> PathError | None:
    """Return the error of a path, or None if it has fewer than two poses or fewer than three true positions
    are within its time. The path is interpolated linearly at the times of the true positions.

    Args:
        path: In the frame of the map.
        truth: In the frame of the map or in another one.
        align: Whether to fit a rigid motion in the plane first; None fits it if the frames differ.
    """
    if len(path.stamp_ns) < 2:
        return None
    common = (truth.stamp_ns >= path.stamp_ns[0]) & (truth.stamp_ns <= path.stamp_ns[-1])
    if np.count_nonzero(common) < 3:
        return None
    t = truth.stamp_ns[common]
    ours = np.stack([_at(t, path.stamp_ns, path.x), _at(t, path.stamp_ns, path.y)], axis=1)
    theirs = np.stack([truth.x[common], truth.y[common]], axis=1)
    aligned = not truth.same_frame if align is None else align
    if aligned:
        ours = fit_rigid(ours, theirs).apply(ours)
    distance = np.hypot(*(ours - theirs).T)
    return PathError(
        rms=float(np.sqrt((distance**2).mean())),
        median=float(np.median(distance)),
        largest=float(distance.max()),
        at_end=float(distance[-1]),
        compared=len(distance),
        aligned=aligned,
    )


def fit_rigid(a: Float, b: Float) -> Pose2:
    """Return the pose T_b_a that minimises sum |b - T_b_a a|^2 over N pairs of points (Umeyama 1991, without
    scale), N > 0; the yaw is 0 for coincident points.

    Args:
        a, b: Points in the two frames, shape (N, 2) [m] each.
    """
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    M = (a - mean_a).T @ (b - mean_b)
    yaw = float(np.arctan2(M[0, 1] - M[1, 0], M[0, 0] + M[1, 1]))
    turned = Pose2(0.0, 0.0, yaw).apply(mean_a[None, :])[0]
    return Pose2(float(mean_b[0] - turned[0]), float(mean_b[1] - turned[1]), yaw)


def _at(wanted_ns: Int, stamp_ns: Int, value: Float) -> Float:
    """Return values interpolated linearly at other times, shape (K,); outside of the times the first or last
    value.

    Args:
        wanted_ns: Times [ns], int64, shape (K,).
        stamp_ns: Times of the values, ascending [ns], int64, shape (N,), N > 0.
        value: Values, shape (N,).
    """
    start = stamp_ns[0]  # int64 nanoseconds since the epoch do not fit a float; differences do
    result: Float = np.interp((wanted_ns - start) * 1e-9, (stamp_ns - start) * 1e-9, value)
    return result
