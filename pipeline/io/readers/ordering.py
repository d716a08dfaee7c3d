"""Records in the order of their own time, although they were written in the order of arrival."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from pipeline.io.readers.container import count_loss

T = TypeVar("T")

#: How much later than its neighbours a record may have been written and still find its place.
WINDOW_NS = 1_000_000_000
_HELD_LIMIT = 20_000


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T]):
    """Something with a time; of two with the same time the lower rank comes first."""

    stamp_ns: int
    rank: int
    content: T


def by_stamp(arrivals: Iterable[Stamped[T]], losses: dict[str, int]) -> Iterator[Stamped[T]]:
    """Sort a stream in which nothing arrives more than WINDOW_NS late; what does is counted and left out."""
    heap: list[tuple[int, int, int, Stamped[T]]] = []
    newest = last = -(2**63)
    for serial, arrival in enumerate(arrivals):
        if arrival.stamp_ns < last:
            count_loss(losses, "records that came too late to be put in order")
            continue
        newest = max(newest, arrival.stamp_ns)
        heapq.heappush(heap, (arrival.stamp_ns, arrival.rank, serial, arrival))
        while heap[0][0] < newest - WINDOW_NS or len(heap) > _HELD_LIMIT:
            last = heap[0][0]
            yield heapq.heappop(heap)[3]
    while heap:
        yield heapq.heappop(heap)[3]
