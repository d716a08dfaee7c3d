"""Scans segmented in other threads; the kernels release the interpreter lock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from pipeline.front_end import SegmentedScan
from pipeline.remapping.rerun import Segment
from pipeline.types.records import Step

AHEAD = 4  # scans that are segmented ahead of the mapping; more only take memory


def segment_ahead(segment: Segment, steps: Iterator[Step]) -> Iterator[tuple[Step, SegmentedScan]]:
    """Each step with its segmented scan, in order. An error is raised in the turn of its scan.

    The caller reads the steps, so that the source is read by one thread only. Another thread segments up to
    `AHEAD` scans ahead.
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
