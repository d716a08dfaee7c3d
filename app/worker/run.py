"""One opened source with its mapper: maps scan after scan, and returns to any scan.

The result of a scan depends only on the source, the seed and the parameters with which each scan up to it was
mapped. It does not depend on pauses, jumps, or which states of the mapper are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from app.batch.summary import driven_steps
from app.common.settings import RunBudget, RunStorage
from app.common.timers import TOTAL, Stopwatch
from app.explain.records import History
from app.robot.source import LiveSource
from app.sources.request import SourceRequest, with_odometry
from app.worker.course import QUANTITIES, STAGE, stage_times
from app.worker.cursor import Cursor, StepStore, live_steps
from app.worker.protocol import RunCounts, RunCourse, Shown, UInt8
from app.worker.remap import (
    NOT_OF_THE_MAP,
    Remapping,
    RunMap,
    TreeRemapping,
    segment_ahead,
)
from app.worker.tree_numbers import TreeNumbers
from app.worker.unmapped import unmapped_frame
from pipeline.classification.voxel_map import VoxelMap
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.config.stages import Acquisition
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.front_end import SegmentedScan, StageTimer
from pipeline.geometry.columns import GrowingColumns, evenly_spaced
from pipeline.io.readers.base import Source, SourceDescription
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquired_rows
from pipeline.remapping.preview import KnownMap, needs_sample, preview_trees, sample_scans
from pipeline.remapping.rerun import Rerun, ScanCaches
from pipeline.slam.keyframe_graph import KeyframeGraph
from pipeline.tree_log import TreesDifferError
from pipeline.types.records import Float, Float32, Frame, Path, Step, Trees

#: Returns a mapper of a source for parameters and a seed, see `mapper_of`.
MakeMapper = Callable[[SourceDescription, Parameters, int, StageTimer], Mapper]


class Run:
    """A source, mapped from its first scan to the current one.

    Args:
        source: The source; `close` closes it. A robot cannot be read again, and its frames are not stored.
        request: How the source is mapped; its preset and parameters are not used.
        parameters: Parameters from the first scan onwards.
        make_mapper: Returns a new mapper.

    Attributes:
        frame: Result of the current scan; None before the first.
        graph: Graph of keyframes after the current scan.
        tree_landmarks: Birth number of the landmark of each tree of `frame`, int64, shape (T,); -1 for none.
        confirmed_s: Time of the first confirmation of each tree of `frame`, shape (T,) [s since the first
            scan], NaN for trees that were never confirmed; None before the first scan.
        current: Index of the current scan; -1 before the first.
        is_bare: Whether the frame has no points, see `map_next`.
        odometry: Description of the source of motion.
        warnings: Warnings about the odometry and the source, to which those of a robot are added.

    Raises:
        SourceError: The odometry is not available for this source.
        StemmapError: The random forest of the parameters does not exist.
    """

    def __init__(
        self,
        source: Source | LiveSource,
        request: SourceRequest,
        parameters: Parameters,
        make_mapper: MakeMapper,
        budget: RunBudget,
    ) -> None:
        moving, chosen = with_odometry(source, request.odometry)
        live, left_out = source if isinstance(source, LiveSource) else None, Counter[str]()

        def read() -> Iterator[Step | None]:
            if live is not None:
                return live_steps(live, chosen, moving, left_out)
            left_out.clear()  # the source is read from its start
            return steps(moving.records(), odometry=chosen.steps, losses=left_out)

        self.source, self.odometry = moving, chosen.words
        self.warnings = [*([chosen.warning] if chosen.warning else []), *source.description.warnings]
        self._left_out, self._is_live = left_out, live is not None
        self.stopwatch = Stopwatch()
        self.frame: Frame | None = None
        self.confirmed_s: Float | None = None
        self.graph, self.tree_landmarks = KeyframeGraph(), np.zeros(0, np.int64)
        self.current = -1
        self.has_intensity: bool | None = None
        self.is_bare = False

        def mapper(values: Parameters) -> Mapper:
            return make_mapper(moving.description, values, request.seed, self.stopwatch)

        self._make_mapper, self._budget = mapper, budget
        self._map = self._new_map(self._make_mapper(parameters))
        self._steps = None if self._is_live else StepStore(budget.scans)
        self._cursor = Cursor(read, source.description.uri, self._steps)
        self._step: Step | None = None
        self._broken = False
        self._caches = ScanCaches(budget.segmented)
        self._cache = self._caches.of(parameters)
        self._numbers = TreeNumbers()
        self._views_sent = 0
        self._odometry_xy = GrowingColumns(np.zeros((0, 2)))  # x, y of each scan
        self._remapping: Remapping | TreeRemapping | None = None
        self._previous: RunMap | None = None  # the map before the last change of parameters, for undo

    def _new_map(self, mapper: Mapper) -> RunMap:
        """Return an empty map of a mapper before its first scan."""
        return RunMap(mapper, mapper.parameters, lambda: self.start_ns, self._budget, is_live=self._is_live)

    def history(self, number: int, scan: int) -> History:
        """Return the estimates of the tree `number` up to the scan `scan`, see `TreeHistory.of`; empty for an
        unknown number."""
        in_map = self._numbers.in_map(number)
        return self._map.history.of(-1 if in_map is None else in_map, scan)

    def counts(self, index: int) -> RunCounts:
        """Return the counts of the map up to a scan that was mapped. Only `losses` is not limited to that
        scan: it has all that was left out so far while the source was read."""
        return self._map.counts.totals(index, self.warnings, self.losses)

    @property
    def reflectance(self) -> UInt8 | None:
        """Reflectance of the raw points of the current scan, see `reflectance_of`."""
        if self.frame is None or self._step is None:
            return None
        return reflectance_of(self.frame.raw, self._step, self._map.mapper.parameters.acquisition)

    @property
    def losses(self) -> dict[str, int]:
        """New dict from a reason to the number of records that were left out for it so far."""
        return dict(Counter(self._left_out) + Counter(self.source.losses))

    @property
    def odometry_xy(self) -> Float:
        """Positions x, y of the robot by odometry alone, of all mapped scans, shape (N, 2) [m]. Not a
        copy."""
        return self._odometry_xy.shared()[0]

    def course(self, names: Sequence[str], most: int, *, stages: bool) -> RunCourse:
        """Return the course of the map, see `AskCourse` for the arguments; quantities without a value in any
        scan, and names that are not in QUANTITIES, are NaN."""
        series, path = self._map.course, self.path
        scans = series.scans("time_s")
        scans = np.append(scans[:-1][evenly_spaced(len(scans) - 1, most - 1)], scans[-1:])
        values = {name: series.values(name, scans) for name in names}
        if "driven" in values:
            driven = np.append(0.0, np.cumsum(driven_steps(path)))
            values["driven"] = np.append(driven[: len(path.x)], np.nan)[np.minimum(scans, len(path.x))]
        total = series.values("mapping", scans)
        measured = [name for name in series.names if stages and name.startswith(STAGE)]
        of_stages = {name.removeprefix(STAGE): series.values(name, scans) for name in measured}
        for spent in of_stages.values():
            spent[np.isnan(spent) & np.isfinite(total)] = 0.0
        known = [name for name in QUANTITIES if name == "driven" or name in series.names]
        return RunCourse(scans, series.values("time_s", scans), values, of_stages, known)

    @property
    def start_ns(self) -> int:
        """Time of the first scan of the run [ns]; 0 before it is known."""
        known = self.source.description.start_ns
        if known is not None:
            return known
        return self._cursor.stamp_ns(0) if self._cursor.known else 0

    @property
    def path(self) -> Path:
        """The path up to the current scan; it has no rows before the first."""
        return self._map.mapper.path

    @property
    def accumulated(self) -> Float32:
        """Points of all scans up to the current one: x, y in the map and height above the ground [m], shape
        (N, 3); none without the column classifier. Not a copy."""
        return self.voxels.mean[: self.voxels.used]

    @property
    def voxels(self) -> VoxelMap:
        """The voxels of all scans up to the current one; empty without the column classifier. Not a copy."""
        return self._map.mapper.voxels

    def peek_ns(self) -> int | None:
        """Return the time of the next scan [ns]; None at the end of the run, or before a live scan arrived.
        Raises SourceError if nothing more can be read."""
        step = self._cursor.peek()
        return None if step is None else step.scan.stamp_ns

    def map_next(self, *, hurried: bool = False) -> Frame | None:
        """Map the next scan, which becomes the current one, and return its result; None at the end of the
        run, or before a live scan arrived.

        Args:
            hurried: Whether to use the cached segmented scan if there is one. The frame then has no points
                (`is_bare`).

        Raises:
            SourceError: Nothing more can be read.
            StemmapError: The scan cannot be mapped, for example because a forest does not exist; the mapper
                is broken until `approach`.
        """
        if self.current < 0 and self._cursor.known and not self._is_live:
            self._cursor.go_to(0)  # scans were shown before the first one was mapped
        step = self._cursor.take()
        if step is None:
            return None
        self._map.before = self._map.mapper.snapshot()
        self._map.snapshots.offer(step.index, self._map.before)
        return self._map_step(step, hurried=hurried)

    def map_again(self) -> Frame | None:
        """Map the current scan again, from the state before it and with the parameters in force for it, and
        return its result; None if there is no scan, or after an error or a step back that is not complete.

        Raises:
            StemmapError: The scan cannot be mapped; the mapper is broken until `approach`.
        """
        if self._step is None or self._broken:
            return None
        self._map.mapper.restore(self._map.before)
        return self._map_step(self._step)

    def map_with(self, sets: Sequence[Parameters]) -> list[Frame]:
        """Return the current scan mapped with each set of parameters. The run does not change.

        Raises:
            StemmapError: There is no scan, or a set cannot be used.
        """
        if self._step is None or self._broken:
            raise StemmapError("no scan is mapped yet", remedy="Play, pause and ask again")
        mapper, before = self._map.mapper, self._map.before
        present, frames = mapper.parameters, []
        self._broken = True
        with self.stopwatch.aside():
            try:
                for parameters in sets:
                    mapper.restore(before)
                    mapper.parameters = parameters
                    frames.append(mapper.process(self._step))
            finally:
                # The scan is mapped once more, because a mapper returns to its past only.
                mapper.restore(before)
                mapper.parameters = present
                mapper.process(self._step)
                self._broken = False
        return frames

    def _map_step(self, step: Step, *, hurried: bool = False, new_map: bool = False) -> Frame:
        """Map a step with the parameters in force for it, make it the current scan, and return its frame with
        the numbers of `TreeNumbers`. After an exception, which passes through, the mapper is broken until
        `approach`.

        Args:
            step: The step.
            hurried: Whether to use the cached segmented scan if there is one.
            new_map: Whether the map of the run was replaced since the last step.
        """
        mapper, wanted = self._map.mapper, self._map.parameters.at(step.index)
        if mapper.parameters is not wanted:
            mapper.parameters, self._cache = wanted, self._caches.of(wanted)
        self._broken = True
        with self.stopwatch.whole_scan() as times:
            frame, view = self._process(mapper, step, hurried=hurried)
        spent = {} if self.is_bare or TOTAL not in times else stage_times(times)
        if step.index == len(self._odometry_xy):
            place = frame.T_odom_base.x, frame.T_odom_base.y
            self._odometry_xy.write(step.index, np.array([place]))
        self._broken = False
        if new_map:
            self._numbers.begin_map(frame.trees, self._map.ended(frame.trees))
        self.frame = replace(frame, trees=self._numbers.renumber(frame.trees))
        self._step, self.current = step, step.index
        self.has_intensity = bool(self.has_intensity) or step.scan.reflectance is not None
        self.graph, self.tree_landmarks = mapper.graph, mapper.tree_landmarks
        self._map.add(frame, view, spent)
        self.confirmed_s = self._map.confirmed(frame.trees)
        return self.frame

    def kept(self, index: int) -> Shown | None:
        """Return the results of a scan that was mapped, without mapping it again; its points are segmented
        again. Trees that were never numbered are left out, see `TreeNumbers.stored`. None if the results or
        the step are not stored. The run does not change. Raises StemmapError if the random forest of the
        scan does not exist any more."""
        shown = None if self._map.frames is None else self._map.frames.read(index)
        step = None if shown is None else self._cursor.stored(index)
        if shown is None or step is None:
            return None
        mapper, wanted = self._map.mapper, self._map.parameters.at(index)
        if mapper.parameters != wanted:
            mapper = self._make_mapper(wanted)
        with self.stopwatch.aside():
            scan = mapper.segment(step)
        trees, rows = self._numbers.stored(shown.frame.trees)
        frame = replace(shown.frame, raw=scan.raw, filtered=scan.filtered, labels=scan.labels, trees=trees)
        confirmed_s = None if shown.confirmed_s is None else shown.confirmed_s[rows]
        reflectance = reflectance_of(frame.raw, step, wanted.acquisition)
        return msgspec.structs.replace(shown, frame=frame, confirmed_s=confirmed_s, reflectance=reflectance)

    def _process(self, mapper: Mapper, step: Step, *, hurried: bool) -> tuple[Frame, Float]:
        """Return the result of a step and the view of its scan, and cache the segmented scan.

        Args:
            mapper: The mapper.
            step: The step.
            hurried: Whether to use the cached segmented scan if there is one.
        """
        cached = self._cache.read(step.index, step.scan.stamp_ns) if hurried else None
        self.is_bare = cached is not None
        scan = mapper.segment(step) if cached is None else cached[1]
        self._cache.put(step, scan)
        return mapper.process(step, scan), scan.view

    def take_views(self) -> list[tuple[int, Float]]:
        """Return the `RunMap.views` of the present map that were not returned before."""
        taken = self._map.views(self._views_sent)
        self._views_sent += len(taken)
        return taken

    def remap(self, parameters: Parameters, on_preview: Callable[[Trees], None]) -> None:
        """Begin to map the run again from its first scan, in place of a rerun that is not complete. The map
        before the last change is continued from its last scan if it has these parameters, as after an undo.
        Nothing begins if the map would not change. `remap_next` does the work.

        Args:
            parameters: Parameters of all scans.
            on_preview: Called with approximate trees of the new map before a scan is mapped again, unless
                they are unknown or an earlier map is continued.

        Raises:
            StemmapError: The random forest of the parameters does not exist, or a live run would need the
                points of earlier scans.
        """
        self.cancel_remapping()
        if self._map.parameters.are_all(parameters, NOT_OF_THE_MAP):
            return
        self._caches.of(self._map.mapper.parameters)  # in use: the caches not used for longest are closed
        previous, self._previous = self._previous, None
        if previous is not None and previous.rewind_if_same(parameters):
            self._remapping = self._whole_remapping(previous, done=previous.before.path_length)
            return
        if previous is not None:
            previous.close()
        mapper = self._make_mapper(parameters)
        new_map = self._new_map(mapper)
        preview = self._preview_steps(parameters, mapper, on_preview)
        tree_rerun = self._map.tree_rerun(mapper)
        if tree_rerun is not None:
            self._remapping = TreeRemapping(tree_rerun, self._map, new_map, preview)
        else:
            self._remapping = self._whole_remapping(new_map, preview)

    def _whole_remapping(
        self, new_map: RunMap, preview: Generator[None, None, None] | None = None, *, done: int = 0
    ) -> Remapping:
        """Return a rerun of the scans that a map has not `done` yet, after its preview if there is one. If it
        could not be completed, the map is closed and StemmapError raised."""
        mapper, no_preview = new_map.mapper, (None for _ in ())
        reread, cache = None if self._is_live else self._cursor.again, self._caches.of(mapper.parameters)
        rerun = Rerun(mapper, cache, reread, segment_ahead, done=done)
        try:
            rerun.require(self.current + 1)
        except StemmapError:
            new_map.close()
            raise
        return Remapping(rerun, new_map, preview or no_preview)

    def _preview_steps(
        self, parameters: Parameters, mapper: Mapper, on_preview: Callable[[Trees], None]
    ) -> Generator[None, None, None]:
        """Segment the scans of the sample that the preview needs, one in each step, then call `on_preview`,
        unless there is no preview. Scans that are not stored are missing in the sample.

        Args:
            parameters, on_preview: As in `remap`.
            mapper: A mapper with these parameters.
        """
        if self.frame is None or self._step is None:
            return
        sample: dict[int, SegmentedScan] = {}
        if needs_sample(self._known_map(self.frame), parameters):
            numbers = sample_scans(self.current + 1, self._step.scan.points.nbytes)
            stored = (step for n in numbers if (step := self._cursor.stored(n)))
            for step, scan in segment_ahead(mapper.segmenter(), stored, threads=2):
                sample[step.index] = scan
                yield
        trees = preview_trees(self._known_map(self.frame), parameters, sample)
        if trees is not None:
            on_preview(trees)

    def _known_map(self, frame: Frame) -> KnownMap:
        """Return what a preview knows of the map up to the current scan, whose frame is given; its parameters
        are those of the first scan."""
        return KnownMap(self._map.parameters.at(0), self._map.clusters, self.path, frame.columns)

    def cancel_remapping(self) -> None:
        """Cancel the rerun that `remap` began; the map does not change."""
        if self._remapping is not None:
            self._remapping.close()
            self._remapping = None

    @property
    def remapped(self) -> float | None:
        """Share of the scans before the current one that are mapped again, from 0 to 1; None if there is no
        rerun, or if the mapper does not have the state after the current scan."""
        remapping = self._remapping
        if remapping is None or not self.is_whole:
            return None
        return min(remapping.rerun.done / max(self.current, 1), 1.0)

    @property
    def cache_notice(self) -> str:
        """Reason why scans are not cached, or cached scans are not used; empty if they are."""
        cache = self._cache
        first = f"scan {cache.refused} and possibly later scans are not cached: {cache.refusal}"
        return "; ".join(filter(None, (cache.refusal and first, cache.notice)))

    def remap_next(self) -> tuple[Frame, dict[int, float]] | None:
        """Take the next step of the preview; without one, map the next scan of the rerun. After the last scan
        the run continues with the new map, as if its parameters had been in force from the start.

        Returns:
            The frame of the current scan in the new map, and a dict from the number of each tree to the time
            of its first confirmation [s since the first scan]; None while scans are left, without a rerun,
            and if the mapper does not have the state after the current scan.

        Raises:
            StemmapError: A scan cannot be read again. The map does not change.
        """
        remapping = self._remapping
        if remapping is None or self._step is None or self._broken:  # or on the way to another scan
            return None
        try:
            with self.stopwatch.aside():
                finished = remapping.map_next(self.current)
                new_map = remapping.finish() if finished else None
        except TreesDifferError:  # the whole run must be mapped again, and its preview is known
            self.cancel_remapping()
            new_map = self._new_map(self._make_mapper(remapping.rerun.mapper.parameters))
            self._remapping = self._whole_remapping(new_map)
            return None
        except BaseException:  # also a fault of the mapper, which another try would repeat
            self.cancel_remapping()
            raise
        if new_map is None:
            return None
        self._previous = self._map
        self._remapping, self._map, self._views_sent = None, new_map, 0
        self._cache = self._caches.of(self._map.parameters.at(self.current))
        frame = self._map_step(self._step, new_map=True)
        confirmed_s = {self._numbers.known(n): at for n, at in self._map.confirmed_s.items()}
        return frame, {number: at for number, at in confirmed_s.items() if number is not None}

    def parameters_at(self, index: int) -> Parameters:
        """Return the parameters with which the scan with this index (0 or more) was or will be mapped."""
        return self._map.parameters.at(index)

    def next_unmapped(self, *, segmented: bool) -> Frame | None:
        """Return the next scan of a run that is not mapped yet, see `unmapped_frame`; the next call returns
        the scan after it. None for a live run and at the end of the run. `prepare` returns to the first scan.

        Args:
            segmented: Whether the frame has clusters, for which the front end must be compiled.

        Raises:
            SourceError: Nothing more can be read.
            StemmapError: The scan cannot be segmented.
        """
        step = None if self._is_live else self._cursor.take()
        if step is None:
            return None
        mapper = self._map.mapper
        mapper.parameters = self._map.parameters.at(step.index)
        with self.stopwatch.aside():
            scan = mapper.segment(step) if segmented else None
        return unmapped_frame(step, self.source.description.T_base_lidar, scan)

    def prepare(self) -> None:
        """Map the next scan, the first of a new run, with its parameters, and discard the result and the
        measured times, so that all kernels are compiled.

        Raises:
            SourceError: There is no scan, or it cannot be read.
            StemmapError: The scan cannot be mapped.
        """
        if self._cursor.known:  # scans were shown meanwhile, see `next_unmapped`
            self._cursor.go_to(0)
        step = self._cursor.peek()
        if step is None:
            uri = self.source.description.uri
            raise SourceError("there is no scan in it", where=uri, remedy="Choose another source")
        mapper = self._map.mapper
        before = mapper.snapshot()
        mapper.parameters = self._map.parameters.at(step.index)  # other methods compile other code
        mapper.process(step)
        mapper.restore(before)
        self.stopwatch.clear()

    def index_at(self, stamp_ns: int) -> int | None:
        """Return the index of the scan at a time [ns], see `Cursor.index_at`; None if it was not read yet."""
        return self._cursor.index_at(stamp_ns)

    def stamp_ns(self, index: int) -> int:
        """Return the time of a scan that was read before [ns]; IndexError for another one."""
        return self._cursor.stamp_ns(index)

    @property
    def known(self) -> int:
        """Number of scans that were read so far."""
        return self._cursor.known

    @property
    def is_whole(self) -> bool:
        """Whether the mapper has the state after the current scan and can map that scan again."""
        return self._step is not None and not self._broken

    def approach(self, index: int) -> None:
        """Restore the state from which the fewest scans must be mapped to reach a scan. Afterwards `current`
        is less than `index`.

        Args:
            index: Index of the scan; if it was not read yet, the scans from the last one that was read
                onwards are mapped.

        Raises:
            SourceError: The run is live, and the state is not the present one.
        """
        scans, state = self._map.snapshots.newest(min(index, self._cursor.known))
        if not self._broken and self.current < index and scans <= self.current + 1:
            return
        self._broken = True  # until all of it has worked
        self._cursor.go_to(scans)
        self._map.mapper.restore(state)
        self.current, self._step, self._broken = scans - 1, None, False

    @property
    def storage(self) -> RunStorage:
        """What the run keeps at present."""
        maps = [known for known in (self._map, self._previous) if known is not None]
        scans = 0 if self._steps is None else self._steps.nbytes
        return RunStorage(
            scans + self._caches.nbytes + sum(known.file_bytes for known in maps),
            sum(known.log_bytes for known in maps),
            self._budget.files,
            self._budget.memory,
        )

    def use(self, parameters: Parameters, index: int) -> bool:
        """Use other parameters from the scan with an index onwards; return whether any value changes. No scan
        is mapped."""
        return self._map.use(parameters, index)

    def close(self) -> None:
        """Cancel a rerun, close the source and the scan caches, and delete the stored frames and steps."""
        self.cancel_remapping()
        self._map.close()
        if self._previous is not None:
            self._previous.close()
        self._caches.close()
        self._cursor.close()
        self.source.close()


def recorded_parameters(description: SourceDescription) -> tuple[tuple[int, Parameters], ...]:
    """Return the parameter sets with which a recorded live run was mapped, each with the index of its first
    scan, ascending.

    A set replaces those recorded before it that begin at its first scan or later; one with which the whole
    run was mapped again replaces all. The result is empty if no parameters were recorded, or if any of them
    is not valid in this version of stemmap.
    """
    sets: list[tuple[int, Parameters]] = []
    try:
        for each in description.revisions:
            values = validated(each.values)
            sets = [known for known in sets if known[0] < each.from_scan]
            sets.append((each.from_scan, values))
    except ParameterError:
        return ()
    return tuple(sets)


def reflectance_of(raw: Float32, step: Step, parameters: Acquisition) -> UInt8 | None:
    """Return the reflectance of the raw points of a frame, uint8, shape (N,): 0 and 255 are the percentiles 1
    and 99 of the scan. None if the scan has none, and for a frame without points."""
    if step.scan.reflectance is None or not len(raw):
        return None
    found = step.scan.reflectance[acquired_rows(step, parameters)]
    if len(found) != len(raw):
        return None  # the parameters have changed since the frame was mapped
    # Of 2000 points: the percentiles are exact to about 1 % of the points, and no scan takes longer for them.
    sample = np.nan_to_num(found[evenly_spaced(len(found), 2000)], posinf=0.0, neginf=0.0)
    low, high = np.percentile(sample, (1.0, 99.0)).tolist()
    within = np.fmin(np.fmax(found, low), high)  # NaN is low
    shades: UInt8 = ((within - low) * (255.0 / max(high - low, 1e-9))).astype(np.uint8)
    return shades
