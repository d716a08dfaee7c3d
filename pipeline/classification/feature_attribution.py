"""What told most: how the vote on a column would change if one of its figures were not known."""

from __future__ import annotations

import numpy as np

from pipeline.classification.forest import CLASSES, Forest
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import Int32, Verdict

_DEEPEST = 1024  # levels of a tree; far more than training allows


def what_told(figures: Float, forest: Forest, kind: Verdict) -> Float:
    """For each figure, the share of `kind` less the share if that figure were not known, when both answers
    to each question for it count by half. Positive: the figure speaks for the kind.

    Args:
        figures: Of one column, shape (F,).
        forest: That votes on it.
        kind: One of CLASSES.

    Returns:
        Shape (F,), each within -1 and 1; 0 where no tree asks for the figure on the way.
    """
    f = forest
    share = np.ascontiguousarray(f.share[:, CLASSES.index(kind)])
    return _what_told(figures, f.root, f.feature, f.threshold, f.left, f.right, share)


@compiled
def _what_told(
    figures: Float, root: Int32, feature: Int32, threshold: Float, left: Int32, right: Int32, share: Float
) -> Float:
    told = np.zeros(figures.shape[0])
    for t in range(root.shape[0]):
        known = _share(figures, -2, root[t], feature, threshold, left, right, share)
        for f in range(figures.shape[0]):
            unknown = _share(figures, f, root[t], feature, threshold, left, right, share)
            told[f] += (known - unknown) / root.shape[0]
    return told


@compiled
def _share(
    figures: Float,
    unknown: int,
    root: int,
    feature: Int32,
    threshold: Float,
    left: Int32,
    right: Int32,
    share: Float,
) -> float:
    """The share at the leaf, averaged over both ways at each question for the unknown figure."""
    waiting, weight = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    waiting[0], weight[0] = root, 1.0
    n, total = 1, 0.0
    while n > 0:
        n -= 1
        node, w = waiting[n], weight[n]
        while feature[node] >= 0:
            if feature[node] == unknown and n < _DEEPEST:
                w *= 0.5
                waiting[n], weight[n] = right[node], w
                n += 1
                node = left[node]
            else:
                node = left[node] if figures[feature[node]] <= threshold[node] else right[node]
        total += w * share[node]
    return total
