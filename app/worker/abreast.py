"""Scans located on one core while those before them are mapped on another."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Condition

from pipeline.errors import StemmapError
from pipeline.front_end import Looked
from pipeline.mapper import Mapper
from pipeline.mapper_records import Located
from pipeline.types.records import Frame, Step

AHEAD = 3  # scans; more wait for nothing but memory


class _Progress:
    """Up to which scan all are mapped."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._waiting: deque[int] = deque()  # read and not mapped yet
        self._is_over = False

    def begin(self, scan: int) -> None:
        """A scan was read."""
        with self._changed:
            self._waiting.append(scan)

    def end(self) -> None:
        """The first of those that wait is mapped."""
        with self._changed:
            self._waiting.popleft()
            self._changed.notify_all()

    def stop(self) -> None:
        """No more are mapped: who waits need not."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def wait_for(self, scan: int) -> None:
        """Return once all before this scan are mapped."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_over or not self._waiting or self._waiting[0] >= scan)
            if self._is_over:
                raise StemmapError("the mapping was stopped")


def abreast(mapper: Mapper, scans: Iterator[tuple[Step, Looked]]) -> Iterator[Frame]:
    """The frames of scans, in their order; what reading, locating or mapping one of them raises is raised in
    its turn.

    The scans are read, and mapped, by who asks for the frames. The loops of both halves hold no interpreter
    lock.
    """
    progress, waiting = _Progress(), deque[Future[Located]]()
    closing = -1  # the last scan at whose end a loop is looked for

    def locate(step: Step, looked: Looked) -> Located:
        nonlocal closing
        if closing >= 0:
            progress.wait_for(closing + 1)
        located = mapper.locate(step, looked, lambda: progress.wait_for(step.index))
        closing = step.index if located.may_close else -1
        return located

    fault: StemmapError | None = None
    pool = ThreadPoolExecutor(1, thread_name_prefix="locate")
    try:
        while True:
            while fault is None and len(waiting) <= AHEAD:
                try:
                    shown = next(scans, None)
                except StemmapError as error:
                    fault = error
                    break
                if shown is None:
                    break
                progress.begin(shown[0].index)
                waiting.append(pool.submit(locate, *shown))
            if not waiting:
                break
            frame = mapper.map(waiting.popleft().result())
            progress.end()
            yield frame
        if fault is not None:
            raise fault
    finally:
        progress.stop()
        pool.shutdown(cancel_futures=True)
