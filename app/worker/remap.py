"""The map of a run with the results of its scans on disk, and remapping: the run is mapped again with other
parameters, a few scans at a time, while it is paused or plays; and the differences between the two maps, with
reasons."""

from __future__ import annotations

import copy
import math
from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from app.common.settings import RunBudget
from app.worker.course import READ_QUANTITIES, ScanCounts, ScanSeries, TreeHistory, read_quantities
from app.worker.protocol import (
    MapChanges,
    MessageCodec,
    Shown,
    TreeChange,
    WireError,
)
from app.worker.tree_numbers import SAME
from pipeline.config import Parameters
from pipeline.detection.free_space import BINS
from pipeline.evaluation import match
from pipeline.front_end import SegmentedScan
from pipeline.geometry.columns import GrowingColumns, columns_of, rows_in_common, rows_of
from pipeline.geometry.poses import Pose2
from pipeline.io.block_file import BlockFile
from pipeline.mapper import Mapper
from pipeline.remapping.preview import ClusterTable
from pipeline.remapping.rerun import Rerun, Segment
from pipeline.remapping.tree_rerun import TreeRerun, TreesByScan
from pipeline.seen_area import ViewSelection
from pipeline.tree_log import TreeLog, TreesDifferError, differ_in_trees_only
from pipeline.types.records import Columns, Float, Float32, Frame, Path, Step, Trees, Verdict
from pipeline.types.units import SECOND_NS


class StoredScan(msgspec.Struct, frozen=True):
    """The results of a scan.

    Attributes:
        shown: Frame of the scan without points and path, and without columns and ground if they are those of
            the scan before.
        columns_in, ground_in: Numbers of the scans whose stored frames have the columns and the ground of
            this scan; -1 for none.
        replaced: Earlier rows of the path that the correction at this scan replaced.
    """

    shown: Shown
    columns_in: int
    ground_in: int
    replaced: Path | None


class OtherTrees(NamedTuple):
    """Trees in place of those of stored frames.

    Attributes:
        by_scan: Trees of each scan.
        confirmed_s: Time of the first confirmation of each tree by its number [s since the first scan].
    """

    by_scan: TreesByScan
    confirmed_s: Mapping[int, float]

    def in_frame(self, frame: Frame, time_s: float) -> tuple[Frame, Float]:
        """Return the frame of a scan at a time [s since the first scan] with these trees, and the times of
        their confirmation up to this scan [s], shape (T,); NaN for trees that were not confirmed yet."""
        trees, verdict = self.by_scan.at(frame.index)
        columns = None if frame.columns is None else replace(frame.columns, verdict=verdict)
        confirmed_s = _times_of(trees, self.confirmed_s)
        confirmed_s[confirmed_s > time_s] = np.nan
        return replace(frame, trees=trees, columns=columns), confirmed_s


