"""Rerun of the trees: where other parameters act on the trees only, they are made again from the log of the
mapper, without SLAM and without columns; those of a single scan also later, when they are needed."""

from __future__ import annotations

import copy
from array import array
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from pipeline.config import Parameters
from pipeline.loop_closure.detection import search_loops
from pipeline.mapper import Mapper, MapperState
from pipeline.tracking import Tracker
from pipeline.tracking.track_table import TrackTable
from pipeline.tree_log import LoopSearch, TreeCorrection, TreeInput, TreeLog, TreesDifferError, are_same
from pipeline.types.records import Float, Int, Int32, Path, Trees

KEPT_EVERY = 50  # scans between two states of the trees that are kept, as between states of the mapper
MOST_STATES = 32  # then every second one is left out; a state has 320 bytes per tree


class TreeReplay:
    """Repeats what a tracker does in each scan, by the entries of a log.

    Args:
        tracker: Tracker before the first scan, with the new parameters.
        parameters: The new parameters.

    Attributes:
        done: Number of scans that are repeated.
        tracker: The tracker.
        verdict: Verdicts of the columns, int32, shape (C,).
    """

    def __init__(self, tracker: Tracker, parameters: Parameters) -> None:
        self.done = 0
        self.tracker, self.verdict = tracker, np.zeros(0, np.int32)
        self._classification = parameters.classification

    def copy(self) -> TreeReplay:
        """Return an independent copy."""
        other = copy.copy(self)
        other.tracker = self.tracker.copy()
        return other

    def observe(self, known: TreeInput) -> None:
        """Update the trees by the detections and columns of the next scan."""
        tracker, p = self.tracker, self._classification
        if known.seen is not None:
            tracker.process(known.stamp_ns, known.estimate, *known.seen)
        if known.columns is not None:
            if known.votes is None:
                tracker.classify_new(replace(known.columns, verdict=self.verdict))
            else:
                columns = replace(known.columns, verdict=known.votes.verdict(p.tree_share))
                self.verdict = tracker.classify(known.stamp_ns, columns, p).verdict
        self.done += 1

    def correct(self, corrections: tuple[TreeCorrection, ...], stamps_ns: Int) -> None:
        """Move the trees by the corrections after a scan. `stamps_ns` has the time of each scan up to it, and
        possibly of later ones [ns], shape (N,)."""
        for each in corrections:
            self.tracker.correct(each.correction, stamps_ns, each.estimate, each.landmarks, each.of_map)


class ScanTrees(NamedTuple):
    """Trees after a scan, and the verdicts of the columns, int32, shape (C,)."""

    trees: Trees
    verdict: Int32


