"""Cursor over the steps of a source, which can return to any step that was read before.

Steps that were read are stored. To return to one that is not, the cursor reads from one second before the
scan and restores the state that the synchroniser had there. If the preceding scan differs from the first
reading, everything is read from the start. Stepping back therefore never changes what is mapped; in the worst
case it is slow.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

from app.robot.source import LiveSource
from app.sources.request import ChosenOdometry
from app.worker.frame_store import StepStore
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.odometry.synchroniser import OdometryChoice, Synchroniser, steps
from pipeline.types.records import Step, SynchroniserState

_LEAD_IN_NS = 1_000_000_000


class Cursor:
    """Position before a step of a source.

    Args:
        source: Source that is read; the cursor does not close it.
        odometry: Choice of the odometry.
        store: Stores the steps that were read; None reads them again.
    """

    def __init__(
        self, source: Source, odometry: OdometryChoice = "auto", store: StepStore | None = None
    ) -> None:
        self._source, self._store = source, store
        self._odometry: OdometryChoice = odometry
        self._stamps = array("q")
        self._fingerprints = array("q")
        self._states: list[SynchroniserState] = []
        self._next = 0
        self._ahead: Step | None = None
        self._failure: Exception | None = None
        self._steps = self._read(None)
        self._steps_next: int | None = 0  # index of the step that the source gives next; None if unknown

    @property
    def known(self) -> int:
        """Number of steps that were read so far."""
        return len(self._stamps)

    def stamp_ns(self, index: int) -> int:
        """Return the time of a step that was read before [ns]; IndexError for other steps."""
        return self._stamps[index]

    def index_at(self, stamp_ns: int) -> int | None:
        """Return the index of the last step not later than a time [ns], or 0 if all steps are later; None if
        the time may belong to a step that was not read yet."""
        if not self._stamps or stamp_ns > self._stamps[-1]:
            return None
        return max(0, bisect_right(self._stamps, stamp_ns) - 1)

    def peek(self) -> Step | None:
        """Return the next step without advancing; None at the end of the run. After an error, every call
        raises it again until `go_to`.

        Raises:
            SourceError: Nothing more can be read.
        """
        if self._failure is not None:  # a broken iterator would look like the end of the run
            raise self._failure
        if self._ahead is None:
            self._ahead = self.stored(self._next) or self._from_source()
        return self._ahead

    def stored(self, index: int) -> Step | None:
        """Return a step that was read before; None if it is not stored."""
        return None if self._store is None else self._store.read(index)

    def _from_source(self) -> Step | None:
        """Read the next step from the source and store it; None at the end of the run.

        Raises:
            SourceError: Nothing more can be read.
        """
        try:
            if self._steps_next != self._next:
                self._seek_source(self._next)
            step = next(self._steps, None)
        except Exception as error:
            self._failure, self._steps_next = error, None
            raise
        if step is None:
            return None
        step = replace(step, index=self._next)
        self._steps_next = self._next + 1
        if self._store is not None:
            self._store.put(step)
        return step

    def take(self) -> Step | None:
        """Return the next step and advance; None at the end of the run.

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
            self._fingerprints.append(_fingerprint(step))
            self._states.append(step.synchroniser_state)
        return step

    def go_to(self, index: int) -> None:
        """Move to the position before a step. Nothing is read from the source if that is the present
        position, or if the step is stored.

        Args:
            index: Index of the step, at most `known`.

        Raises:
            SourceError: The source does not return the same steps again; `peek` then raises the same error.
        """
        if index == self._next and self._failure is None:
            return
        self._ahead, self._failure, self._next = None, None, index
        if index != self._steps_next and (self._store is None or self._store.read(index) is None):
            try:
                self._seek_source(index)
            except Exception as error:
                self._failure, self._next, self._steps_next = error, -1, None
                raise

    def close(self) -> None:
        """Delete the stored steps."""
        if self._store is not None:
            self._store.close()

    def _seek_source(self, index: int) -> None:
        """Read the source up to a step, at most the first one that was not read before.

        Raises:
            SourceError: The source does not return the same steps again.
        """
        self._steps_next = None
        if index == 0:
            self._steps = self._read(None)
        else:
            self._steps = self._resumed(index - 1) or self._recounted(index - 1)
        self._steps_next = index

    def _read(self, start_ns: int | None, after: SynchroniserState | None = None) -> Iterator[Step]:
        """Return an iterator of the steps from the source.

        Args:
            start_ns: Time from which the source is read [ns]; None from its start.
            after: State of the synchroniser before that time; None for the start.
        """
        return steps(self._source.records(start_ns), odometry=self._odometry, after=after)

    def _resumed(self, index: int) -> Iterator[Step] | None:
        """Return an iterator of the steps after step `index`, read from one second before it; None if the
        step differs from the one that was read first."""
        stamp_ns = self._stamps[index]
        # Scans of equal time are distinguished by counting.
        wanted = index - bisect_left(self._stamps, stamp_ns)
        read = self._read(stamp_ns - _LEAD_IN_NS, self._states[index])
        for step in read:
            if step.scan.stamp_ns < stamp_ns:
                continue
            if step.scan.stamp_ns > stamp_ns:
                return None
            if wanted == 0:
                return read if _fingerprint(step) == self._fingerprints[index] else None
            wanted -= 1
        return None

    def _recounted(self, index: int) -> Iterator[Step]:
        """Return an iterator of the steps after step `index`, read from the start.

        Raises:
            SourceError: That step differs from the one that was read first.
        """
        read = self._read(None)
        step = next(islice(read, index, None), None)
        if step is not None and _fingerprint(step) == self._fingerprints[index]:
            return read
        raise SourceError(
            "the source does not give the same scans again",
            where=self._source.description.uri,
            remedy="Open it again",
        )


