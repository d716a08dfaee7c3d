"""Some scans of a run as they were read, so few that all are looked at again in a moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pipeline.front_end import SegmentedScan
from pipeline.types.records import Step

Each = Callable[[Callable[[Step], SegmentedScan], list[Step]], Iterable[SegmentedScan]]
MOST_SCANS = 56
MOST_BYTES = 20 << 20  # of points: what a look takes grows with them


class Sample:
    """Every n-th scan; when more than 56 of them or more than 20 MB of points are there, every second goes,
    and n doubles."""

    def __init__(self) -> None:
        self._steps: dict[int, Step] = {}
        self._spacing = 1

    def __len__(self) -> int:
        return len(self._steps)

    def offer(self, step: Step) -> None:
        """Keep a scan if it is due."""
        if step.index % self._spacing:
            return
        self._steps[step.index] = step
        while len(self._steps) > 1 and self._are_too_many():
            self._spacing *= 2
            self._steps = {n: kept for n, kept in self._steps.items() if n % self._spacing == 0}

    @property
    def nbytes(self) -> int:
        """Of the points."""
        return sum(step.scan.points.nbytes for step in self._steps.values())

    def _are_too_many(self) -> bool:
        return len(self._steps) > MOST_SCANS or self.nbytes > MOST_BYTES

    def looked(
        self, look: Callable[[Step], SegmentedScan], scans: int, each: Each = map
    ) -> dict[int, SegmentedScan]:
        """What those of the first scans show, by their numbers, ascending.

        Args:
            look: At one scan; scans: how many are asked of.
            each: Applies a function to all of a list, in turn or several at once.
        """
        numbers = [n for n in sorted(self._steps) if n < scans]
        return dict(zip(numbers, each(look, [self._steps[n] for n in numbers]), strict=True))
