"""Outlook: what is told anew of a column because scans now look higher than when it was judged.

Who stood by when the robot set out was judged by what was seen from two metres away, where no ring reaches
above the head. The robot's later views from afar add few returns to so many, so that the tile does not count
as grown.
"""

from __future__ import annotations

import numpy as np

from pipeline.classification.features import NAMES
from pipeline.classification.voxel_map import SLICE
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Columns, Int, Int32

HIGHER = 0.5  # m; by so much a scan must have looked higher
MOST = 2  # tiles a scan, so that none takes long
_LOOKED, _RAYS = NAMES.index("looked at up to"), NAMES.index("rays up to")


def seen_higher(columns: Columns) -> Int:
    """Tiles, shape (T, 2), at most MOST, with a column above which scans have looked since it was judged,
    those first where they looked highest above what was known."""
    c = columns
    gain = _gains(c.viewed, c.met, c.passed, c.figures)
    rows = np.argsort(-gain, kind="stable")
    rows = rows[: np.count_nonzero(gain > HIGHER)]
    _, first = np.unique(c.tile[rows], axis=0, return_index=True)
    tiles: Int = c.tile[rows[np.sort(first)[:MOST]]]
    return tiles


@compiled
def _gains(viewed: Float, met: Int32, passed: Int32, figures: Float) -> Float:
    """By how much more than its figures know scans looked up at each column, shape (K,) [m]."""
    gain = np.zeros(viewed.shape[0])
    for k in range(gain.shape[0]):
        told = 0
        for s in range(1, met.shape[1]):
            if met[k, s] + passed[k, s] > 0:
                told = s
        gain[k] = max(viewed[k] - figures[k, _LOOKED], told * SLICE - figures[k, _RAYS])
    return gain
