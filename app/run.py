"""One opened source with its mapper: maps scan after scan, and goes back to any scan.

The picture of a scan depends on the source, the seed and the parameters that each scan up to it was
mapped with, and on nothing else: not on pauses, jumps, or which states happen to be kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from app.cursor import Cursor
from app.history import ParameterHistory, Snapshots
from app.live_cursor import LiveCursor
from app.stopwatch import Stopwatch
from app.story.history import TreeHistory
from pipeline.errors import SourceError, StemmapError
from pipeline.parameters import Parameters
from pipeline.records import Frame, Path, Step
from pipeline.sources.base import Source


class MapperLike(Protocol):
    """What a run needs of `pipeline.mapper.Mapper`; its state is opaque here."""

    parameters: Parameters

    def process(self, step: Step) -> Frame: ...
    def snapshot(self) -> Any: ...  # noqa: ANN401
    def restore(self, state: Any) -> None: ...  # noqa: ANN401
    @property
    def path(self) -> Path: ...


MakeMapper = Callable[[Source, Parameters, int, Stopwatch], MapperLike]


class Run:
    """A source, from its first scan to wherever it stands.

    Args:
        source: What is mapped; closed by `close`.
        mapper: Fresh, for this source.
        cursor: Reads the source's steps.
        parameters: In force from the first scan on.
        stopwatch: The one that the mapper measures with.
    """

    def __init__(
        self,
        source: Source,
        mapper: MapperLike,
        cursor: Cursor | LiveCursor,
        parameters: Parameters,
        stopwatch: Stopwatch,
    ) -> None:
        self.source = source
        self.stopwatch = stopwatch
        self.frame: Frame | None = None
        self.standing = -1
        self.history = TreeHistory()
        self._mapper = mapper
        self._cursor = cursor
        self._parameters = ParameterHistory(parameters)
        self._snapshots: Snapshots[Any] = Snapshots(mapper.snapshot())
        self._step: Step | None = None
        self._before: Any = None
        self._broken = False

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

    def map_next(self) -> Frame | None:
        """Map the next scan; None at the end of the run."""
        step = self._cursor.take()
        if step is None:
            return None
        self._before = self._mapper.snapshot()
        self._snapshots.offer(step.index, self._before)
        return self._map(step)

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
            self._mapper.parameters = wanted
        self._broken = True
        with self.stopwatch.whole_scan():
            self.frame = self._mapper.process(step)
        self._broken = False
        self._step, self.standing = step, step.index
        self.history.record(self.frame, self.start_ns)
        return self.frame

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
        self.source.close()
