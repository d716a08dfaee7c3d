"""What else stands upright in a plot: the columns of the gathered voxels, judged by the decision trees.

A whole cloud is what a robot would gather if it had been everywhere: each place was looked at as high as
stems are followed, and nothing was ever gone.
"""

from __future__ import annotations

import numpy as np

from pipeline.classification.column_extraction import MARGIN, examine
from pipeline.classification.features import COUNT, features
from pipeline.classification.forest import CLASSES, Forest, vote
from pipeline.classification.voxel_map import SLICE, SLICES, TILE, Memory
from pipeline.geometry.poses import Float
from pipeline.types.records import Float32

TWICE = 0.3  # m; columns nearer to one another are one
OFTEN = 50.0  # scans that all saw it
MOST_VOXELS = 1 << 20


def find_upright(points: Float32, forest: Forest) -> tuple[Float, Float]:
    """Upright columns and the votes on them.

    Args:
        points: shape (N, 4): x, y, z, height above the ground [m].
        forest: That votes.

    Returns:
        Places, shape (K, 2) [m], and shares of the kinds in the order of CLASSES, shape (K, 6).
    """
    memory = Memory.empty()
    memory.add(np.ascontiguousarray(points[:, [0, 1, 3]]), 0, MOST_VOXELS)
    axes, figures = [np.zeros((0, 5))], [np.zeros((0, COUNT))]
    for tile in memory.judge_anew(1.0):
        mean, returns = memory.around(tile, MARGIN)
        axis, profiles = examine(mean, returns, tile * TILE, TILE)
        n = len(axis)
        row = np.zeros((n, COUNT))
        met = (profiles[:, :, 0] > 0.0).astype(np.int32)
        always = (np.full(n, SLICES * SLICE), np.full(n, OFTEN), np.zeros(n))
        features(axis, profiles, *always, met, 1 - met, row)
        axes.append(axis)
        figures.append(row)
    axis = np.concatenate(axes)
    share = vote(np.concatenate(figures), forest)
    strongest = np.argsort(-axis[:, 4], kind="stable")
    kept = _apart(axis[strongest, :2])
    return axis[strongest, :2][kept], share[strongest][kept]


def _apart(places: Float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which places have none before them nearer than TWICE."""
    from scipy.spatial import cKDTree

    kept = np.ones(len(places), np.bool_)
    if len(places) > 1:
        pairs = cKDTree(places).query_pairs(TWICE, output_type="ndarray")
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        for first, second in pairs:  # few: only columns that were found twice
            if kept[first]:
                kept[second] = False
    return kept


__all__ = ["CLASSES", "find_upright"]
