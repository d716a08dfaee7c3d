"""Rerun: the scans of a run mapped again with other parameters, from the scan cache or from the source."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import dropwhile

from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan
from pipeline.mapper import Mapper, MapperState
from pipeline.remapping.scan_cache import ScanCache
from pipeline.types.records import Frame, Step

Reread = Callable[[], Iterator[Step]]
Segment = Callable[[Step], SegmentedScan]
AHEAD = 4  # scans that are segmented ahead of the mapping; more only take memory


class Rerun:
    """Maps the scans of a run in turn. The map is the same as that of a first run with the same parameters.

    Args:
        mapper: A fresh mapper with the new parameters.
        cache: Cache for scans that are segmented with these parameters; missing scans are added to it.
        reread: Returns the steps of the run from its first scan; None for a live run.

    Attributes:
        done: Number of scans that are mapped.
        was_read: Whether the source was read again.
    """

    def __init__(self, mapper: Mapper, cache: ScanCache, reread: Reread | None = None) -> None:
        self.mapper = mapper
        self.done = 0
        self.was_read = False
        self._cache, self._reread = cache, reread
        self._segmented: Iterator[tuple[Step, SegmentedScan]] | None = None

    def map_next(self) -> Frame:
        """Map the next scan. The frame has no points where the scan comes from the cache.

        Raises:
            StemmapError: The scan is not in the cache and cannot be read again.
        """
        step, scan = self._cache.read(self.done) or self._read_again(self.done)
        frame = self.mapper.process(step, scan)
        self.done += 1
        return frame

    def go_back(self, scans: int, state: MapperState) -> None:
        """Return to an earlier state of the mapper, which holds so many scans."""
        self.mapper.restore(state)
        self.done, self._segmented = scans, None

    def close(self) -> None:
        """Stop reading the source."""
        self._segmented = None

    def _read_again(self, index: int) -> tuple[Step, SegmentedScan]:
        if self._reread is None:
            raise StemmapError(
                "the scans of a live run cannot be read again, and these parameters need their points",
                remedy="Open the recording of the run",
            )
        if self._segmented is None:
            rest = dropwhile(lambda step: step.index < index, self._reread())
            self._segmented = segment_ahead(self.mapper.segmenter(), rest)
            self.was_read = True
        for step, scan in self._segmented:
            if step.index == index:
                self._cache.put(step, scan)
                return step, scan
        raise StemmapError(f"the source does not give scan {index} again", remedy="Open it again")


def segment_ahead(segment: Segment, steps: Iterator[Step]) -> Iterator[tuple[Step, SegmentedScan]]:
    """Each step with its segmented scan, in order. An error is raised in the turn of its scan.

    The caller reads the steps, so that the source is read by one thread only. Another thread segments up to
    `AHEAD` scans ahead; its kernels release the interpreter lock.
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


def segment_all(segment: Segment, steps: list[Step]) -> list[SegmentedScan]:
    """Some segmented scans; two threads work at them."""
    with ThreadPoolExecutor(2, thread_name_prefix="segment") as pool:
        return list(pool.map(segment, steps))
