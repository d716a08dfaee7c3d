"""The clusters of all kept scans as one table in memory: what the verdicts ask, and where they stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.config.stages import Detection
from pipeline.detection.verdicts import classify_clusters
from pipeline.geometry.poses import Float
from pipeline.types.records import Clusters, Int, Int32, Verdict

ASKED: dict[str, tuple[str, tuple[int, ...]]] = {
    "hidden": ("?", ()),
    "cut": ("?", ()),
    "extent": ("<f8", (3,)),
    "eccentricity": ("<f8", ()),
    "radial_std": ("<f8", ()),
    "radius": ("<f8", ()),
    "arc": ("<f8", ()),
    "centre": ("<f8", (2,)),
}
_FIRST_ROWS = 4096


class ClusterTable:
    """Columns that grow scan by scan, about 75 bytes a cluster.

    Attributes:
        start: The first row of each scan, and behind the last one the number of all rows.
    """

    def __init__(self) -> None:
        self._columns = {name: np.zeros((_FIRST_ROWS, *rest), kind) for name, (kind, rest) in ASKED.items()}
        self.start: list[int] = [0]

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def nbytes(self) -> int:
        """Of the columns, with their spare room."""
        return sum(column.nbytes for column in self._columns.values())

    def put(self, index: int, clusters: Clusters) -> None:
        """The clusters of a scan, which is the next one or one that is there; later ones are forgotten. One
        that is farther ahead is left out."""
        if index > len(self):
            return
        del self.start[index + 1 :]
        first = self.start[index]
        last = first + len(clusters.size)
        for name, column in self._columns.items():
            grown = column
            while last > len(grown):
                grown = np.concatenate([grown, np.zeros_like(grown)])
            grown[first:last] = getattr(clusters, name)
            self._columns[name] = grown
        self.start.append(last)

    def of(self, scans: Sequence[int]) -> ClusterTable:
        """A table of some scans alone, in their order, which nobody adds to."""
        rows = [np.arange(self.start[k], self.start[k + 1]) for k in scans]
        taken = ClusterTable()
        taken.start = np.cumsum([0, *map(len, rows)]).tolist()
        every = np.concatenate([np.zeros(0, np.int64), *rows])
        taken._columns = {name: column[every] for name, column in self._columns.items()}
        return taken

    def centre(self, scans: int) -> Float:
        """x, y in the level sensor frame [m] of the clusters of the first scans, shape (K, 2)."""
        return self._columns["centre"][: self.start[scans]]

    def verdicts(self, parameters: Detection, scans: int) -> Int32:
        """Of the clusters of the first scans, shape (K,)."""
        rows = self.start[scans]
        columns: dict[str, Any] = {name: column[:rows] for name, column in self._columns.items()}
        nothing = np.zeros(rows)
        asked = Clusters(
            **columns,
            size=nothing.astype(np.int64),
            centroid=nothing,
            eigenvalues=nothing,
            covariance=nothing,
            radius_sigma=nothing,
            verdict=nothing.astype(np.int32),
        )
        return classify_clusters(asked, parameters).verdict

    def first_judged_otherwise(self, before: Detection, after: Detection, scans: int) -> int:
        """The first of some scans whose detections differ between two sets of parameters; `scans` if none."""
        if (before.sigma_range, before.sigma_bearing) != (after.sigma_range, after.sigma_bearing):
            return 0
        was, now = self.verdicts(before, scans) == Verdict.TREE, self.verdicts(after, scans) == Verdict.TREE
        rows: Int = np.flatnonzero(was != now)
        return int(np.searchsorted(self.start, rows[0], side="right")) - 1 if len(rows) else scans
