"""Reads the steps of a source in order, and again from any scan that was read before.

Reading again starts a second before the scan, so that the synchroniser has what it needs; what it had
learnt until then is kept and given to it. That is checked: where the scan before it does not come out
exactly as the first time, all is read from the start. So going back never changes what is mapped; at
worst it is slow.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

from app.robot.source import LiveSource
from app.sources.opening import Chosen
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.odometry.synchroniser import Synchroniser
from pipeline.types.records import Learnt, Record, Step


class StepsFunction(Protocol):
    """Joins records to steps; see `pipeline.odometry.synchroniser.steps`."""

    def __call__(self, records: Iterator[Record], *, after: Learnt | None = None) -> Iterator[Step]: ...


_LEAD_IN_NS = 1_000_000_000


class Cursor:
    """Stands before a step of a source.

    Args:
        source: What is read. The cursor does not close it.
        synchronise: Joins records to steps; it is called anew for every place that is read from.
    """

    def __init__(self, source: Source, synchronise: StepsFunction) -> None:
        self._source = source
        self._synchronise = synchronise
        self._stamps = array("q")
        self._marks = array("q")
        self._learnt: list[Learnt] = []
        self._next = 0
        self._ahead: Step | None = None
        self._failure: Exception | None = None
        self._steps = self._read(None)

    @property
    def known(self) -> int:
        """How many steps from the start were read so far."""
        return len(self._stamps)

    def stamp_ns(self, index: int) -> int:
        """Time of a step that was read before."""
        return self._stamps[index]

    def index_at(self, stamp_ns: int) -> int | None:
        """The last step not later than a time (the first, if all are later); None when steps that
        were not read yet may be meant."""
        if not self._stamps or stamp_ns > self._stamps[-1]:
            return None
        return max(0, bisect_right(self._stamps, stamp_ns) - 1)

    def peek(self) -> Step | None:
        """The next step without taking it; None at the end of the run.

        Raises:
            SourceError: Nothing more can be read.
        """
        if self._failure is not None:  # a broken iterator would look like the end of the run
            raise self._failure
        if self._ahead is None:
            try:
                step = next(self._steps, None)
            except Exception as error:
                self._failure = error
                raise
            self._ahead = None if step is None else replace(step, index=self._next)
        return self._ahead

    def take(self) -> Step | None:
        """The next step; None at the end of the run.

        Raises:
            SourceError: Nothing more can be read.
        """
        step = self.peek()
        if step is None:
            return None
        self._ahead = None
        self._next += 1
        if step.index == len(self._stamps):
            self._stamps.append(step.scan.stamp_ns)
            self._marks.append(_mark(step))
            self._learnt.append(step.learnt)
        return step

    def go_to(self, index: int) -> None:
        """Stand before a step of at most `known`.

        Raises:
            SourceError: The source does not give the same steps again.
        """
        if index == self._next and self._failure is None:
            return
        self._ahead, self._failure, self._next = None, None, -1
        if index == 0:
            self._steps, self._next = self._read(None), 0
            return
        try:
            self._steps = self._resumed(index - 1) or self._recounted(index - 1)
        except Exception as error:
            self._failure = error
            raise
        self._next = index

    def _read(self, start_ns: int | None, after: Learnt | None = None) -> Iterator[Step]:
        return self._synchronise(self._source.records(start_ns), after=after)

    def _resumed(self, anchor: int) -> Iterator[Step] | None:
        """Steps after `anchor`, read from shortly before it; None when it comes out differently."""
        stamp_ns = self._stamps[anchor]
        # Scans of equal time cannot be told apart by it, so they are counted.
        wanted = anchor - bisect_left(self._stamps, stamp_ns)
        steps = self._read(stamp_ns - _LEAD_IN_NS, self._learnt[anchor])
        for step in steps:
            if step.scan.stamp_ns < stamp_ns:
                continue
            if step.scan.stamp_ns > stamp_ns:
                return None
            if wanted == 0:
                return steps if _mark(step) == self._marks[anchor] else None
            wanted -= 1
        return None

    def _recounted(self, anchor: int) -> Iterator[Step]:
        """Steps after `anchor`, read from the start."""
        steps = self._read(None)
        for index, step in enumerate(steps):
            if index == anchor and _mark(step) == self._marks[anchor]:
                return steps
            if index == anchor:
                break
        raise SourceError(
            "the source does not give the same scans again",
            where=self._source.description.uri,
            remedy="Open it anew",
        )


def _mark(step: Step) -> int:
    """A number that differs when what the mapper sees of the motion or the scan's size differs."""
    return hash(
        (
            step.scan.stamp_ns,
            step.scan.points.shape[0],
            step.T_odom_base,
            step.roll,
            step.pitch,
            step.tilt_known,
            step.turn,
            step.turn_rate,
        )
    )


class LiveCursor:
    """Stands before the next step, as `app.worker.cursor.Cursor` does; where that finds none, none came yet.

    Args:
        source: The robot. The cursor does not close it.
        chosen: What tells the motion.
        moving: The robot with that motion.
    """

    def __init__(self, source: LiveSource, chosen: Chosen, moving: Source) -> None:
        self._source = source
        self.losses = Counter[str]()
        self._moving = moving if isinstance(moving, OdometryOverride) else None
        self._synchroniser = Synchroniser(use_odometry=chosen.steps != "static", index=0, losses=self.losses)
        self._ready: deque[Step] = deque()
        self._stamps = array("q")

    @property
    def known(self) -> int:
        """How many steps were read so far."""
        return len(self._stamps)

    def stamp_ns(self, index: int) -> int:
        """Time of a step that was read before."""
        return self._stamps[index]

    def index_at(self, stamp_ns: int) -> None:
        """Nobody can go to a time of a live run."""
        del stamp_ns

    def peek(self) -> Step | None:
        """The next step without taking it; None when it has not come.

        Raises:
            SourceError: What comes cannot be read.
        """
        while not self._ready:
            records = self._source.take()
            if not records:
                return None
            for record in records:
                for told in (record,) if self._moving is None else self._moving.pass_on(record):
                    self._synchroniser.add(told)
                self._ready.extend(self._synchroniser.ready())
        return self._ready[0]

    def take(self) -> Step | None:
        """The next step; None when it has not come.

        Raises:
            SourceError: What comes cannot be read.
        """
        step = self.peek()
        if step is None:
            return None
        self._ready.popleft()
        self._stamps.append(step.scan.stamp_ns)
        return step

    def go_to(self, index: int) -> None:
        """Stand before the next step, which is where it stands.

        Raises:
            SourceError: Another is asked for.
        """
        if index != self.known:
            raise SourceError(
                "a live run cannot be read again",
                where=self._source.uri,
                remedy="Open its recording",
            )
