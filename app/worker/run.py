"""One opened source with its mapper: maps scan after scan, and goes back to any scan.

The picture of a scan depends on the source, the seed and the parameters that each scan up to it was
mapped with, and on nothing else: not on pauses, jumps, or which states happen to be kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from app.common.timers import Stopwatch
from app.explain.estimate_history import TreeHistory
from app.worker.cursor import Cursor
from app.worker.live_cursor import LiveCursor
from app.worker.map_cache import Left, LeftBehind, basis_of
from app.worker.parallel import looked_ahead, looked_at_once
from app.worker.remap import Remapping, Told
from app.worker.snapshots import ParameterHistory, Snapshots
from pipeline.config import Parameters
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.base import Source
from pipeline.mapper import Mapper
from pipeline.remapping import (
    Basis,
    Journal,
    KeptScans,
    Reread,
    Rerun,
    Sample,
    look_key,
    rough_trees,
)
from pipeline.types.records import Float, Frame, Path, Step, Trees

_NO_PART_OF_THE_MAP = {"evaluation", "obstacles"}  # stages
_NS = 1_000_000_000


class MapperLike(Protocol):
    """What a run needs of `pipeline.mapper.Mapper`; its state is opaque here."""

    parameters: Parameters

    def process(self, step: Step) -> Frame: ...
    def snapshot(self) -> Any: ...  # noqa: ANN401
    def restore(self, state: Any) -> None: ...  # noqa: ANN401
    @property
    def path(self) -> Path: ...


MakeMapper = Callable[[Source, Parameters, int, Stopwatch], MapperLike]
Remake = Callable[[Parameters], MapperLike]


class Run:
    """A source, from its first scan to wherever it stands.

    Args:
        source: What is mapped; closed by `close`.
        mapper: Fresh, for this source.
        cursor: Reads the source's steps.
        parameters: In force from the first scan on.
        stopwatch: The one that the mapper measures with.
        odometry: Where the motion comes from, in words.
        remake: Makes a fresh mapper for this source, so that the run can be mapped again.
        reread: The steps from the first scan on; None where they come only once.
        kept: What is kept of the scans, of this run or an earlier opening of its source.

    Attributes:
        is_bare: Whether the picture of the standing scan lacks its points, see `map_next`.
    """

    def __init__(
        self,
        source: Source,
        mapper: MapperLike,
        cursor: Cursor | LiveCursor,
        parameters: Parameters,
        stopwatch: Stopwatch,
        odometry: str = "",
        remake: Remake | None = None,
        reread: Reread | None = None,
        kept: KeptScans | None = None,
    ) -> None:
        self.source = source
        self.odometry = odometry
        self.stopwatch = stopwatch
        self.frame: Frame | None = None
        self.standing = -1
        self._told = Told()
        self._mapper = mapper
        self._cursor = cursor
        self._parameters = ParameterHistory(parameters)
        self._snapshots: Snapshots[Any] = Snapshots(mapper.snapshot())
        self._step: Step | None = None
        self._before: Any = None
        self._broken = False
        self._remake, self._reread = remake, reread
        self._kept = KeptScans() if kept is None else kept
        self.is_bare = self._hurried = False
        self._key = look_key(parameters)
        self._remapping: Remapping | None = None
        self._left = LeftBehind()
        self._returning: tuple[Left, Parameters] | None = None
        self._journal, self._sample = Journal(), Sample()
        self._rough: Trees | None = None
        if isinstance(mapper, Mapper):
            mapper.note = lambda noted: self._journal.note(noted, mapper.parameters.slam)

    @property
    def history(self) -> TreeHistory:
        """What each scan made of the trees."""
        return self._told.history

    def confirmed_s(self, trees: Trees) -> Float:
        """When each of the trees was first confirmed [s since the first scan], NaN where it was not: (T,)."""
        known = self._told.confirmed_s
        return np.array([known.get(number, np.nan) for number in trees.number.tolist()], dtype=np.float64)

    @property
    def start_ns(self) -> int:
        """Time of the run's first scan; 0 before anything is known of it."""
        known = self.source.description.start_ns
        if known is not None:
            return known
        return self._cursor.stamp_ns(0) if self._cursor.known else 0

    @property
    def path(self) -> Path:
        """Where the robot was, up to the standing scan."""
        return self._mapper.path

    def peek_ns(self) -> int | None:
        """Time of the next scan, None at the end."""
        step = self._cursor.peek()
        return None if step is None else step.scan.stamp_ns

    def map_next(self, *, hurried: bool = False) -> Frame | None:
        """Map the next scan; None at the end of the run. Who is in a hurry takes what is kept of it, and gets
        a picture without points."""
        step = self._cursor.take()
        if step is None:
            return None
        self._left.forget(self._kept)
        self._before = self._mapper.snapshot()
        self._snapshots.offer(step.index, self._before)
        self._hurried = hurried
        frame = self._map(step)
        self._hurried = False
        return frame

    def map_again(self) -> Frame | None:
        """Map the standing scan once more, from the state before it; None if there is none."""
        if self._step is None or self._broken:
            return None
        self._mapper.restore(self._before)
        return self._map(self._step)

    def map_with(self, sets: Sequence[Parameters]) -> list[Frame]:
        """The standing scan as it comes out under each of other parameters; the run stays as it is.

        Raises:
            StemmapError: There is no scan to map, or a set cannot be mapped with.
        """
        if self._step is None or self._broken:
            raise StemmapError("no scan stands here", remedy="Play, pause and ask again")
        present, frames = self._mapper.parameters, []
        self._broken = True
        with self.stopwatch.aside():
            try:
                for parameters in sets:
                    self._mapper.restore(self._before)
                    self._mapper.parameters = parameters
                    frames.append(self._mapper.process(self._step))
            finally:
                # Mapped once more, because a mapper goes back along its past and not forward again.
                self._mapper.restore(self._before)
                self._mapper.parameters = present
                self._mapper.process(self._step)
                self._broken = False
        return frames

    def _map(self, step: Step) -> Frame:
        wanted = self._parameters.at(step.index)
        if self._mapper.parameters is not wanted:
            self._mapper.parameters, self._key = wanted, look_key(wanted)
        self._broken = True
        with self.stopwatch.whole_scan():
            self.frame = self._process(step)
        self._broken = False
        self._step, self.standing = step, step.index
        self._sample.offer(step)
        self._told.record(self.frame, self.start_ns)
        return self.frame

    def _process(self, step: Step) -> Frame:
        mapper = self._mapper
        if not isinstance(mapper, Mapper):
            return mapper.process(step)
        looked = self._kept.looked(step, self._key) if self._hurried else None
        self.is_bare = looked is not None
        looked = looked or mapper.segment(step)
        self._kept.put(step, looked, self._key)
        return mapper.process(step, looked)

    def remap(self, parameters: Parameters) -> None:
        """Begin to map the run again from its first scan; what was begun before is given up. Nothing is begun
        where it would give the same map."""
        self.stay()
        if self._parameters.were_always(parameters, _NO_PART_OF_THE_MAP):
            return
        left = self._left.find(parameters, _NO_PART_OF_THE_MAP)
        if left is not None:
            self._returning = (left, parameters)
        else:
            self._begin(parameters)

    def _begin(self, parameters: Parameters) -> None:
        mapper = self._remake(parameters) if self._remake else None
        if not isinstance(mapper, Mapper):
            return
        basis = self._basis()
        self._rough = None if basis is None else self._roughly(basis, parameters, mapper)
        rerun = Rerun(mapper, self._kept, self._reread, basis, looked_ahead)
        if basis is None or not rerun.passed:
            self._remapping = Remapping(rerun, self.start_ns)
            return
        time_s = (self._cursor.stamp_ns(rerun.passed) - self.start_ns) / _NS
        told = self._told.before(rerun.passed, time_s)
        self._remapping = Remapping(rerun, self.start_ns, told, self._snapshots.first(rerun.passed))

    def _roughly(self, basis: Basis, parameters: Parameters, mapper: Mapper) -> Trees | None:
        sample = None
        if self._reread is not None and not basis.shows_as(parameters):
            sample = self._sample.looked(mapper.segmenter(), len(basis.notes), looked_at_once)
        return rough_trees(basis, self._kept.clusters, parameters, sample)

    def _basis(self) -> Basis | None:
        """What the scans so far were mapped to with one set of parameters."""
        if not isinstance(self._mapper, Mapper) or self._broken:
            return None
        return basis_of(
            self._parameters, self.standing, self._mapper, self._before, self._snapshots, self._journal
        )

    def stay(self) -> None:
        """Give up what `remap` began; the map stays as it is."""
        self._returning = None
        if self._remapping is not None:
            self._remapping.rerun.close()
            self._remapping = None

    @property
    def remapped(self) -> float | None:
        """How much of the run is mapped again, up to the standing scan; None when nothing is."""
        r = self._remapping
        if self._returning is not None and self.is_whole:
            return 1.0
        if r is None or not self.is_whole:
            return None
        return min(r.rerun.done / max(self.standing, 1), 1.0)

    @property
    def rough(self) -> Trees | None:
        """Where trees will be, roughly, once the run is mapped again; None where nobody knows."""
        return None if self._remapping is None else self._rough

    @property
    def not_kept(self) -> str:
        """Why the run cannot, or could not, be mapped again from what is kept; empty where it can."""
        return "; ".join(filter(None, (self._kept.refusal, self._kept.told)))

    def remap_on(self, scans: int) -> tuple[Frame, dict[int, float]] | None:
        """Map again so many scans more. When all are, the run goes on with that map as if its parameters had
        been in force from the start: gives the standing scan, and when each tree was confirmed [s].

        Raises:
            StemmapError: A scan cannot be looked at again. The map stays as it is.
        """
        remapping = self._remapping
        if self._step is None or self._broken:  # on the way to another scan
            return None
        if self._returning is not None:
            return self._returned(*self._returning)
        if remapping is None:
            return None
        try:
            with self.stopwatch.aside():
                there = remapping.work(scans, self.standing)
        except BaseException:  # a fault in the mapper too: who tries again and again would never stop
            self.stay()
            raise
        if not there:
            return None
        self._remapping = None
        new = Left.of(remapping, self.standing)
        return self._take_over(new, new.parameters)

    def _returned(self, left: Left, parameters: Parameters) -> tuple[Frame, dict[int, float]] | None:
        """The map that was left behind, if it still is of the standing scan; else that is mapped again."""
        self._returning = None
        if left not in self._left:
            self._begin(parameters)
            return None
        left.mapper.restore(left.before)
        return self._take_over(left, parameters)

    def _take_over(self, new: Left, parameters: Parameters) -> tuple[Frame, dict[int, float]]:
        """Go on with another map of the scans before the standing one, and leave the present one behind."""
        assert self._step is not None  # noqa: S101 - who asks has looked
        old = self._present()
        self._mapper, self._snapshots, self._before = new.mapper, new.snapshots, new.before
        self._told, self._journal = new.told, new.journal
        kept, self._kept = self._kept, new.kept
        self._left.take(new, self._kept)
        if old is not None:
            self._left.add(old, self._kept)
        self._left.close_unused(kept, self._kept)
        self._parameters = ParameterHistory(parameters)
        self._key = look_key(parameters)
        return self._map(self._step), self._told.confirmed_s

    def _present(self) -> Left | None:
        """The map of the scans before the standing one; None where they were mapped with several sets."""
        mapper, scans = self._mapper, self.standing
        if not isinstance(mapper, Mapper) or not 0 < scans <= self._parameters.until(scans):
            return None
        return Left(
            self._parameters.at(0), scans, mapper, self._before, self._snapshots, self._told, self._journal,
            self._kept,
        )  # fmt: skip

    def parameters_at(self, index: int) -> Parameters:
        """What a scan was or will be mapped with."""
        return self._parameters.at(index)

    def prepare(self) -> None:
        """Map the first scan and forget it again: what is compiled at its first use is ready then.

        Raises:
            SourceError: There is no scan, or it cannot be read.
        """
        step = self._cursor.peek()
        if step is None:
            uri = self.source.description.uri
            raise SourceError("there is no scan in it", where=uri, remedy="Choose another source")
        before = self._mapper.snapshot()
        self._mapper.parameters = self._parameters.at(step.index)  # those of other methods compile other code
        self._mapper.process(step)
        self._mapper.restore(before)
        self.stopwatch.clear()

    def index_at(self, stamp_ns: int) -> int | None:
        """The scan shown at a time; None when it was not read yet."""
        return self._cursor.index_at(stamp_ns)

    def stamp_ns(self, index: int) -> int:
        """Time of a scan that was read before."""
        return self._cursor.stamp_ns(index)

    @property
    def known(self) -> int:
        """How many scans were read so far."""
        return self._cursor.known

    @property
    def is_whole(self) -> bool:
        """Whether the mapper is where `standing` says, and can map that scan again."""
        return self._step is not None and not self._broken

    def approach(self, index: int) -> None:
        """Stand so that mapping on leads to a scan by the shortest way; `standing` is before it
        afterwards. `index` is at most one more than what was reached before, or is ahead."""
        scans, state = self._snapshots.newest(min(index, self._cursor.known))
        if not self._broken and self.standing < index and scans <= self.standing + 1:
            return
        self._left.forget(self._kept)
        self._broken = True  # until all of it has worked
        self._cursor.go_to(scans)
        self._mapper.restore(state)
        self.standing, self._step, self._broken = scans - 1, None, False

    def use(self, parameters: Parameters, index: int) -> bool:
        """From a scan on, map with other parameters. Returns whether that changes anything."""
        changes = self._parameters.set_from(index, parameters)
        if changes:
            self._snapshots.forget_after(index)
        return changes

    def close(self) -> None:
        """Let go of the source."""
        self.stay()
        self._left.forget(self._kept)
        self._kept.close()
        self.source.close()