def _fingerprint(step: Step) -> int:
    """Return a hash of time, number of points and motion of a step, by which a step that is read again is
    recognised."""
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
    """Position before the next step of a live robot, with the interface of `Cursor`.

    Args:
        source: The robot; the cursor does not close it.
        chosen: Selected source of the motion.
        moving: The source with that motion, see `with_odometry`.
    """

    def __init__(self, source: LiveSource, chosen: ChosenOdometry, moving: Source) -> None:
        self._source = source
        self.losses = Counter[str]()
        self._moving = moving if isinstance(moving, OdometryOverride) else None
        self._synchroniser = Synchroniser(use_odometry=chosen.steps != "static", index=0, losses=self.losses)
        self._ready: deque[Step] = deque()
        self._stamps = array("q")

    @property
    def known(self) -> int:
        """Number of steps that were read so far."""
        return len(self._stamps)

    def stamp_ns(self, index: int) -> int:
        """Return the time of a step that was read before [ns]."""
        return self._stamps[index]

    def index_at(self, stamp_ns: int) -> None:
        """Return None, because a live run cannot seek."""
        del stamp_ns

    def peek(self) -> Step | None:
        """Return the next step without advancing; None if it has not arrived.

        Raises:
            SourceError: A message cannot be read.
        """
        while not self._ready:
            records = self._source.take()
            if not records:
                return None
            for record in records:
                for joined in (record,) if self._moving is None else self._moving.pass_on(record):
                    self._synchroniser.add(joined)
                self._ready.extend(self._synchroniser.ready())
        return self._ready[0]

    def take(self) -> Step | None:
        """Return the next step and advance; None if it has not arrived.

        Raises:
            SourceError: A message cannot be read.
        """
        step = self.peek()
        if step is None:
            return None
        self._ready.popleft()
        self._stamps.append(step.scan.stamp_ns)
        return step

    def stored(self, index: int) -> None:
        """Return None, because the steps of a live run are not stored."""
        del index

    def close(self) -> None:
        """Do nothing."""

    def go_to(self, index: int) -> None:
        """Check that `index` is the current position, because a live run cannot go back.

        Raises:
            SourceError: It is another position.
        """
        if index != self.known:
            raise SourceError(
                "a live run cannot be read again",
                where=self._source.uri,
                remedy="Open its recording",
            )
