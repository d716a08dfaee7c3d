"""Which found trees the decision trees doubt most: those are worth an annotation first."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipeline.classification.forest import CLASSES
from pipeline.types.records import Frame

REACH = 0.45  # m; a column farther from a tree is another thing


def doubts_of(frame: Frame, tree_share: float) -> list[dict[str, Any]]:
    """The confirmed trees with the votes on what was gathered there, the closest to the limit first.

    Trees where nothing upright was gathered have no votes and come last.

    Args:
        frame: With its columns.
        tree_share: Share of the votes that makes a tree.
    """
    from scipy.spatial import cKDTree

    # As the page sorts them: of equal doubt the one that was seen least often.
    rows = np.flatnonzero(frame.trees.confirmed)
    rows = rows[np.lexsort((frame.trees.number[rows], frame.trees.observations[rows]))]
    number = frame.trees.number[rows].tolist()
    columns = frame.columns
    if columns is None or not len(columns.share):
        return [{"tree": each, "votes": None, "next": "", "next_votes": 0.0} for each in number]
    distance, column = cKDTree(columns.axis[:, :2]).query(frame.trees.position[rows])
    told = []
    for tree, far, row in zip(number, distance.tolist(), column.tolist(), strict=True):
        share = columns.share[row]
        other = 1 + int(share[1:].argmax())
        votes, following = (None if far > REACH else round(float(share[k]), 3) for k in (0, other))
        told.append({"tree": tree, "votes": votes, "next": CLASSES[other].label, "next_votes": following})
    return sorted(told, key=lambda each: _margin(each["votes"], tree_share))


def _margin(votes: float | None, tree_share: float) -> float:
    return float("inf") if votes is None else abs(votes - tree_share)
