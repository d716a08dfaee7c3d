"""Trees tracked anew over the journal of a run: poses, and what was gathered, stay as they were."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.classification import Judged, no_columns
from pipeline.config import Parameters
from pipeline.mapper import MapperState
from pipeline.remapping.notes import Notes
from pipeline.tracking.recorded import Seen, Tracking
from pipeline.tracking.track_table import TrackTable
from pipeline.types.records import Columns, Int, Int32, Trees


@dataclass(frozen=True, slots=True, eq=False)
class Recalled:
    """Some scans of which the trees alone were found anew.

    Attributes:
        index, stamp_ns, trees: Of the last of them.
        first: Number of the first of them; stamps_ns: int64, of each.
        seen: What each made of the trees that it detected.
        confirmed: Numbers of the trees that were confirmed for the first time, and at which scan.
    """

    index: int
    stamp_ns: int
    trees: Trees
    first: int
    stamps_ns: Int
    seen: Seen
    confirmed: tuple[Int, Int]


@dataclass(frozen=True, slots=True, eq=False)
class Retold:
    """What a change of the late parameters changes of a state."""

    tracks: TrackTable
    next_number: int
    verdict: Int32


class Tail:
    """Repeats what `Mapper.take` does behind SLAM and gathering.

    Args:
        parameters: That are tried.
        notes: Of the scans from the first on, each one usual.
        states: Of the mapper that noted them, by the number of scans they hold.

    Attributes:
        done: Scans that are tracked.
    """

    def __init__(self, parameters: Parameters, notes: Notes, states: Mapping[int, MapperState]) -> None:
        self._tree_share = parameters.classification.tree_share
        self._notes = notes
        self._starts = np.cumsum([0, *map(len, notes.stretches)]).tolist()
        self._states = states
        self._tracking = Tracking(parameters)
        # What a search for a lost robot would go back to is a part of states that come later.
        wanted = {kept.path_length for state in states.values() for kept in state.recovery.kept}
        self._wanted = sorted(wanted, reverse=True)
        self._before: dict[int, Retold] = {}
        self._verdict: tuple[int, Int32] = (-1, np.zeros(0, np.int32))  # of the columns of a stretch
        self.done = 0
        self._keep()

    def track(self, until: int) -> Recalled:
        """Take the next scans, all that were laid together at most, and none beyond so many of the run."""
        number = bisect_right(self._starts, self.done) - 1
        stretch, begin = self._notes.stretches[number], self._starts[number]
        if self._verdict[0] != number:
            self._verdict = (number, stretch.judged.verdict(self._tree_share))
        first, last = self.done - begin, min(until, self._starts[number + 1]) - begin
        if self._wanted:
            last = min(last, self._wanted[-1] - begin)
        seen = self._tracking.track(stretch.recorded, self._verdict[1], first, last, begin)
        index, self.done = self.done, begin + last
        self._keep()
        return Recalled(
            index=self.done - 1,
            stamp_ns=int(stretch.recorded.stamp_ns[last - 1]),
            trees=self._tracking.trees(),
            first=index,
            stamps_ns=stretch.recorded.stamp_ns[first:last],
            seen=seen,
            confirmed=self._tracking.confirmed_since(index),
        )

    def state(self) -> MapperState | None:
        """Of a mapper that had these parameters from the first scan on; None where the other kept none."""
        before = self._states.get(self.done)
        if before is None:
            return None
        return _with_trees(before, self._trees(), self._before)

    def _keep(self) -> None:
        if self._wanted and self.done == self._wanted[-1]:
            self._before[self._wanted.pop()] = self._trees()

    def _trees(self) -> Retold:
        t = self._tracking
        return Retold(t.tracks.copy(), t.next_number, t.verdict)


def _with_trees(state: MapperState, trees: Retold, before: Mapping[int, Retold]) -> MapperState:
    """The state with these trees, and those that it would go back to with theirs, by the number of scans."""
    kept = tuple(_with_trees(k, before[k.path_length], before) for k in state.recovery.kept)
    columns = replace(state.gathering.columns, verdict=trees.verdict)
    return replace(
        state,
        tracks=trees.tracks,
        next_number=trees.next_number,
        gathering=replace(state.gathering, columns=columns),
        recovery=replace(state.recovery, kept=kept),
    )


def columns_of(known: Judged, tree_share: float) -> Columns:
    """As `Tracker.judge` takes them: places, votes and verdicts, and nothing else."""
    axis = np.zeros((len(known.votes), 5))
    axis[:, :2] = known.place
    return replace(no_columns(), axis=axis, share=known.votes, verdict=known.verdict(tree_share))
