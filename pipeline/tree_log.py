"""What the trees of a run are made of: for each scan, what SLAM and the voxel columns gave to the tracks.

Poses, landmarks and columns do not depend on the parameters of the tracks and on the share of votes of a
tree. After a change of one of these, the trees are made again from this log, without SLAM and without
columns; see `TreeRerun`. Trees act on poses only by the search of loops, which is therefore repeated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from pipeline.classification import ColumnVotes
from pipeline.config import Parameters
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Float, Pose2
from pipeline.loop_closure.detection import RunHistory
from pipeline.slam import Loop
from pipeline.types.records import Columns, Detections, Landmarks, PoseEstimate

#: Memory of a scan without the contents of its 20 arrays, and of these contents for each detection and for
#: each landmark [bytes].
SCAN_BYTES, DETECTION_BYTES, LANDMARK_BYTES = 4000, 120, 56
#: Parameters, by stage, that act on the trees only.
OF_TREES = {"tracking": None, "classification": {"tree_share"}, "evaluation": None, "obstacles": None}


class TreesDifferError(Exception):
    """The trees cannot be made again from the log: a scan is not in it, or other trees close other loops."""


class LoopSearch(NamedTuple):
    """A search of loops, and its result.

    Attributes:
        history: Function of `stamp_ns`, `path`, `trees` and `motion` that returns the history for the search.
        is_due: Whether loops by constellations were searched for.
        found: The loop by a constellation and that by doubled trees; None for none.
    """

    history: Callable[..., RunHistory]
    is_due: bool
    found: tuple[Loop | None, Loop | None]


class TreeCorrection(NamedTuple):
    """A correction of the map, see `Tracker.correct`."""

    correction: PathCorrection
    estimate: PoseEstimate
    landmarks: Landmarks
    of_map: Float


@dataclass(frozen=True, slots=True, eq=False)
class TreeInput:
    """What a scan gave to the trees, in the order in which it is used.

    Attributes:
        stamp_ns: Time of the scan [ns].
        step: Motion from the scan before by odometry.
        estimate: Pose, without particles.
        keeps_state: Whether the relocaliser stored the state before the scan.
        seen: Detections, landmarks and heights of the detections; None if the scan updates no tracks.
        columns: Axes and votes of the columns, its other arrays are empty; None without columns.
        votes: What decides the verdicts of the columns; None for a scan that does not update them.
        search: The search of loops; None at a scan without it.
        corrections: Corrections after it.
    """

    stamp_ns: int
    step: Pose2
    estimate: PoseEstimate
    keeps_state: bool
    seen: tuple[Detections, Landmarks, Float | None] | None
    columns: Columns | None
    votes: ColumnVotes | None
    search: LoopSearch | None
    corrections: tuple[TreeCorrection, ...]


class TreeLog:
    """What each scan of a run gave to its trees.

    Args:
        most: Memory that the log takes at most [bytes]; inf for any. Beyond it, the log is empty and remains
            so: without the first scans, the trees cannot be made from it.

    Attributes:
        nbytes: Memory that it takes, approximately [bytes].
    """

    def __init__(self, most: float = math.inf) -> None:
        self._scans: list[TreeInput | None] = []
        self._sizes: list[int] = []
        self._most, self.nbytes = most, 0
        self._is_over = False
        self._columns: Columns | None = None  # the last ones, with axes and votes only

    def put(self, index: int, known: TreeInput | None) -> None:
        """Store the input of a scan, in place of an earlier one; None if the trees cannot be made from it."""
        if index > len(self._scans) or self._is_over:
            return
        size = 0 if known is None else _size(known, self._scans[index - 1] if index else None)
        if index == len(self._scans):
            self._scans.append(None)
            self._sizes.append(0)
        self.nbytes += size - self._sizes[index]
        self._scans[index], self._sizes[index] = known, size
        if self.nbytes > self._most:
            self._is_over, self.nbytes = True, 0
            self._scans.clear()
            self._sizes.clear()

    def lean(self, columns: Columns) -> Columns:
        """Return columns with axes and votes only; the other arrays are empty. Columns with the same axes
        give the same record."""
        if self._columns is None or self._columns.axis is not columns.axis:
            names = [f.name for f in fields(columns) if f.name not in ("axis", "share")]
            self._columns = replace(columns, **{name: getattr(columns, name)[:0].copy() for name in names})
        return self._columns

    def until(self, scans: int) -> TreeLog:
        """Return a log of the first scans, which must be known. The entries are shared."""
        log = TreeLog(self._most)
        log._scans, log._sizes = self._scans[:scans], self._sizes[:scans]
        log.nbytes = sum(log._sizes)
        return log

    def at(self, index: int) -> TreeInput:
        """Return the input of a scan; TreesDifferError if it is not known."""
        known = self._scans[index] if index < len(self._scans) else None
        if known is None:
            raise TreesDifferError
        return known

    def has_all(self, scans: int) -> bool:
        """Return whether the inputs of the first scans are known."""
        return len(self._scans) >= scans and None not in self._scans[:scans]


def _size(known: TreeInput, before: TreeInput | None) -> int:
    """Return the approximate memory that an input takes in addition to that of the scan before [bytes]:
    landmarks and columns are shared by the scans that do not change them."""
    size = SCAN_BYTES + sum(2 * each.correction.after.nbytes for each in known.corrections)
    if known.votes is not None and known.columns is not None:
        size += known.votes.nbytes + known.columns.axis.nbytes + known.columns.share.nbytes
    if known.seen is not None:
        size += DETECTION_BYTES * len(known.seen[0].centre)
    shared = before.seen[1].birth if before is not None and before.seen is not None else None
    if known.seen is not None and known.seen[1].birth is not shared:
        size += LANDMARK_BYTES * len(known.seen[1].birth)
    return size


def lean(estimate: PoseEstimate) -> PoseEstimate:
    """Return an estimate without particles, weights and landmarks."""
    nothing = np.zeros(0)
    return replace(estimate, particles=nothing, weights=nothing, landmarks=nothing)


def are_same(a: Loop | None, b: Loop | None) -> bool:
    """Return whether two loops are equal, bit by bit."""
    if a is None or b is None:
        return a is b
    same = (a.first, a.anchor, a.T_map_base) == (b.first, b.anchor, b.T_map_base)
    return same and np.array_equal(a.covariance, b.covariance)


def differ_in_trees_only(a: Parameters, b: Parameters) -> bool:
    """Return whether two sets of parameters differ at most in those that act on the trees only."""
    breast = a.tracking.breast_height == b.tracking.breast_height  # centres of clusters refer to it
    return breast and _without_trees(a) == _without_trees(b)


def _without_trees(p: Parameters) -> dict[str, object]:
    values = p.model_dump()
    for stage, names in OF_TREES.items():
        for name in list(values[stage]) if names is None else names:
            del values[stage][name]
    return values