class FrameStore:
    """The last frames of one map without their points, each with the path and the confirmation times of its
    time. A scan takes 10 to 100 kB.

    In memory are the newest path and the position of each scan in the file. The rows of the path that a
    correction replaced are in the file.

    Args:
        most: Maximum size of the file [bytes].
    """

    def __init__(self, most: int) -> None:
        self._blocks = BlockFile(most, drops_oldest=True)
        self._codec: MessageCodec[StoredScan] = MessageCodec(StoredScan)
        self._scans = 0
        self._path: Path | None = None  # after the last scan
        self._corrections: list[tuple[int, int]] = []  # scan, first row of the path that it replaced
        # Columns and ground of the last scan, and the scans that have them.
        self._objects: tuple[object, object] = (None, None)
        self._objects_in = (-1, -1)
        self._read_last: dict[str, tuple[int, object]] = {}  # columns and ground, and the scan that has them
        self._other_trees: OtherTrees | None = None
        self._with_other_trees = 0  # first scans that have them

    def with_trees(self, scans: int, other: OtherTrees) -> FrameStore:
        """Return the frames of the first scans with other trees. The file is shared; what either stores or
        forgets from now on is not in the other one."""
        store = copy.copy(self)
        store._blocks, store._corrections = self._blocks.copy(), list(self._corrections)
        store._read_last = {}
        store._other_trees, store._with_other_trees = other, scans
        store.forget_from(scans)
        return store

    def put(self, frame: Frame, path: Path, time_s: float, confirmed_s: Float) -> None:
        """Store the results of the scan after the last stored one; any other scan is ignored, also one that
        is stored. A scan that is larger than LARGEST_MESSAGE counts as stored, but cannot be read. Once a
        scan cannot be written, because the disk is full, no later one is stored.

        Args:
            frame: Results of the scan; its points are not stored.
            path: Path up to this scan.
            time_s: Time of the scan since the first scan [s].
            confirmed_s: Confirmation time of each tree of the frame [s].
        """
        if frame.index != self._scans:
            return
        start = len(path.x) if self._path is None else rows_in_common(self._path, path)
        replaced = None
        if self._path is not None and start < len(self._path.x):
            replaced = rows_of(self._path, slice(start, None))
        objects = (frame.columns, frame.ground)
        columns_in, ground_in = (
            self._holder(value, last, last_in, frame.index)
            for value, last, last_in in zip(objects, self._objects, self._objects_in, strict=True)
        )
        no_points: Float32 = np.zeros((0, 3), np.float32)
        lean = replace(
            frame,
            raw=no_points,
            filtered=no_points,
            labels=frame.labels[:0],
            columns=frame.columns if columns_in == frame.index else None,
            ground=frame.ground if ground_in == frame.index else None,
        )
        shown = Shown(0, time_s, lean, 0, rows_of(path, slice(0, 0)), confirmed_s)
        scan = StoredScan(shown, columns_in, ground_in, replaced)
        try:
            if not self._blocks.put_block(frame.index, self._codec.body(scan)):
                return
        except WireError:  # larger than a message may be: left out, and the next one stores its own objects
            objects, columns_in, ground_in = (None, None), -1, -1
        if replaced is not None:
            self._corrections.append((frame.index, start))
        self._scans += 1
        self._path, self._objects, self._objects_in = path, objects, (columns_in, ground_in)

    def _holder(self, value: object, last: object, last_in: int, index: int) -> int:
        """Return the scan in which columns or ground of a scan are stored; -1 for none. What has not changed
        is stored again before the scan that has it is dropped."""
        if value is None:
            return -1
        return last_in if value is last and self._blocks.is_new(last_in) else index

    def read(self, index: int) -> Shown | None:
        """Return the results of a scan without points, with the path up to this scan and the run number 0;
        None if the results are not stored or are damaged."""
        shown = self._shown(index)
        path = None if shown is None else self._path_at(index)
        return None if shown is None or path is None else msgspec.structs.replace(shown, path=path)

    def _shown(self, index: int) -> Shown | None:
        """Return what `read` returns, without the path."""
        scan = self._read(index)
        if scan is None:
            return None
        objects: dict[str, Any] = {}
        for name, number in (("columns", scan.columns_in), ("ground", scan.ground_in)):
            if number == -1:
                continue
            if self._read_last.get(name, (-1,))[0] != number:
                holder = scan if number == index else self._read(number)
                if holder is None:
                    return None
                self._read_last[name] = number, getattr(holder.shown.frame, name)
            objects[name] = self._read_last[name][1]
        frame, confirmed_s = replace(scan.shown.frame, **objects), scan.shown.confirmed_s
        if self._other_trees is not None and index < self._with_other_trees:
            frame, confirmed_s = self._other_trees.in_frame(frame, scan.shown.time_s)
        return msgspec.structs.replace(scan.shown, frame=frame, confirmed_s=confirmed_s)

    @property
    def nbytes(self) -> int:
        """Size of the file [bytes]."""
        return self._blocks.nbytes

    def forget_from(self, index: int) -> None:
        """Remove the results of the scan with this index and of later ones."""
        if index < self._scans:
            self._path, self._objects = self._path_at(index - 1), (None, None)
            self._scans = index
        self._with_other_trees = min(self._with_other_trees, index)
        self._blocks.forget_from(index)
        self._read_last.clear()
        self._corrections = [(scan, row) for scan, row in self._corrections if scan < index]

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()

    def _path_at(self, index: int) -> Path | None:
        """Return the path as it was after a stored scan; None if a stored part cannot be read, or no scan is
        stored."""
        end = index + 1
        parts: list[Path] = []
        for scan, start in self._corrections:
            if scan > index and start < end:
                stored = self._read(scan)
                if stored is None or stored.replaced is None:
                    return None
                parts.append(rows_of(stored.replaced, slice(end - start)))
                end = start
        if self._path is None:
            return None
        parts.append(rows_of(self._path, slice(end)))
        return Path(*map(np.concatenate, zip(*map(columns_of, reversed(parts)), strict=True)))

    def _read(self, index: int) -> StoredScan | None:
        """Return what is stored of a scan; None if it is not stored."""
        return self._blocks.read_block(index, self._codec.decode)


