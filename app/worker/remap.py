"""Remapping: the run is mapped again with other parameters, a few scans at a time, while it is paused or
plays; and the differences between the two maps, with reasons."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, is_dataclass
from typing import Generic, Literal, TypeVar

import numpy as np

from app.explain.history import TreeHistory
from app.worker.frame_store import FrameStore
from app.worker.protocol import MapChanges, TreeChange
from app.worker.tree_numbers import SAME
from pipeline.config import Parameters
from pipeline.evaluation import match
from pipeline.front_end import SegmentedScan
from pipeline.mapper import Mapper
from pipeline.remapping import ClusterTable, Rerun
from pipeline.remapping.rerun import Segment
from pipeline.slam import Genealogy, KeyframeGraph
from pipeline.types.records import Columns, Float, Frame, Step, Trees, Verdict

NOT_OF_THE_MAP = {"evaluation", "obstacles"}  # stages that do not change the map
NS = 1_000_000_000


class RunMap:
    """A map of the scans of a run, with the states to which it can return, and what is known of each mapped
    scan. Its trees have the numbers of the mapper, see `TreeNumbers`.

    Args:
        mapper: A mapper before its first scan.
        parameters: Parameters from the first scan onwards.
        start_ns: Returns the time of the first scan [ns].
        frames: Stores the frames; None stores none.

    Attributes:
        before: State of the mapper before the current scan.
        snapshots: Earlier states of the mapper.
        history: Estimate of each tree over time.
        confirmed_s: Time at which each tree was first confirmed, by its number [s since the first scan].
        clusters: Clusters of all scans.
    """

    def __init__(
        self,
        mapper: Mapper,
        parameters: Parameters,
        start_ns: Callable[[], int],
        frames: FrameStore | None = None,
    ) -> None:
        self.mapper, self.frames = mapper, frames
        self.parameters = ParameterHistory(parameters)
        self.before = mapper.snapshot()
        self.snapshots = Snapshots(self.before)
        self.history, self.clusters = TreeHistory(), ClusterTable()
        self.confirmed_s: dict[int, float] = {}
        self._start_ns, self._time_s = start_ns, -math.inf

    def add(self, frame: Frame) -> None:
        """Add the results of the scan that was mapped last. If the run went back, the entries of this scan
        and of later ones are replaced. A tree keeps the time of its first confirmation."""
        start_ns = self._start_ns()
        self.history.record(frame, start_ns)
        self.clusters.record(frame)
        time_s = (frame.stamp_ns - start_ns) / NS
        if time_s <= self._time_s:
            self.confirmed_s = {number: at for number, at in self.confirmed_s.items() if at < time_s}
        self._time_s = time_s
        for number in frame.trees.number[frame.trees.confirmed].tolist():
            self.confirmed_s.setdefault(number, time_s)
        if self.frames is not None:
            self.frames.put(frame, self.mapper.path, time_s, self.confirmed(frame.trees))

    def confirmed(self, trees: Trees) -> Float:
        """Return the time at which each tree was first confirmed [s since the first scan], shape (T,); NaN
        for trees that never were."""
        known = self.confirmed_s
        return np.array([known.get(number, np.nan) for number in trees.number.tolist()], dtype=np.float64)

    def ended(self, trees: Trees) -> dict[int, tuple[float, float]]:
        """Return the last position of each tree that was confirmed once and is not among `trees`, by its
        number [m]."""
        last = self.history.last_places()
        return {n: last[n] for n in self.confirmed_s.keys() - set(trees.number.tolist()) if n in last}

    def use(self, parameters: Parameters, index: int) -> bool:
        """Use other parameters from the scan with an index onwards; no scan is mapped. Return whether any
        value changes; then what is stored of later scans is dropped."""
        changes = self.parameters.set_from(index, parameters)
        if changes:
            self.snapshots.forget_after(index)
            if self.frames is not None:
                self.frames.forget_from(index)
        return changes

    def close(self) -> None:
        """Delete the stored frames."""
        if self.frames is not None:
            self.frames.close()


class Remapping:
    """A run that is mapped again from its first scan.

    Args:
        rerun: The rerun, with the mapper of the new map.
        new_map: The new map, before its first scan.
    """

    def __init__(self, rerun: Rerun, new_map: RunMap) -> None:
        self.rerun, self.map = rerun, new_map

    def map_next(self, until: int) -> bool:
        """Map the next scan; return whether `until` scans are mapped. If the run went back meanwhile, the
        rerun goes back as well.

        Raises:
            StemmapError: The scan cannot be read again.
        """
        rerun, snapshots = self.rerun, self.map.snapshots
        if rerun.done > until:
            rerun.go_back(*snapshots.newest(until))
        if rerun.done < until:
            if snapshots.is_due(rerun.done):
                snapshots.offer(rerun.done, rerun.mapper.snapshot())
            self.map.add(rerun.map_next())
        return rerun.done == until

    def finish(self) -> RunMap:
        """End the rerun and return the new map."""
        self.rerun.close()
        self.map.before = self.rerun.mapper.snapshot()
        return self.map


@dataclass(slots=True)
class MapComparison:
    """Keeps the map before a change of parameters, with which the new map is compared.

    Changes of one step (a slider drag) are compared with the map before the first of them.
    """

    _step: int | None = None
    _before: Frame | None = None

    def begin(self, step: int | None) -> None:
        """Begin a change of parameters that belongs to a step; None is a step of its own."""
        if step is None or step != self._step:
            self._before = None
        self._step = step

    def changes(
        self, shown: Frame, new: Frame, revision: int, time_s: float, confirmed_s: dict[int, float]
    ) -> MapChanges:
        """Return the differences between the map before the step and the new map. The map before is the
        present one if the step has none of this scan yet.

        Args:
            shown: The current scan with the present map.
            new: The same scan with the new map.
            revision: Revision of the parameters of the new map.
            time_s: Time of the scan [s since the first scan].
            confirmed_s: Time at which each tree of the new map was confirmed, by its number [s].
        """
        if self._before is None or self._before.index != new.index:  # the run went on, or elsewhere
            self._before = shown
        return changes_between(self._before, new, revision, time_s, confirmed_s)


S = TypeVar("S")

_SPACING = 50
_MOST_STATES = 40
_MOST_BYTES = 256 << 20


def nbytes(state: object) -> int:
    """Return the number of bytes of all arrays in nested dataclasses, lists and tuples; 0 for other
    values."""
    if isinstance(state, np.ndarray | Genealogy | KeyframeGraph):
        return state.nbytes
    if isinstance(state, list | tuple):
        return sum(map(nbytes, state))
    if is_dataclass(state):
        return sum(nbytes(getattr(state, field.name)) for field in fields(state))
    return 0


class Snapshots(Generic[S]):
    """States of the mapper by the number of scans they contain (0: before the first scan).

    At most 40 states and 256 MB are kept: beyond that, every second state is dropped and the spacing doubles,
    so that the memory is bounded for a run of any length. The first state is always kept.

    Args:
        start: State before the first scan.
    """

    def __init__(self, start: S) -> None:
        self._states: dict[int, S] = {0: start}
        self._sizes: dict[int, int] = {0: nbytes(start)}
        self._spacing = _SPACING

    def offer(self, scans: int, state: S) -> None:
        """Store a state if `is_due`.

        Args:
            scans: Number of scans that the state contains.
            state: The state.
        """
        if not self.is_due(scans):
            return
        self._states[scans], self._sizes[scans] = state, nbytes(state)
        while len(self._states) > 1 and self._are_too_many():
            self._spacing *= 2
            self._states = {n: s for n, s in self._states.items() if n % self._spacing == 0}

    def _are_too_many(self) -> bool:
        """Return whether the states exceed their number or memory."""
        return (
            len(self._states) > _MOST_STATES or sum(map(self._sizes.__getitem__, self._states)) > _MOST_BYTES
        )

    def is_due(self, scans: int) -> bool:
        """Return whether `offer` would store a state with this number of scans: a multiple of the spacing
        that is not stored yet."""
        return scans % self._spacing == 0 and scans not in self._states

    def newest(self, scans: int) -> tuple[int, S]:
        """Return the newest state with at most this number of scans (0 or more), as (number of scans,
        state)."""
        best = max(n for n in self._states if n <= scans)
        return best, self._states[best]

    def forget_after(self, scans: int) -> None:
        """Drop the states that contain more than this number of scans."""
        self._states = {n: s for n, s in self._states.items() if n <= scans}


class ParameterHistory:
    """Parameters with which each scan of the run was mapped."""

    def __init__(self, parameters: Parameters) -> None:
        self._starts = [0]
        self._sets = [parameters]

    def at(self, index: int) -> Parameters:
        """Return the parameters with which the scan with this index was or will be mapped."""
        return self._sets[bisect_right(self._starts, index) - 1]

    def apply_to_all(self, parameters: Parameters, aside: set[str]) -> bool:
        """Return whether every scan was mapped with these values.

        Args:
            parameters: The values.
            aside: Stages that are not compared.
        """
        wanted = parameters.model_dump(exclude=aside)
        return all(known.model_dump(exclude=aside) == wanted for known in self._sets)

    def set_from(self, index: int, parameters: Parameters) -> bool:
        """Set the parameters from a scan onwards, in place of all later ones. Return whether any value
        changes; if not, the results of later scans remain valid.

        Args:
            index: Index of the scan.
            parameters: The parameters.
        """
        if self.at(index) == parameters and self._starts[-1] <= index:
            return False
        kept = max(1, sum(start < index for start in self._starts))
        self._starts, self._sets = self._starts[:kept], self._sets[:kept]
        if index == 0:
            self._sets[0] = parameters
        elif self._sets[-1] != parameters:
            self._starts.append(index)
            self._sets.append(parameters)
        return True


AHEAD = 4  # scans that are segmented ahead of the mapping; more only take memory


def segment_ahead(segment: Segment, steps: Iterator[Step]) -> Iterator[tuple[Step, SegmentedScan]]:
    """Yield each step with its segmented scan, in order.

    The caller's thread reads the steps; another thread segments up to `AHEAD` scans ahead. An exception of
    `segment` is raised when its scan is due. If the caller stops early, scans that are not begun are dropped.
    """
    waiting: deque[tuple[Step, Future[SegmentedScan]]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="segment")
    try:
        for step in steps:
            waiting.append((step, pool.submit(segment, step)))
            if len(waiting) > AHEAD:
                first, scan = waiting.popleft()
                yield first, scan.result()
        for first, scan in waiting:
            yield first, scan.result()
    finally:
        pool.shutdown(cancel_futures=True)


MOVED = 0.05  # smallest reported motion [m]


def changes_between(
    before: Frame,
    after: Frame,
    revision: int,
    time_s: float,
    confirmed_s: Mapping[int, float],
) -> MapChanges:
    """Return the differences between two maps of the same scans.

    Args:
        before: Last scan in the old map.
        after: The same scan in the new map.
        revision: Revision of the parameters of the new map.
        time_s: Time of the scan [s since the first scan].
        confirmed_s: Time at which each tree of the new map was confirmed, by its number [s].
    """
    old, new = np.flatnonzero(before.trees.confirmed), np.flatnonzero(after.trees.confirmed)
    old_at, new_at = before.trees.position[old], after.trees.position[new]
    old_of = match(new_at, old_at, SAME)
    stayed = [(k, int(row)) for k, row in enumerate(old_of.tolist()) if row >= 0]
    gone = sorted(set(range(len(old))) - {row for _, row in stayed})
    changes = [
        *(_came(before, after.trees, int(new[k])) for k, row in enumerate(old_of.tolist()) if row < 0),
        *(_went(before.trees, int(old[row]), after) for row in gone),
        *(
            _moved(after.trees, int(new[k]), float(np.hypot(*(new_at[k] - old_at[row]))))
            for k, row in stayed
            if np.hypot(*(new_at[k] - old_at[row])) > MOVED
        ),
    ]
    dbh = before.trees.dbh[old]
    return MapChanges(
        revision=revision,
        scans=after.index + 1,
        time_s=time_s,
        before=len(old),
        after=len(new),
        ghost=[
            (round(float(x), 3), round(float(y), 3), round(float(d), 3) if np.isfinite(d) else None)
            for (x, y), d in zip(old_at, dbh, strict=True)
        ],
        changes=changes,
        confirmed=sorted(confirmed_s.items(), key=lambda item: (item[1], item[0])),
    )


def _came(before: Frame, trees: Trees, row: int) -> TreeChange:
    """Return the description of a tree that only the new map has.

    Args:
        before: Last scan in the old map.
        trees, row: Trees of the new map, and the row of the tree.
    """
    place = trees.position[row]
    return _change("appeared", trees, row, f"before: {_why_not(before, place)}")


def _went(trees: Trees, row: int, after: Frame) -> TreeChange:
    """Return the description of a tree that only the old map has.

    Args:
        trees, row: Trees of the old map, and the row of the tree.
        after: The same scan in the new map.
    """
    return _change("vanished", trees, row, f"now: {_why_not(after, trees.position[row])}")


def _moved(trees: Trees, row: int, distance: float) -> TreeChange:
    """Return the description of a tree of the new map that moved by a distance [m]."""
    return _change("moved", trees, row, f"by {100 * distance:.0f} cm")


def _change(kind: Literal["appeared", "vanished", "moved"], trees: Trees, row: int, why: str) -> TreeChange:
    """Return the description of a difference at the position of a tree.

    Args:
        kind: Kind of the difference.
        trees, row: Trees of a map, and the row of the tree.
        why: Reason, as text.
    """
    x, y = trees.position[row]
    return TreeChange(kind, int(trees.number[row]), round(float(x), 3), round(float(y), 3), why)


def _why_not(frame: Frame, place: Float) -> str:
    """Return the reason why a map has no tree at a place, as text: the class of the nearest column unless it
    is a tree, else the number of observations of the nearest tree, or that nothing was detected. Only what is
    within SAME counts. For a whole cloud it is the verdict of the nearest candidate.

    Args:
        frame: Last scan in that map.
        place: x, y in the map, shape (2,) [m].
    """
    if frame.columns is not None:
        near = _nearest(frame.columns.axis[:, :2], place)
        if near >= 0:
            reason = _column(frame.columns, near)
            if reason:
                return reason
    if frame.of_cloud:
        near = _nearest(frame.estimate.T_map_base.apply(frame.clusters.centre), place)
        if near >= 0:
            return f"the candidate there is {Verdict(int(frame.clusters.verdict[near])).label!r}"
    near = _nearest(frame.trees.position, place)
    if near < 0:
        return "no tree was detected there"
    seen = int(frame.trees.observations[near])
    return f"seen {seen} time{'s' * (seen != 1)}, which does not confirm it"


def _column(columns: Columns, row: int) -> str:
    """Return the verdict of a column as text; "" for a tree."""
    verdict = Verdict(int(columns.verdict[row]))
    if verdict is Verdict.TREE:
        return ""
    if verdict in (Verdict.TOO_FEW_POINTS, Verdict.MOVING):
        return f"the object there is classified as {verdict.label!r}"
    share = 100 * float(columns.share[row, 0])
    return f"the object there is classified as {verdict.label!r} ({share:.0f} % of the votes for a tree)"


def _nearest(places: Float, place: Float) -> int:
    """Return the row of the nearest of some positions, shape (K, 2), to a position, shape (2,); -1 if none is
    within SAME."""
    if not len(places):
        return -1
    distance = np.hypot(*(places - place).T)
    row = int(np.argmin(distance))
    return row if distance[row] <= SAME else -1
