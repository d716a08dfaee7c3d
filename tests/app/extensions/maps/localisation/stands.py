"""Stands of stems, and the local map of a drive through them, without a mapper."""

from __future__ import annotations

import numpy as np

from app.extensions.maps.localisation import Localiser, StoredMap
from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Trees


def stand(seed: int, side: float = 100.0, density: float = 0.04) -> Float:
    """Positions of stems at least a metre apart, shape (N, 2) [m]."""
    place: list[Float] = []
    for at in np.random.default_rng(seed).uniform(0.0, side, (int(density * side**2), 2)):
        if all(np.hypot(*(at - other)) > 1.0 for other in place):
            place.append(at)
    return np.array(place)


def planted(seed: int, side: float = 100.0) -> Float:
    """A plantation: rows 3 m apart, a stem each 2 m, some of them felled."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(0.0, side, 3.0), np.arange(0.0, side, 2.0)), axis=-1).reshape(-1, 2)
    return (grid + rng.normal(0.0, 0.15, grid.shape))[rng.random(len(grid)) < 0.85]


def trees_at(position: Float, seen_ns: int | np.ndarray = 0) -> Trees:
    """Confirmed trees of unknown diameter with a standard deviation of 5 cm."""
    n = len(position)
    unknown, none = np.full(n, np.nan), np.zeros(n)
    covariance = np.tile(0.05**2 * np.eye(2), (n, 1, 1))
    stamp = np.broadcast_to(np.asarray(seen_ns, np.int64), n).copy()
    return Trees(
        np.arange(1, n + 1), position, covariance, unknown, unknown, none, np.full(n, 5), none, stamp, stamp,
        np.ones(n, np.bool_),
    )  # fmt: skip


def stored(position: Float, terrain: Float | None = None) -> StoredMap:
    """A map of stems."""
    return StoredMap.of(trees_at(position), terrain)


def way(seed: int, side: float, length: float = 60.0) -> list[Pose2]:
    """Poses each 2 m along a straight way inside of a stand."""
    rng = np.random.default_rng([seed, 7])
    yaw = float(rng.uniform(-np.pi, np.pi))
    start = 0.5 * side - 0.5 * length * np.array([np.cos(yaw), np.sin(yaw)]) + rng.uniform(-8.0, 8.0, 2)
    return [
        Pose2(float(start[0] + d * np.cos(yaw)), float(start[1] + d * np.sin(yaw)), yaw)
        for d in np.arange(0.0, length, 2.0)
    ]


def drive(localiser: Localiser, place: Float, poses: list[Pose2], seed: int, reach: float = 14.0):
    """Drive along poses, and yield each true T_map_odom with the localisation. The stems are seen within
    `reach` with 4 cm noise; odom is the first pose, turned and shifted."""
    rng = np.random.default_rng([seed, 8])
    T_map_odom = poses[0] @ Pose2(3.0, -2.0, 1.0)
    local = T_map_odom.inverse().apply(place) + rng.normal(0.0, 0.04, place.shape)
    seen_ns = np.full(len(place), -1, np.int64)
    for k, pose in enumerate(poses):
        stamp_ns = (k + 1) * 2_000_000_000
        seen_ns[np.hypot(*(place - [pose.x, pose.y]).T) <= reach] = stamp_ns
        rows = np.flatnonzero(seen_ns >= 0)
        got = localiser.update(stamp_ns, T_map_odom.inverse() @ pose, trees_at(local[rows], seen_ns[rows]))
        yield T_map_odom, got