NOT_OF_THE_MAP = {"evaluation", "obstacles"}  # stages that do not change the map


class RunMap:
    """A map of the scans of a run, with the states to which it can return, and what is known of each mapped
    scan. Its trees have the numbers of the mapper, see `TreeNumbers`.

    Args:
        mapper: A mapper before its first scan.
        parameters: Parameters from the first scan onwards.
        start_ns: Returns the time of the first scan [ns].
        budget: What it may keep.
        is_live: Whether the run cannot go back; then neither states nor frames are stored.

    Attributes:
        frames: The stored frames; None for a live run.
        before: State of the mapper before the current scan.
        snapshots: Earlier states of the mapper.
        history: Estimate of each tree over time.
        confirmed_s: Dict from the number of each tree to the time of its first confirmation [s since the
            first scan].
        clusters: Clusters of all scans.
        counts: Counts of all scans.
        course: Quantities of all scans, see `read_quantities`, with `time_s` [s since the first scan].
    """

    def __init__(
        self,
        mapper: Mapper,
        parameters: Parameters,
        start_ns: Callable[[], int],
        budget: RunBudget,
        *,
        is_live: bool = False,
    ) -> None:
        self.mapper = mapper
        self.frames = None if is_live else FrameStore(budget.results)
        mapper.log = None if is_live else TreeLog(budget.tree_log)
        self.parameters = ParameterHistory(parameters)
        self.before = mapper.snapshot()
        self.snapshots = Snapshots(self.before, 0 if is_live else _MOST_STATES)
        self.history, self.clusters, self.counts = TreeHistory(), ClusterTable(), ScanCounts()
        self.course = ScanSeries()
        self.confirmed_s: dict[int, float] = {}
        # Time, view and pose of the scans that `ViewSelection` takes.
        self._views = GrowingColumns(np.zeros(0, np.int64), np.zeros((0, 2, BINS)), np.zeros((0, 3)))
        self._view_selection, self._newest_ns = ViewSelection(), -1
        self._start_ns, self._time_s = start_ns, -math.inf

    def add(self, frame: Frame, view: Float, times: Mapping[str, float]) -> None:
        """Add the results of the scan that was mapped last. If the run went back, the entries of this scan
        replace earlier ones, and `history` and `clusters` lose those of later scans; stored frames and views
        stay. A tree keeps the time of its first confirmation, unless the run went back to or before it.

        Args:
            frame: The results.
            view: View of the scan, see `SegmentedScan.view`.
            times: Times of mapping the scan for `course`, see `stage_times`; empty if they are unknown.
        """
        time_s = self.add_trees(frame.index, frame.stamp_ns, frame.trees)
        self.clusters.record(frame)
        self.counts.record(frame)
        self.course.record(frame.index, {"time_s": time_s, **read_quantities(frame), **times})
        if self.frames is not None:
            self.frames.put(frame, self.mapper.path, time_s, self.confirmed(frame.trees))
        self._add_view(frame.stamp_ns, frame.estimate.T_map_base, view)

    def views(self, start: int = 0) -> list[tuple[int, Float]]:
        """Return time [ns] and view, see `SegmentedScan.view`, of the scans that `ViewSelection` takes for
        the observed area, in the order of their times, without the first `start` ones."""
        stamps, views, _ = (column[start:] for column in self._views.shared())
        return list(zip(stamps.tolist(), views, strict=True))

    def _add_view(self, stamp_ns: int, T_map_base: Pose2, view: Float) -> None:
        """Add the view of a scan if it is the newest one and selected."""
        if stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns
            if self._view_selection.take(T_map_base):
                pose = T_map_base.as_array()
                self._views.write(len(self._views), np.array([stamp_ns]), view[None], pose[None])

    def add_trees(self, index: int, stamp_ns: int, trees: Trees) -> float:
        """Add the trees of the scan that was mapped last, with its time [ns], as `add` does. Return the time
        since the first scan [s]."""
        start_ns = self._start_ns()
        self.history.record(index, stamp_ns, trees, start_ns)
        time_s = (stamp_ns - start_ns) / SECOND_NS
        if time_s <= self._time_s:
            self.confirmed_s = {number: at for number, at in self.confirmed_s.items() if at < time_s}
        self._time_s = time_s
        for number in trees.number[trees.confirmed].tolist():
            self.confirmed_s.setdefault(number, time_s)
        return time_s

    def take_results(self, known: RunMap, scans: int, by_scan: TreesByScan, confirmed: Float) -> None:
        """Take the results of the first scans of another map, which differs in the trees only; the trees are
        those of `add_trees`.

        Args:
            known: The other map; unchanged.
            scans: Number of scans.
            by_scan: Trees of each scan.
            confirmed: Number of confirmed trees after each scan, shape (scans,).
        """
        self.clusters, self.counts = known.clusters.until(scans), known.counts.until(scans)
        self.course = known.course.until(scans, ["time_s", *READ_QUANTITIES])
        self.course.replace("trees", confirmed)
        if self.frames is not None and known.frames is not None:
            self.frames.close()
            self.frames = known.frames.with_trees(scans, OtherTrees(by_scan, dict(self.confirmed_s)))
        newest_ns = int(self.mapper.path.stamp_ns[-1]) if scans else -1
        for (stamp_ns, view), pose in zip(known.views(), known._views.column(2).tolist(), strict=True):
            if stamp_ns <= newest_ns:
                self._add_view(stamp_ns, Pose2(*pose), view)
        self._newest_ns = newest_ns

    def confirmed(self, trees: Trees) -> Float:
        """Return the time at which each tree was first confirmed [s since the first scan], shape (T,); NaN
        for trees that never were."""
        return _times_of(trees, self.confirmed_s)

    def ended(self, trees: Trees) -> dict[int, tuple[float, float]]:
        """Return a dict from the number in this map of each tree that was ever confirmed and is not among
        `trees`, which have numbers of this map too, to its last position (x, y) [m]."""
        last = self.history.last_places()
        return {n: last[n] for n in self.confirmed_s.keys() - set(trees.number.tolist()) if n in last}

    def tree_rerun(self, mapper: Mapper) -> TreeRerun | None:
        """Return the rerun of the trees of this map by a new mapper; None if other parameters differ as well,
        or a scan is not known."""
        log = self.mapper.log
        alike = all(differ_in_trees_only(each, mapper.parameters) for each in self.parameters.sets)
        if not alike or log is None or not log.has_all(self.before.path_length):
            return None
        return TreeRerun(mapper, log)

    def use(self, parameters: Parameters, index: int) -> bool:
        """Use other parameters from the scan with an index onwards; no scan is mapped. Return whether any
        value changes. If so, the states after that scan are dropped, the frames and the course of this scan
        and of later ones, and the counts of later ones."""
        changes = self.parameters.set_from(index, parameters)
        if changes:
            self.snapshots.forget_after(index)
            self.course.forget_from(index)
            self.counts.forget_from(index + 1)  # those of this scan are known until it is mapped again
            if self.frames is not None:
                self.frames.forget_from(index)
        return changes

    def rewind_if_same(self, parameters: Parameters) -> bool:
        """Restore the state before the current scan and use these parameters from the current scan on. Return
        whether all earlier scans were mapped with the same values, except those of NOT_OF_THE_MAP. If the
        result is False, the mapper is not restored and the map must be discarded."""
        self.use(parameters, self.before.path_length)
        if not self.parameters.are_all(parameters, NOT_OF_THE_MAP):
            return False
        self.mapper.parameters = parameters
        self.mapper.restore(self.before)
        return True

    @property
    def file_bytes(self) -> int:
        """Size of the file of the frames [bytes]."""
        return 0 if self.frames is None else self.frames.nbytes

    @property
    def log_bytes(self) -> int:
        """Memory of what the trees are made of [bytes]."""
        return 0 if self.mapper.log is None else self.mapper.log.nbytes

    def close(self) -> None:
        """Delete the stored states and frames."""
        self.snapshots.close()
        if self.frames is not None:
            self.frames.close()


