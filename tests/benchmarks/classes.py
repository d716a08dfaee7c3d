"""False trees by class, in simulated stands and in labelled scans."""

from __future__ import annotations

from collections import Counter

import numpy as np

from pipeline.config.stages import Evaluation
from pipeline.evaluation import match
from pipeline.types.records import Bool, Float, Int, Trees, TruthTrees
from tests.benchmarks.table import Cell, Table

NOTHING = "nothing"
NEAR = 0.35  # m; labelled points within this distance of a position determine its class
NAMES = {
    10: "car",
    11: "bicycle",
    15: "motorcycle",
    18: "truck",
    20: "other vehicle",
    30: "person",
    31: "bicyclist",
    50: "building",
    51: "fence",
    52: "other structure",
    70: "vegetation",
    80: "pole",
    81: "traffic sign",
    99: "other object",
}


class ByClass:
    """Counts over several runs."""

    def __init__(self) -> None:
        self.there: Counter[str] = Counter()
        self.taken: Counter[str] = Counter()

    def add_map(self, trees: Trees, truth: TruthTrees, path: Float, parameters: Evaluation) -> None:
        """Add a simulated run: the true objects at the mapped trees, both within reach of the path.

        Args:
            trees: The map; truth: in its frame; path: shape (N, 2) [m].
            parameters: As `pipeline.evaluation.evaluate` takes them.
        """
        place = np.stack([truth.x, truth.y], axis=1)
        found = trees.position[trees.confirmed]
        truth_of = match(found, place, parameters.match_distance)
        taken = np.zeros(len(place), np.bool_)
        taken[truth_of[truth_of >= 0]] = True
        asked = _within(place, path, parameters.reach)
        for kind in np.array(truth.kind)[asked & _is_other(truth)]:
            self.there[str(kind)] += 1
        for kind in np.array(truth.kind)[asked & taken & _is_other(truth)]:
            self.taken[str(kind)] += 1
        alone = (truth_of < 0) & _within(found, path, parameters.reach)
        self.taken[NOTHING] += int(np.count_nonzero(alone))

    def add_labels(self, false: Float, points: Float, label: Int) -> None:
        """Add a labelled scan: the class of most points at each false tree.

        Args:
            false: Places of the map that are no trunk, shape (K, 2) [m].
            points: shape (N, 3) [m]; label: of each, shape (N,).
        """
        from scipy.spatial import cKDTree

        named = np.isin(label, list(NAMES))
        if not len(false) or not named.any():
            self.taken[NOTHING] += len(false)
            return
        for rows in cKDTree(points[named, :2]).query_ball_point(false, NEAR):
            names, counts = np.unique(label[named][rows], return_counts=True)
            self.taken[NAMES[int(names[counts.argmax()])] if len(names) else NOTHING] += 1

    def table(self, title: str) -> Table:
        """Return the counts, the most frequent class first; "of" is empty where the number of objects is
        unknown."""
        kinds = sorted({*self.there, *self.taken}, key=lambda kind: (-self.taken[kind], kind))
        rows: tuple[tuple[Cell, ...], ...] = tuple(
            (kind, self.taken[kind], self.there.get(kind))
            for kind in kinds
            if kind != NOTHING or self.taken[kind]
        )
        return Table(title, ("class", "taken for a tree", "of"), rows)


def _is_other(truth: TruthTrees) -> Bool:
    return np.array([kind != "tree" for kind in truth.kind], np.bool_)


def _within(place: Float, path: Float, reach: float) -> Bool:
    from scipy.spatial import cKDTree

    if not len(place):
        return np.zeros(0, np.bool_)
    near: Bool = cKDTree(path).query(place)[0] <= reach
    return near
