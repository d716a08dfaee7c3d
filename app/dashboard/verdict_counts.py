"""What became of the clusters of the standing scan, now and before the last change of a parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from app.dashboard.payload import verdict_counts
from pipeline.types.records import Frame, TruthTrees


@dataclass(frozen=True, slots=True)
class Counts:
    """How many clusters of a scan ended with each verdict.

    Attributes:
        index: Of the scan.
        verdicts: In words.
        right, wrong: Of those taken for trees, how many stand at a true tree and how many do not; None
            without truth.
    """

    index: int
    verdicts: dict[str, int]
    right: int | None
    wrong: int | None

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        return {"verdicts": self.verdicts, "right": self.right, "wrong": self.wrong}


def counts_of(frame: Frame, truth: TruthTrees | None, match_distance: float) -> Counts:
    """The counts of a scan; `match_distance` [m] is how far a detection may lie from its tree."""
    verdicts = verdict_counts(frame.clusters.verdict)
    if truth is None:
        return Counts(frame.index, verdicts, None, None)
    from pipeline.evaluation import match

    found = frame.estimate.T_map_base.apply(frame.detections.centre)
    truth_of = match(found, np.column_stack([truth.x, truth.y]), match_distance)
    right = sum(row >= 0 and truth.kind[row] == "tree" for row in truth_of.tolist())
    return Counts(frame.index, verdicts, right, len(found) - right)


class BeforeAfter:
    """Remembers how the standing scan looked before the last change."""

    def __init__(self) -> None:
        self._now: Counts | None = None
        self._before: Counts | None = None

    def forget(self) -> None:
        """Another run begins."""
        self._now = self._before = None

    def step(self) -> None:
        """A change begins that is a step of its own."""
        self._before = self._now

    def shown(self, counts: Counts) -> dict[str, Any]:
        """Take the counts of what is shown now; gives what the page needs of them."""
        self._now = counts
        if self._before is not None and self._before.index != counts.index:
            self._before = None  # of another scan
        before = None if self._before is None else self._before.as_plain()
        return {"right": counts.right, "wrong": counts.wrong, "before": before}