def _times_of(trees: Trees, times: Mapping[int, float]) -> Float:
    """Return the time of each tree by its number, shape (T,); NaN for numbers without time."""
    return np.array([times.get(number, np.nan) for number in trees.number.tolist()], dtype=np.float64)


class Remapping:
    """A run that is mapped again from its first scan.

    Args:
        rerun: The rerun, with the mapper of the new map.
        new_map: The new map, after the scans that the rerun has done.
        preview: Computes the preview in steps.
    """

    def __init__(self, rerun: Rerun, new_map: RunMap, preview: Generator[None, None, None]) -> None:
        self.rerun, self.map, self._preview = rerun, new_map, preview

    def map_next(self, until: int) -> bool:
        """Take the next step of the preview and return False; if the preview is complete, map the next scan
        and return whether exactly `until` scans are mapped. If more than `until` scans are mapped, because
        the run went back, the rerun first returns to the newest state with at most `until` scans.

        Raises:
            StemmapError: The scan cannot be read again.
        """
        for _ in self._preview:
            return False
        rerun, snapshots = self.rerun, self.map.snapshots
        if rerun.done > until:
            rerun.go_back(*snapshots.newest(until))
        if rerun.done < until:
            snapshots.expect(until)
            if snapshots.is_due(rerun.done):
                snapshots.offer(rerun.done, rerun.mapper.snapshot())
            self.map.add(rerun.map_next(), rerun.view, {})
        return rerun.done == until

    def finish(self) -> RunMap:
        """End the rerun and return the new map, whose `before` is then the state after the last scan that the
        rerun mapped."""
        self.map.before = self.rerun.finish()
        return self.map

    def close(self) -> None:
        """Leave the rerun, and delete what is stored of the new map."""
        self._preview.close()
        self.rerun.close()
        self.map.close()


