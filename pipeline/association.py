"""Which detection is which tree: by likelihood, one to one."""

from __future__ import annotations

import numpy as np

from pipeline.compiled import compiled
from pipeline.geometry import Float
from pipeline.records import Int


@compiled
def associate(
    centre: Float, R: Float, mean: Float, covariance: Float, gate: float, distance_max: float
) -> tuple[Int, Float]:
    """The landmark of each detection, -1 for none: pairs by falling likelihood, each used once.

    Args:
        centre: Detections, shape (D, 2) [m]; R: their covariances xx, xy, yy, shape (D, 3).
        mean: Landmarks in the same frame, shape (M, 2) [m]; covariance: likewise, shape (M, 3).
        gate: Largest Mahalanobis distance [sigma].
        distance_max: Largest distance [m].

    Returns:
        landmark row and squared Mahalanobis distance of each detection, shape (D,).
    """
    detections = centre.shape[0]
    landmark_of = np.full(detections, -1, np.int64)
    distance2 = np.zeros(detections)
    if detections == 0:
        return landmark_of, distance2
    low_x, high_x = centre[:, 0].min() - distance_max, centre[:, 0].max() + distance_max
    low_y, high_y = centre[:, 1].min() - distance_max, centre[:, 1].max() + distance_max
    pairs = 0
    room = 4 * detections + 16
    cost = np.empty(room)
    pair = np.empty((room, 2), np.int64)
    squared = np.empty(room)
    for j in range(mean.shape[0]):
        x, y = mean[j, 0], mean[j, 1]
        if x < low_x or x > high_x or y < low_y or y > high_y:
            continue
        for d in range(detections):
            y0, y1 = centre[d, 0] - x, centre[d, 1] - y
            if y0 * y0 + y1 * y1 > distance_max * distance_max:
                continue
            a = covariance[j, 0] + R[d, 0]
            b = covariance[j, 1] + R[d, 1]
            e = covariance[j, 2] + R[d, 2]
            det = a * e - b * b
            d2 = (e * y0 * y0 - 2 * b * y0 * y1 + a * y1 * y1) / det
            if d2 > gate * gate:
                continue
            if pairs == room:
                room *= 2
                cost = np.append(cost, np.empty(pairs))
                squared = np.append(squared, np.empty(pairs))
                pair = np.append(pair, np.empty((pairs, 2), np.int64), axis=0)
            cost[pairs] = d2 + np.log(det)
            squared[pairs] = d2
            pair[pairs, 0], pair[pairs, 1] = d, j
            pairs += 1
    order = np.argsort(cost[:pairs], kind="mergesort")
    taken = np.zeros(mean.shape[0], np.bool_)
    for k in order:
        d, j = pair[k, 0], pair[k, 1]
        if landmark_of[d] < 0 and not taken[j]:
            landmark_of[d] = j
            distance2[d] = squared[k]
            taken[j] = True
    return landmark_of, distance2
