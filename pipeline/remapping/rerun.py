"""Rerun: the scans of a run mapped again with other parameters, from the scan cache or from the source."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan
from pipeline.mapper import Mapper, MapperState
from pipeline.remapping.scan_cache import ScanCache
from pipeline.types.records import Frame, Step

Reread = Callable[[int], Iterator[Step]]
Segment = Callable[[Step], SegmentedScan]
SegmentSteps = Callable[[Segment, Iterator[Step]], Iterator[tuple[Step, SegmentedScan]]]


def segment_in_turn(segment: Segment, steps: Iterator[Step]) -> Iterator[tuple[Step, SegmentedScan]]:
    """Yield each step with its segmented scan, in order; each is segmented when it is consumed."""
    return ((step, segment(step)) for step in steps)


class Rerun:
    """Maps the scans of a run in turn. The map is the same as that of a first run with the same parameters.

    Args:
        mapper: A fresh mapper with the new parameters.
        cache: Cache for scans that are segmented with these parameters; missing scans are added to it.
        reread: Returns the steps of the run from the one with an index on; None for a live run.
        segment_steps: Segments the scans that are read again: in turn, or ahead of the mapping.

    Attributes:
        done: Number of scans that are mapped.
    """

    def __init__(
        self,
        mapper: Mapper,
        cache: ScanCache,
        reread: Reread | None = None,
        segment_steps: SegmentSteps = segment_in_turn,
    ) -> None:
        """Prepare a rerun; nothing is read."""
        self.mapper = mapper
        self.done = 0
        self._cache, self._reread, self._segment_steps = cache, reread, segment_steps
        self._segmented: Iterator[tuple[Step, SegmentedScan]] | None = None

    def map_next(self) -> Frame:
        """Map the next scan, from the cache or else from the source, and return its frame. A scan from the
        cache has no points in the frame; one from the source is added to the cache.

        Raises:
            StemmapError: The scan is not in the cache and cannot be read again, for example after the last
                scan.
        """
        step, scan = self._cache.read(self.done) or self._read_again(self.done)
        frame = self.mapper.process(step, scan)
        self.done += 1
        return frame

    def go_back(self, scans: int, state: MapperState) -> None:
        """Return to an earlier state of the mapper, taken after `scans` scans; where the source is needed, it
        is read again from there."""
        self.mapper.restore(state)
        self.done, self._segmented = scans, None

    def close(self) -> None:
        """Stop reading the source. The cache stays open."""
        self._segmented = None

    def _read_again(self, index: int) -> tuple[Step, SegmentedScan]:
        """Return a step and its segmented scan from the source, and add it to the cache. Reading continues
        after the last scan read; scans before `index` are skipped.

        Raises:
            StemmapError: The run is live, or the source has no such scan.
        """
        if self._reread is None:
            raise StemmapError(
                "the scans of a live run cannot be read again, and these parameters need their points",
                remedy="Open the recording of the run",
            )
        if self._segmented is None:
            self._segmented = self._segment_steps(self.mapper.segmenter(), self._reread(index))
        for step, scan in self._segmented:
            if step.index == index:
                self._cache.put(step, scan)
                return step, scan
        raise StemmapError(f"the source does not give scan {index} again", remedy="Open it again")