class TreeRemapping:
    """A run whose trees are made again from its first scan. It is used like a `Remapping`.

    Args:
        rerun: The rerun, with the mapper of the new map.
        known: The present map.
        new_map: The new map, before its first scan.
        preview: Computes the preview in steps.
    """

    def __init__(
        self, rerun: TreeRerun, known: RunMap, new_map: RunMap, preview: Generator[None, None, None]
    ) -> None:
        self.rerun, self._known, self.map, self._preview = rerun, known, new_map, preview
        self._confirmed = array("d")  # number of confirmed trees after each scan

    def map_next(self, until: int) -> bool:
        """Take the next step of the preview and return False; if the preview is complete, make the trees of
        the next scan and return whether exactly those of `until` scans are made.

        Raises:
            TreesDifferError: The whole run must be mapped again.
        """
        for _ in self._preview:
            return False
        rerun, snapshots = self.rerun, self.map.snapshots
        if rerun.done > until:
            raise TreesDifferError
        if rerun.done < until:
            snapshots.expect(until)
            if snapshots.is_due(rerun.done):
                snapshots.share(rerun.done, self._known.snapshots, rerun.with_trees())
            index, (stamp_ns, trees) = rerun.done, rerun.map_next()
            self.map.add_trees(index, stamp_ns, trees)
            self._confirmed.append(float(np.count_nonzero(trees.confirmed)))
        return rerun.done == until

    def finish(self) -> RunMap:
        """End the rerun and return the new map, whose `before` is then the state after the last scan whose
        trees are made. Raises TreesDifferError if the run went elsewhere."""
        known, rerun = self._known, self.rerun
        self.map.before = rerun.finish(known.before, known.mapper.path, known.mapper.motion)
        self.map.take_results(known, rerun.done, rerun.by_scan, np.array(self._confirmed))
        return self.map

    def close(self) -> None:
        """Leave the rerun, and delete what is stored of the new map."""
        self._preview.close()
        self.map.close()


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
        """Return the differences between the map before the step and the new map. The map before the step is
        the `shown` frame of the first call of the step; a call with another scan replaces it by its own
        `shown`.

        Args:
            shown: The current scan with the present map.
            new: The same scan with the new map.
            revision: Revision of the parameters of the new map.
            time_s: Time of the scan [s since the first scan].
            confirmed_s: Dict from the number of each tree of the new map to its confirmation time [s since
                the first scan].
        """
        if self._before is None or self._before.index != new.index:  # the run went on, or elsewhere
            self._before = shown
        return changes_between(self._before, new, revision, time_s, confirmed_s)


S = TypeVar("S")

_SPACING = 50
_MOST_STATES = 20


