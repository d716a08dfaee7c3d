"""Examples out of a run that people annotated: what was gathered of each thing that somebody judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from app.store.records import Content
from app.training.fit_forest import Examples
from pipeline.classification.features import COUNT
from pipeline.classification.forest import CLASSES
from pipeline.types.records import Columns, Float, Int, Verdict

# Scans that saw a thing after which it is an example: a map is judged from its first scan on.
SEEN = (3, 10, 30)
# So near to an annotation a column may be what is meant [m].
REACH = {"tree": 0.4, "pole": 0.35, "person": 0.5, "bush": 0.9, "other": 0.9}
CLASS_OF_KIND = {
    "tree": CLASSES.index(Verdict.TREE),
    "pole": CLASSES.index(Verdict.POLE),
    "person": CLASSES.index(Verdict.PERSON),
    "bush": CLASSES.index(Verdict.BUSH),
    "other": CLASSES.index(Verdict.OTHER),
}


class Judged:
    """Looks, scan by scan, at the columns where somebody said what stands.

    Args:
        annotations: Of the run, in the frame of its map.
    """

    def __init__(self, annotations: Sequence[Content]) -> None:
        from scipy.spatial import cKDTree

        self._annotations = annotations
        self._place = np.array([[a.x, a.y] for a in annotations]).reshape(-1, 2)
        self._reach = np.array([REACH[a.kind] for a in annotations])
        self._nearest = cKDTree(self._place) if len(annotations) else None
        self._marked: list[list[Float]] = [[] for _ in annotations]
        self._last: list[Float | None] = [None for _ in annotations]
        self._before: Columns | None = None

    def see(self, columns: Columns | None) -> None:
        """Take what is known after a scan; None where nothing is gathered."""
        if columns is None or columns is self._before or self._nearest is None or not len(columns.axis):
            return
        self._before = columns
        for annotation, row in self._pairs(columns.axis[:, :2]):
            figures, marks = columns.figures[row].copy(), self._marked[annotation]
            self._last[annotation] = figures
            if len(marks) < len(SEEN) and columns.present[row] >= SEEN[len(marks)]:
                marks.append(figures)

    def examples(self, scene: str, *, all_around: bool) -> Examples:
        """All of it. In place of an axis stands the annotation's place, so that all examples of one thing are
        known; its last one comes last. What no column was ever found for is left out."""
        axis, rows, label = [], [], []
        for a, marked, last in zip(self._annotations, self._marked, self._last, strict=True):
            taken = [] if last is None else [*marked, last]
            rows += taken
            axis += [[a.x, a.y, 0.0, 0.0, 0.0]] * len(taken)
            label += [CLASS_OF_KIND[a.kind]] * len(taken)
        return Examples(
            scene,
            False,
            all_around,
            np.array(axis, np.float64).reshape(-1, 5),
            np.array(rows, np.float64).reshape(-1, COUNT),
            np.array(label, np.int64),
        )

    def _pairs(self, place: Float) -> list[tuple[int, int]]:
        """Annotations with the columns that are nearest to them, each of both at most once."""
        assert self._nearest is not None  # noqa: S101 - `see` has asked
        distance, annotation = self._nearest.query(place)
        near = np.flatnonzero(distance <= self._reach[annotation])
        order = near[np.argsort(distance[near], kind="stable")]
        _, first = np.unique(annotation[order], return_index=True)
        return [(int(annotation[row]), int(row)) for row in order[first]]


def things_of(examples: Sequence[Examples]) -> Int:
    """A number for each example that is the same for all examples of one thing: of one place in one scene."""
    key = [
        (scene, float(x), float(y))
        for scene, each in enumerate(examples)
        for x, y in each.axis[:, :2].tolist()
    ]
    known: dict[tuple[int, float, float], int] = {}
    return np.array([known.setdefault(each, len(known)) for each in key], np.int64)
