"""Cursor over the steps of a run, which can return to any step that was read before.

Steps that were read are stored. Beyond the size of the store, a step is reached by reading the source from
its start, so stepping back never changes what is mapped.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import count, islice
from typing import TYPE_CHECKING

import numpy as np

from app.sources.request import ChosenOdometry
from pipeline.errors import SourceError
from pipeline.geometry.columns import GrowingColumns
from pipeline.io.block_file import BlockFile
from pipeline.io.checkpoints import record_bytes, record_of
from pipeline.io.readers.base import Source
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.odometry.synchroniser import Synchroniser
from pipeline.types.records import Step

if TYPE_CHECKING:
    from app.robot.source import LiveSource


class StepStore:
    """The last steps that were read from a source, in a temporary file. A scan of 30,000 points takes 0.3 MB.

    Args:
        most: Maximum size of the file [bytes].
    """

    def __init__(self, most: int) -> None:
        self._blocks = BlockFile(most, drops_oldest=True)

    @property
    def nbytes(self) -> int:
        """Size of the file [bytes]."""
        return self._blocks.nbytes

    def put(self, step: Step) -> None:
        """Store a step, unless one of its index is stored. Nothing is raised if the disk is full."""
        if step.index not in self._blocks:
            self._blocks.put_block(step.index, record_bytes(step))

    def read(self, index: int) -> Step | None:
        """Return the step with an index; None if it is not stored or damaged."""
        return self._blocks.read_block(index, lambda block: record_of(Step, block))

    def close(self) -> None:
        """Delete the file."""
        self._blocks.close()


_STAMP, _FINGERPRINT = 0, 1  # columns


class Cursor:
    """Position in the steps of a run, before the step that `take` returns next.

    Args:
        read: Returns the steps of the source from its start, numbered from 0. A live source yields None while
            no step has arrived.
        uri: Name of the source in errors.
        store: Stores the steps that were read; None for a live source, which cannot be read again.
    """

    def __init__(
        self, read: Callable[[], Iterator[Step | None]], uri: str, store: StepStore | None = None
    ) -> None:
        self._read, self._uri, self._store = read, uri, store
        self._taken = GrowingColumns(np.zeros(0, np.int64), np.zeros(0, np.int64))  # time, fingerprint
        self._next = 0
        self._ahead: Step | None = None
        self._failure: Exception | None = None
        self._steps = read()
        self._steps_next = 0  # index of the step that the iterator gives next

    @property
    def known(self) -> int:
        """Number of steps that were taken so far."""
        return len(self._taken)

    def stamp_ns(self, index: int) -> int:
        """Return the time [ns] of a step that was taken before; IndexError for an index of `known` or
        more."""
        return int(self._taken.column(_STAMP)[index])

    def index_at(self, stamp_ns: int) -> int | None:
        """Return the index of the last step not later than a time [ns], or 0 if all steps are later; None if
        the time is later than the last step that was taken, or none was taken."""
        stamps = self._taken.column(_STAMP)
        if not self.known or stamp_ns > stamps[-1]:
            return None
        return max(0, int(np.searchsorted(stamps, stamp_ns, side="right")) - 1)

    def peek(self) -> Step | None:
        """Return the next step without advancing; None at the end of the run, or before a live step arrived.
        A step that is read from the source is stored. After any error, every call raises it again until
        `go_to`.

        Raises:
            SourceError: Nothing more can be read, or the source gives other steps than before.
        """
        if self._failure is not None:  # a broken iterator would look like the end of the run
            raise self._failure
        if self._ahead is None:
            self._ahead = self.stored(self._next) or self._from_source()
        return self._ahead

    def take(self) -> Step | None:
        """Return the next step and advance; results and errors as `peek`. A step counts as
        `known` from the first time that it is taken."""
        step = self.peek()
        if step is None:
            return None
        self._ahead = None
        self._next += 1
        if step.index == self.known:
            self._taken.write(step.index, np.array([step.scan.stamp_ns]), np.array([_fingerprint(step)]))
        return step

    def go_to(self, index: int) -> None:
        """Move to the position before a step, at most `known`; nothing is read.

        Raises:
            SourceError: The run is live, and this is not the present position.
        """
        if self._store is None and index != self._next:
            raise SourceError("a live run cannot be read again", where=self._uri, remedy="Open its recording")
        self._ahead, self._failure, self._next = None, None, index

    def stored(self, index: int) -> Step | None:
        """Return a step that was read before; None if it is not stored, and for a live source."""
        return None if self._store is None else self._store.read(index)

    def again(self, index: int) -> Iterator[Step]:
        """Yield the steps from an index on up to the last one that was read: stored ones, and from the first
        that is not stored all others by reading the source from its start. These are neither stored nor
        compared with the steps read before. The position does not change.

        Raises:
            SourceError: The source cannot be read.
        """
        for number in count(index):
            if number >= self.known:  # who reads ahead would else read the source from its start
                return
            step = self.stored(number)
            if step is None:
                steps = islice(self._read(), number, self.known)
                yield from (step for step in steps if step is not None)
                return
            yield step

    def close(self) -> None:
        """Delete the stored steps; the source stays open."""
        if self._store is not None:
            self._store.close()

    def _from_source(self) -> Step | None:
        """Read the next step from the source and store it; results and errors as `peek`."""
        index = self._next
        try:
            if self._steps_next != index:
                self._steps, self._steps_next = islice(self._read(), index, None), index
            step = next(self._steps, None)
            if step is None:
                return None
            if index < self.known and _fingerprint(step) != self._taken.column(_FINGERPRINT)[index]:
                raise SourceError(
                    "the source does not give the same scans again", where=self._uri, remedy="Open it again"
                )
        except Exception as error:
            self._failure, self._steps_next = error, -1
            raise
        self._steps_next = index + 1
        if self._store is not None:
            self._store.put(step)
        return step


def _fingerprint(step: Step) -> int:
    """Return a hash of the time, number of points, odometry, roll, pitch and `turn` of a step. The points
    themselves are not included."""
    scan = step.scan
    return hash((scan.stamp_ns, scan.points.shape[0], step.T_odom_base, step.roll, step.pitch, step.turn))


def live_steps(
    source: LiveSource, chosen: ChosenOdometry, moving: Source, losses: Counter[str]
) -> Iterator[Step | None]:
    """Yield the steps of a live robot as they arrive, and None whenever no message is queued; never end. An
    unreadable message raises SourceError.

    Args:
        source: The robot.
        chosen: Selected source of the motion.
        moving: The source with the odometry that was selected, see `with_odometry`.
        losses: Dict from reasons to numbers of records that the synchroniser leaves out; increased in place.
    """
    override = moving if isinstance(moving, OdometryOverride) else None
    synchroniser = Synchroniser(use_odometry=chosen.steps != "static", losses=losses)
    while True:
        records = source.take()
        if not records:
            yield None
        for record in records:
            for joined in (record,) if override is None else override.pass_on(record):
                synchroniser.add(joined)
            yield from synchroniser.ready()