class Snapshots(Generic[S]):
    """States of the mapper by the number of scans they contain (0: before the first scan), in temporary
    files, which two collections can share.

    Beyond the maximum number of states, every second one is dropped and the spacing doubles. The first state
    is in memory. A state that cannot be written is not stored.

    Args:
        start: State before the first scan.
        most: Maximum number of further states; 0 for a run that cannot go back.
    """

    def __init__(self, start: S, most: int = _MOST_STATES) -> None:
        self._start, self._most = start, most
        self._codec: MessageCodec[S] = MessageCodec(type(start))
        # The file of each state, and what changes the state that is read from it.
        self._files: dict[int, tuple[BlockFile, Callable[[S], S] | None]] = {}
        self._spacing = _SPACING

    def offer(self, scans: int, state: S) -> None:
        """Store a state if `is_due`, unless it is too large or the disk is full. If more than `most` states
        are stored, the spacing doubles and the states at other numbers of scans than its multiples are
        dropped.

        Args:
            scans: Number of scans that the state contains.
            state: The state.
        """
        if not self.is_due(scans):
            return
        file = BlockFile()
        self._files[scans] = file, None
        try:
            is_stored = file.put_block(0, self._codec.body(state))
        except WireError:  # it is too large
            is_stored = False
        if not is_stored:
            self._keep(lambda n: n != scans)
        self._thin_out()

    def share(self, scans: int, other: Snapshots[S], change: Callable[[S], S]) -> None:
        """Store the state of another collection with a change, if it is stored there; the file is shared, and
        `change` applies when the state is read, in place of a change there."""
        if scans in other._files and self.is_due(scans):
            self._files[scans] = other._files[scans][0], change
            self._thin_out()

    def expect(self, scans: int) -> None:
        """Set the spacing of a run with this number of scans, so that no state is stored that is dropped
        later; states at other numbers of scans are dropped. The spacing is never reduced."""
        before = self._spacing
        while 0 < self._most < (scans - 1) // self._spacing:
            self._spacing *= 2
        if self._spacing != before:
            self._keep(lambda n: n % self._spacing == 0)

    def _thin_out(self) -> None:
        """Double the spacing if there are too many states, and drop those at other numbers of scans."""
        if len(self._files) > self._most:
            self._spacing *= 2
            self._keep(lambda n: n % self._spacing == 0)

    def is_due(self, scans: int) -> bool:
        """Return whether `offer` would store a state with this number of scans: a multiple of the spacing
        that is not stored yet."""
        return self._most > 0 and scans > 0 and scans % self._spacing == 0 and scans not in self._files

    def newest(self, scans: int) -> tuple[int, S]:
        """Return the newest state with at most this number of scans (0 or more), as (number of scans, state).
        A stored state that cannot be read is skipped; 0 and the first state are left."""
        for n in sorted((n for n in self._files if n <= scans), reverse=True):
            state = self.at(n)
            if state is not None:
                return n, state
        return 0, self._start

    def at(self, scans: int) -> S | None:
        """Return the state with exactly this number of scans; None if it is not stored or cannot be read."""
        file, change = self._files.get(scans, (None, None))
        state = None if file is None else file.read_block(0, self._codec.decode)
        return state if state is None or change is None else change(state)

    def forget_after(self, scans: int) -> None:
        """Drop the states that contain more than this number of scans."""
        self._keep(lambda n: n <= scans)

    def close(self) -> None:
        """Delete the files."""
        self._keep(lambda _: False)

    def _keep(self, which: Callable[[int], bool]) -> None:
        """Drop the states for whose number of scans `which` is False. A file is closed when no collection has
        it any more."""
        for scans in [n for n in self._files if not which(n)]:
            del self._files[scans]


