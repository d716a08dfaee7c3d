"""Distances between pairs of trees (Fig. 6) and their error in percent (Fig. 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
    """The error of the distance between each two trees.

    Attributes:
        percent: shape (N, N): 100 |d_map - d_truth| / d_truth, 0 on the diagonal.
        mean: Mean over the pairs [%], NaN with fewer than two trees.
        largest: [%], NaN likewise.
    """

    percent: Float
    mean: float
    largest: float


def pair_distances(position: Float) -> Float:
    """Distances between all pairs of shape (N, 2) [m], shape (N, N)."""
    difference = position[:, None, :] - position[None, :, :]
    distances: Float = np.hypot(difference[..., 0], difference[..., 1])
    return distances


def pair_errors(found: Float, truth: Float) -> PairErrors:
    """Compare the distances among found trees with those among their truths, row by row (N, 2) [m].

    No alignment is needed: distances do not change when the whole map is moved or turned.
    """
    d_map, d_truth = pair_distances(found), pair_distances(truth)
    apart = d_truth > 0.0
    percent = np.zeros_like(d_truth)
    percent[apart] = 100.0 * np.abs(d_map - d_truth)[apart] / d_truth[apart]
    pairs = percent[np.triu_indices(len(found), k=1)]
    if len(pairs) == 0:
        return PairErrors(percent, float("nan"), float("nan"))
    return PairErrors(percent, float(pairs.mean()), float(pairs.max()))
