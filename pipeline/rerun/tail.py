"""Trees tracked anew over the journal of a run: poses, and what was gathered, stay as they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.gathering import Judged, no_columns
from pipeline.mapper_records import MapperState
from pipeline.parameters import Parameters
from pipeline.records import Columns, Int32, Trees
from pipeline.rerun.journal import Entry
from pipeline.tracking import Tracker
from pipeline.tracking.table import TrackTable


@dataclass(frozen=True, slots=True, eq=False)
class Recalled:
    """A scan of which the trees alone were found anew."""

    index: int
    stamp_ns: int
    trees: Trees


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
        entries: Of the scans from the first on, each one usual.
        states: Of the mapper that noted them, by the number of scans they hold.
    """

    def __init__(
        self, parameters: Parameters, entries: tuple[Entry, ...], states: Mapping[int, MapperState]
    ) -> None:
        self._parameters = parameters
        self._entries = entries
        self._states = states
        self._tracker = Tracker(parameters.tracking)
        # What a search for a lost robot would go back to is a part of states that come later.
        self._wanted = {kept.path_length for state in states.values() for kept in state.recovery.kept}
        self._before: dict[int, Retold] = {}
        self._verdict: Int32 = np.zeros(0, np.int32)  # of the columns, when they were judged last
        self.done = 0
        self._keep()

    def track(self) -> Recalled:
        """Take the next scan."""
        entry, view_range = self._entries[self.done], self._parameters.slam.view_range
        tracker = self._tracker
        tracker.process(
            entry.stamp_ns,
            entry.T_map_base,
            entry.covariance,
            entry.detections,
            entry.free,
            view_range,
            entry.heights,
            entry.relative,
        )
        tracker.anchor(*entry.landmarks, entry.T_map_base, view_range)
        if entry.columns is not None:
            p = self._parameters.gathering
            judged = tracker.judge(entry.stamp_ns, columns_of(entry.columns, p.tree_share), p)
            self._verdict = judged.verdict
        self.done += 1
        self._keep()
        return Recalled(self.done - 1, entry.stamp_ns, tracker.trees())

    def state(self) -> MapperState | None:
        """Of a mapper that had these parameters from the first scan on; None where the other kept none."""
        before = self._states.get(self.done)
        if before is None:
            return None
        return _with_trees(before, self._trees(), self._before)

    def _keep(self) -> None:
        if self.done in self._wanted:
            self._before[self.done] = self._trees()

    def _trees(self) -> Retold:
        return Retold(self._tracker.tracks.copy(), self._tracker.next_number, self._verdict)


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
