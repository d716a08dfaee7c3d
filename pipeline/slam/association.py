"""Data association of positions with landmarks: by likelihood, one to one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.geometry.gaussian import in_map, rows_of
from pipeline.geometry.hash_grid import Cells, cell_of, cells_for, fill, first_of_four, per_metre
from pipeline.geometry.ordering import ascending_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.slam.particle_update import SCORE_MAX
from pipeline.types.records import Detections, Float32, Int, Int32, Landmarks, PoseEstimate


def hits_less_misses(hits: Int32, score: Float32 | Float, misses_per_hit: int) -> Float:
    """Return the hits (at most SCORE_MAX) minus the misses of landmarks, float64, shape (L,), from their
    scores; negative if there are more misses.

    A score is hits - misses / misses_per_hit, and counts no more than SCORE_MAX hits.

    Args:
        hits: Number of detections, int32, shape (L,).
        score: Scores, shape (L,).
        misses_per_hit: Number of misses that cancel one hit.
    """
    counted = np.minimum(hits, SCORE_MAX)
    return np.subtract(counted, misses_per_hit * (counted - score), dtype=np.float64)


def births_of(detections: Detections, estimate: PoseEstimate, landmarks: Landmarks) -> Int:
    """Return the birth of the landmark of each detection at an estimated pose, int64, shape (D,); -1 for a
    detection without landmark within the gate and distance of `landmarks`. The map stays unchanged. The
    covariance of the pose is `relative` of the estimate, if it has one."""
    relative = estimate.covariance if estimate.relative is None else estimate.relative
    pose = estimate.T_map_base.as_array()
    position, own, added = in_map(detections.centre, detections.covariance, pose, relative)
    row, _ = associate(
        position, rows_of(own + added), landmarks.position, landmarks.covariance, landmarks.gate,
        landmarks.distance_max,
    )  # fmt: skip
    births = np.full(len(row), -1, np.int64)
    births[row >= 0] = landmarks.birth[row[row >= 0]]
    return births


class _Pairs(NamedTuple):
    """Candidate pairs of detections and landmarks.

    Attributes:
        squared: Squared Mahalanobis distance of each pair.
        cost: Determinant of the covariance of each pair; -2 log likelihood up to a constant once several
            pairs have the same detection or landmark.
        landmark, detection: Rows of landmark and detection of each pair, int64.
        of_detection: Number of pairs of each detection, int64, shape (D,).
    """

    squared: Float
    cost: Float
    landmark: Int
    detection: Int
    of_detection: Int


@compiled
def associate(
    centre: Float, R: Float, mean: Float, covariance: Float, gate: float, distance_max: float
) -> tuple[Int, Float]:
    """Associate detections with landmarks one to one, pairs with the highest likelihood first. Of equal
    pairs, that of the first landmark, then that of the first detection is taken. Without detections or
    landmarks, no pair exists.

    Args:
        centre: Detections, shape (D, 2) [m].
        R: Covariances xx, xy, yy of the detections, shape (D, 3) [m^2].
        mean: Landmarks in the same frame, shape (M, 2) [m].
        covariance: Covariances xx, xy, yy of the landmarks, shape (M, 3) [m^2].
        gate: Maximum Mahalanobis distance [sigma].
        distance_max: Maximum distance [m].

    Returns:
        Row of the landmark of each detection, -1 for none, int64, shape (D,), and its squared Mahalanobis
        distance, shape (D,), 0 if there is no landmark.
    """
    detections = centre.shape[0]
    landmark_of = np.full(detections, -1, np.int64)
    distance2 = np.zeros(detections)
    cells, scale = cells_for(detections), per_metre(distance_max)
    fill(cells, centre, detections, scale)
    n = _count_pairs(cells, scale, centre, mean, distance_max)
    pairs = _Pairs(
        np.empty(n), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), np.zeros(detections, np.int64)
    )
    n = _add_pairs(pairs, cells, scale, centre, R, mean, covariance, gate, distance_max)
    clear = _is_one_to_one(pairs, n)
    if not clear:
        for k in range(n):
            pairs.cost[k] = pairs.squared[k] + np.log(pairs.cost[k])
    taken = np.zeros(mean.shape[0], np.bool_)
    for k in np.arange(n) if clear else ascending_rows(pairs.cost[:n]):
        d, j = pairs.detection[k], pairs.landmark[k]
        if landmark_of[d] < 0 and not taken[j]:
            landmark_of[d] = j
            distance2[d] = pairs.squared[k]
            taken[j] = True
    return landmark_of, distance2


@compiled_borrowing
def _count_pairs(cells: Cells, scale: float, centre: Float, mean: Float, distance_max: float) -> int:
    """Return the number of pairs of a landmark and a detection within `distance_max` [m].

    Args:
        cells, scale: Grid of the detections for searches within `distance_max`.
        centre: Detections, shape (D, 2) [m].
        mean: Landmarks in the same frame, shape (M, 2) [m].
        distance_max: Maximum distance [m].
    """
    n = 0
    for j in range(mean.shape[0]):
        u, v = first_of_four(mean[j, 0], mean[j, 1], scale)
        for quarter in range(4):
            d = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while d >= 0:
                y0, y1 = centre[d, 0] - mean[j, 0], centre[d, 1] - mean[j, 1]
                n += y0 * y0 + y1 * y1 <= distance_max * distance_max
                d = cells.following[d]
    return n


@compiled_borrowing
def _add_pairs(
    pairs: _Pairs,
    cells: Cells,
    scale: float,
    centre: Float,
    R: Float,
    mean: Float,
    covariance: Float,
    gate: float,
    distance_max: float,
) -> int:
    """Fill `pairs` with the pairs within `gate` and `distance_max`, in ascending order of landmark and
    detection, and return their number. `cost` is the determinant of the covariance. A pair whose Mahalanobis
    distance is NaN counts as within the gate.

    Args:
        pairs: The table; it must have room for all pairs within `distance_max`.
        cells, scale: Grid of the detections for searches within `distance_max`.
        centre, R: Detections in the map, shape (D, 2) [m], and covariances xx, xy, yy, shape (D, 3) [m^2].
        mean, covariance: Landmarks in the map, shape (M, 2) [m], and covariances xx, xy, yy, shape (M, 3)
            [m^2].
        gate: Maximum Mahalanobis distance.
        distance_max: Maximum distance [m].
    """
    n = 0
    for j in range(mean.shape[0]):
        first = n
        u, v = first_of_four(mean[j, 0], mean[j, 1], scale)
        for quarter in range(4):
            d = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while d >= 0:
                y0, y1 = centre[d, 0] - mean[j, 0], centre[d, 1] - mean[j, 1]
                a, b = covariance[j, 0] + R[d, 0], covariance[j, 1] + R[d, 1]
                e = covariance[j, 2] + R[d, 2]
                det = a * e - b * b
                d2 = (e * y0 * y0 - 2 * b * y0 * y1 + a * y1 * y1) / det
                if y0 * y0 + y1 * y1 <= distance_max * distance_max and not d2 > gate * gate:
                    at = n
                    while at > first and pairs.detection[at - 1] > d:
                        pairs.squared[at], pairs.cost[at] = pairs.squared[at - 1], pairs.cost[at - 1]
                        pairs.detection[at] = pairs.detection[at - 1]
                        at -= 1
                    pairs.squared[at], pairs.cost[at], pairs.detection[at] = d2, det, d
                    pairs.of_detection[d] += 1
                    pairs.landmark[n] = j
                    n += 1
                d = cells.following[d]
    return n


@compiled_borrowing
def _is_one_to_one(pairs: _Pairs, n: int) -> bool:
    """Return whether each landmark and each detection is in at most one of the first n pairs, which are
    sorted by landmark."""
    clear = True
    for d in range(pairs.of_detection.shape[0]):
        clear = clear and pairs.of_detection[d] <= 1
    for k in range(1, n):
        clear = clear and pairs.landmark[k] != pairs.landmark[k - 1]
    return clear