class TreesByScan:
    """The trees after each scan of a rerun of the trees. At most MOST_STATES states are kept; the trees of a
    scan are made from the state before it when they are asked for."""

    def __init__(self) -> None:
        self._every = KEPT_EVERY
        self._states: list[TreeReplay] = []  # before every `_every`-th scan
        self._scans: list[TreeInput] = []
        self._last: TreeReplay | None = None

    def put(self, before: TreeReplay, known: TreeInput) -> None:
        """Add the next scan: the state before it, and its entry in the log."""
        if before.done % self._every == 0:
            if len(self._states) == MOST_STATES:
                self._every *= 2
                del self._states[1::2]
            if before.done % self._every == 0:
                self._states.append(before.copy())
        self._scans.append(known)

    def at(self, index: int) -> ScanTrees:
        """Return the trees after a scan."""
        start, last = self._states[index // self._every], self._last
        replay = last if last is not None and start.done <= last.done <= index + 1 else start.copy()
        while replay.done <= index:
            known = self._scans[replay.done]
            replay.observe(known)
            if known.corrections:
                stamps_ns = np.array([each.stamp_ns for each in self._scans[: replay.done]], np.int64)
                replay.correct(known.corrections, stamps_ns)
        self._last = replay
        return ScanTrees(replay.tracker.trees(), replay.verdict)


class TreeRerun:
    """Makes the trees of a run again by other parameters of the trees; poses, columns and terrain are those
    of the known map. The trees are those that a first run with the same parameters gives.

    Args:
        mapper: A mapper with the new parameters, before its first scan.
        log: Log of the known map, which may grow.

    Attributes:
        mapper: The mapper; until `finish`, only its trees change.
        by_scan: Trees of the scans that are done.
    """

    def __init__(self, mapper: Mapper, log: TreeLog) -> None:
        self.mapper, self.by_scan = mapper, TreesByScan()
        self._log, self._replay = log, TreeReplay(mapper.tracker, mapper.parameters)
        self._stamps, self._motion, self._path = array("q"), array("d"), array("d")
        self._kept: dict[int, _TreeState] = {}  # of the states that are kept for a lost robot, by their scans

    @property
    def done(self) -> int:
        """Number of scans whose trees are made."""
        return self._replay.done

    def map_next(self) -> tuple[int, Trees]:
        """Make the trees of the next scan; return its time [ns] and its trees.

        Raises:
            TreesDifferError: The scan is not known, or the trees close another loop, so that the whole run
                must be mapped again.
        """
        known, replay = self._log.at(self.done), self._replay
        if known.keeps_state:
            kept = (*self._kept.items(), (self.done, self._trees()))
            self._kept = dict(kept[-2:])
        self.by_scan.put(replay, known)
        replay.observe(known)
        pose, step = known.estimate.T_map_base, known.step
        self._stamps.append(known.stamp_ns)
        self._path.extend((pose.x, pose.y, pose.yaw))
        self._motion.extend((step.x, step.y, step.yaw))
        if known.search is not None:
            self._search_loops(known.search)
        if known.corrections:
            replay.correct(known.corrections, np.array(self._stamps))
            self._path = array("d", known.corrections[-1].correction.after.ravel())
        return known.stamp_ns, replay.tracker.trees()

    def with_trees(self) -> Callable[[MapperState], MapperState]:
        """Return a function of the state of the known mapper after the scans that are done. It returns the
        state with the present trees, also in the states that are kept for a lost robot."""
        return partial(_with_all_trees, self._trees(), self._kept)

    def finish(self, last: MapperState, path: Path, motion: Float) -> MapperState:
        """Restore in the mapper the last state of the known map with the new trees, and return it.

        Args:
            last: State of the known mapper after the scans that are done.
            path, motion: Path and motion of the known mapper, of at least these scans.

        Raises:
            TreesDifferError: It is not the state after these scans.
        """
        if last.path_length != self.done:
            raise TreesDifferError
        scans = slice(self.done)
        self.mapper.load(self.with_trees()(last), path.stamp_ns[scans], path.sigma_xy[scans], motion[scans])
        self.mapper.log = self._log.until(self.done)
        return self.mapper.snapshot()

    def _search_loops(self, known: LoopSearch) -> None:
        """Repeat a search of loops; TreesDifferError if it finds others."""
        run = known.history(
            stamp_ns=np.array(self._stamps), path=np.array(self._path).reshape(-1, 3),
            trees=self._replay.tracker.trees(), motion=np.array(self._motion).reshape(-1, 3),
        )  # fmt: skip
        found = search_loops(run, self.mapper.parameters.relocalisation, is_due=known.is_due)
        if not all(map(are_same, found, known.found)):
            raise TreesDifferError

    def _trees(self) -> _TreeState:
        """Return a copy of the present trees."""
        tracker = self._replay.tracker
        return _TreeState(tracker.tracks.copy(), tracker.next_number, self._replay.verdict)


class _TreeState(NamedTuple):
    """Tracks, number of the next new tree, and verdicts of the columns between two scans."""

    tracks: TrackTable
    next_number: int
    verdict: Int32


def _with_all_trees(trees: _TreeState, kept: Mapping[int, _TreeState], state: MapperState) -> MapperState:
    """Return a state with other trees, and with those in `kept` in the states that it keeps, by their
    scans."""
    states = tuple((index, _with_trees(each, kept[index])) for index, each in state.recovery.kept)
    return replace(_with_trees(state, trees), recovery=replace(state.recovery, kept=states))


def _with_trees(state: MapperState, trees: _TreeState) -> MapperState:
    """Return a state with other trees; the arrays are shared."""
    gathering = state.gathering
    columns = replace(gathering.columns, verdict=trees.verdict)
    return replace(
        state,
        tracks=trees.tracks,
        next_number=trees.next_number,
        gathering=replace(gathering, columns=columns),
    )
