"""Scans looked at on another core while those before them are mapped, or on two cores at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from pipeline.front_end import SegmentedScan
from pipeline.types.records import Step

AHEAD = 4  # scans; more wait for nothing but memory


def looked_ahead(
    look: Callable[[Step], SegmentedScan], steps: Iterator[Step]
) -> Iterator[tuple[Step, SegmentedScan]]:
    """Each step with what it shows, in their order; what one of them raises is raised in its turn.

    The steps are read by who asks, so that nobody reads the source from two threads; the loops that look at
    them hold no interpreter lock.
    """
    waiting: deque[tuple[Step, Future[SegmentedScan]]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="look")
    try:
        for step in steps:
            waiting.append((step, pool.submit(look, step)))
            if len(waiting) > AHEAD:
                first, looked = waiting.popleft()
                yield first, looked.result()
        for first, looked in waiting:
            yield first, looked.result()
    finally:
        pool.shutdown(cancel_futures=True)


def looked_at_once(look: Callable[[Step], SegmentedScan], steps: list[Step]) -> list[SegmentedScan]:
    """What all of some steps show, looked at on two cores."""
    with ThreadPoolExecutor(2, thread_name_prefix="look") as pool:
        return list(pool.map(look, steps))
