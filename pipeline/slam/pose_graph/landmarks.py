"""The landmarks of the pose graph as columns, and what was seen of those that are not yet in it."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Int, Int32


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Columns of length L.

    A landmark enters the graph when it has hits enough to weigh; until then it is held by its anchor, the
    keyframe that saw it first, so that what was seen once never bends the path.

    Attributes:
        node: int64, row among the landmarks of the graph, -1 while it is in none.
        anchor: int64, keyframe; local: shape (L, 2), place in its frame [m]; of those in no graph.
        mean: shape (L, 2) [m]; covariance: shape (L, 2, 2) [m^2], given the path, in the frame of the map.
        hits: int32; score: hits less misses, the existence; birth: int64, serial number of the detection.
        seen_at: Distance driven until it was seen last [m]; begun: int64, the keyframe that saw it first.
    """

    node: Int
    anchor: Int
    local: Float
    mean: Float
    covariance: Float
    hits: Int32
    score: Float
    birth: Int
    seen_at: Float
    begun: Int

    def take(self, rows: Int | Bool) -> Landmarks:
        """Some of them, copied."""
        return Landmarks(*(getattr(self, f.name)[rows] for f in fields(self)))

    def with_more(self, more: Landmarks) -> Landmarks:
        """These and then others."""
        return Landmarks(
            *(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self))
        )


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What was seen of landmarks in no graph yet; columns of length S.

    Attributes:
        birth: int64, of the landmark; keyframe: int64.
        centre: shape (S, 2) [m], base frame; covariance: shape (S, 2, 2) [m^2].
    """

    birth: Int
    keyframe: Int
    centre: Float
    covariance: Float

    def take(self, rows: Int | Bool) -> Sightings:
        """Some of them, copied."""
        return Sightings(*(getattr(self, f.name)[rows] for f in fields(self)))

    def with_more(self, more: Sightings) -> Sightings:
        """These and then others."""
        return Sightings(
            *(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self))
        )


def no_sightings() -> Sightings:
    """Columns of no length."""
    whole = np.zeros(0, np.int64)
    return Sightings(whole, whole, np.zeros((0, 2)), np.zeros((0, 2, 2)))


def turned(covariance: Float, yaw: Float | float) -> Float:
    """C covariance C^T with the rotation C by yaw, shape (N, 2, 2)."""
    c, s = np.cos(yaw) + np.zeros(len(covariance)), np.sin(yaw) + np.zeros(len(covariance))
    C = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    product: Float = C @ covariance @ C.transpose(0, 2, 1)
    return product


def sharpened(mean: Float, covariance: Float, z: Float, R: Float, looks: float) -> tuple[Float, Float]:
    """Kalman update of resting places by measured ones, shapes (N, 2), (N, 2, 2), given the pose: see
    `landmarks.kalman_update`."""
    K = covariance @ np.linalg.inv(covariance + R)
    updated: Float = K @ R
    updated = 0.5 * (updated + updated.transpose(0, 2, 1))
    for axis in range(2):
        updated[:, axis, axis] = np.maximum(updated[:, axis, axis], R[:, axis, axis] / looks)
    return mean + np.einsum("nij,nj->ni", K, z - mean), updated