class ParameterHistory:
    """Parameters with which each scan of the run was mapped."""

    def __init__(self, parameters: Parameters) -> None:
        self._starts = [0]
        self._sets = [parameters]

    @property
    def sets(self) -> Sequence[Parameters]:
        """All sets, in the order of their scans."""
        return self._sets

    def at(self, index: int) -> Parameters:
        """Return the parameters with which the scan with this index (0 or more) was or will be mapped."""
        return self._sets[bisect_right(self._starts, index) - 1]

    def are_all(self, parameters: Parameters, aside: set[str]) -> bool:
        """Return whether the parameters of every scan, also of later ones, have these values.

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


def segment_ahead(
    segment: Segment, steps: Iterator[Step], threads: int = 1
) -> Iterator[tuple[Step, SegmentedScan]]:
    """Yield each step with its segmented scan, in order.

    The caller's thread reads the steps; other threads segment up to `AHEAD` scans ahead. An exception of
    `segment` is raised when its scan is due, one of `steps` when it is read. If the caller stops early, scans
    that are not begun are dropped.
    """
    waiting: deque[tuple[Step, Future[SegmentedScan]]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="segment")
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
    """Return the differences between the confirmed trees of two maps of the same scans. Trees are paired one
    to one within SAME, see `match`; a pair has moved if its positions differ by more than MOVED.

    `changes` has the trees that appeared, then those that vanished, then those that moved. `ghost` has the
    confirmed trees of the old map. `confirmed` is sorted by time, then by number. Positions and diameters are
    rounded to 1 mm.

    Args:
        before: Frame of the scan in the old map.
        after: Frame of the same scan in the new map.
        revision: Revision of the parameters of the new map.
        time_s: Time of the scan [s since the first scan].
        confirmed_s: Dict from the number of each tree of the new map to its confirmation time [s since the
            first scan].
    """
    old, new = np.flatnonzero(before.trees.confirmed), np.flatnonzero(after.trees.confirmed)
    old_at, new_at = before.trees.position[old], after.trees.position[new]
    old_of = match(new_at, old_at, SAME)
    changes: list[TreeChange] = []
    for k, row in enumerate(old_of.tolist()):
        moved = 0.0 if row < 0 else float(np.hypot(*(new_at[k] - old_at[row])))
        if row < 0:
            why = f"before: {_why_not(before, new_at[k])}"
            changes.append(_change("appeared", after.trees, int(new[k]), why))
        elif moved > MOVED:
            changes.append(_change("moved", after.trees, int(new[k]), f"by {100 * moved:.0f} cm"))
    for row in sorted(set(range(len(old))) - set(old_of.tolist())):
        why = f"now: {_why_not(after, old_at[row])}"
        changes.append(_change("vanished", before.trees, int(old[row]), why))
    changes.sort(key=lambda change: ("appeared", "vanished", "moved").index(change.kind))
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
    """Return the reason why a map has no confirmed tree at a position, as text: the class of the nearest
    column unless it is a tree; without a drive, the verdict of the nearest candidate; else the number of
    observations of the nearest tree, or that nothing was detected. Only columns, candidates and trees within
    SAME count.

    Args:
        frame: Frame of the last scan in the map.
        place: x, y in the map, shape (2,) [m].
    """
    if frame.columns is not None:
        near = _nearest(frame.columns.axis[:, :2], place)
        if near >= 0:
            reason = _column(frame.columns, near)
            if reason:
                return reason
    if not frame.of_drive:
        near = _nearest(frame.estimate.T_map_base.apply(frame.clusters.centre), place)
        if near >= 0:
            return f"the candidate there is {Verdict(int(frame.clusters.verdict[near])).label!r}"
    near = _nearest(frame.trees.position, place)
    if near < 0:
        return "no tree was detected there"
    seen = int(frame.trees.observations[near])
    return f"seen {seen} time{'s' * (seen != 1)}, which does not confirm it"


def _column(columns: Columns, row: int) -> str:
    """Return the verdict of a column as text, with the share of votes for a tree [%] unless the verdict is
    TOO_FEW_POINTS or MOVING; "" for a tree."""
    verdict = Verdict(int(columns.verdict[row]))
    if verdict is Verdict.TREE:
        return ""
    if verdict in (Verdict.TOO_FEW_POINTS, Verdict.MOVING):
        return f"the object there is classified as {verdict.label!r}"
    share = 100 * float(columns.share[row, 0])
    return f"the object there is classified as {verdict.label!r} ({share:.0f} % of the votes for a tree)"


def _nearest(places: Float, place: Float) -> int:
    """Return the row of `places`, positions x, y, shape (K, 2) [m], that is nearest to the position `place`,
    shape (2,) [m]; the first of equally near ones; -1 if none is within SAME."""
    if not len(places):
        return -1
    distance = np.hypot(*(places - place).T)
    row = int(np.argmin(distance))
    return row if distance[row] <= SAME else -1
