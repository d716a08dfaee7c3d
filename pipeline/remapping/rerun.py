"""Rerun: the scans of a run mapped again with other parameters, from the scan cache or from the source.

The scan cache has segmented scans on disk, so that a run can be mapped again without its points. There is one
temporary file for each set of the parameters that decide the segmentation.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.front_end import ColumnInput, SegmentedScan
from pipeline.geometry.columns import POINT
from pipeline.io.block_file import MOST_BYTES, BlockFile
from pipeline.io.checkpoints.codec import record_bytes, record_of
from pipeline.mapper import Mapper, MapperState
from pipeline.types.records import Float, Float32, Frame, Int32, Scan, Step, UInt16

HIGHEST = SLICES * SLICE  # m above the ground; higher points are not integrated into the columns


@dataclass(frozen=True, slots=True, eq=False)
class _PackedColumnInput:
    """`ColumnInput` with points in steps of POINT: x, y and height above the ground, shape (3, N)."""

    points: Int32
    steepest: Float
    depth: UInt16
    terrain: Float

    @classmethod
    def of(cls, given: ColumnInput) -> _PackedColumnInput:
        """Return the packed points that can be integrated into columns, with heights in (0, HIGHEST); their z
        is not used and not stored."""
        low = (given.height > 0.0) & (given.height < HIGHEST)
        places = np.stack([given.points[low, 0], given.points[low, 1], given.height[low]])
        steps = np.rint(places * np.float32(1.0 / POINT)).astype(np.int32)
        return cls(steps, given.steepest, np.ascontiguousarray(given.depth.T), given.terrain)

    def unpacked(self) -> ColumnInput:
        """Return the input; z of the points is 0."""
        places = self.points.astype(np.float32) * np.float32(POINT)
        points = np.zeros((places.shape[1], 3), np.float32)
        points[:, 0], points[:, 1] = places[0], places[1]
        depth = np.ascontiguousarray(self.depth.T)
        return ColumnInput(points, places[2].copy(), self.steepest, depth, self.terrain)


@dataclass(frozen=True, slots=True, eq=False)
class _PackedScan:
    """A step and its segmented scan without points and without the column input, which is apart."""

    step: Step
    scan: SegmentedScan
    column_input: _PackedColumnInput | None


def pack(step: Step, scan: SegmentedScan) -> bytes:
    """Return a step and its segmented scan as a block. Of the points only those of the column input are kept,
    in steps of POINT and with heights in (0, HIGHEST); labels and clearance are omitted."""
    no_points: Float32 = np.zeros((0, 3), np.float32)
    lean = replace(
        scan, raw=no_points, filtered=no_points, labels=scan.labels[:0], column_input=None, clearance=None
    )
    return record_bytes(
        _PackedScan(
            replace(step, scan=Scan(step.scan.stamp_ns, no_points)),
            lean,
            None if scan.column_input is None else _PackedColumnInput.of(scan.column_input),
        )
    )


def unpack(block: bytes) -> tuple[Step, SegmentedScan]:
    """Return the step and the segmented scan that `pack` was given, without what it omits (points and labels
    are empty, clearance is None); z of the column points is 0. Errors as `record_of`."""
    packed = record_of(_PackedScan, block)
    given = packed.column_input
    return packed.step, replace(packed.scan, column_input=None if given is None else given.unpacked())


MOST_OPEN = 3  # files of one source
SEGMENTATION_STAGES = ("acquisition", "filters", "ground", "clustering", "shape")
SEGMENTATION_CLASSIFICATION = ("method", "interval")  # they decide which scans have input for the columns


def segmentation_key(parameters: Parameters) -> bytes:
    """Return a key of 16 bytes. It differs between parameters with which `pipeline.front_end.segment` may
    give different results, apart from obstacle parameters."""
    values = {
        **{stage: getattr(parameters, stage).model_dump() for stage in SEGMENTATION_STAGES},
        "classification": parameters.classification.model_dump(include=set(SEGMENTATION_CLASSIFICATION)),
        "breast_height": parameters.tracking.breast_height,  # centres of clusters refer to it
        "radius": (parameters.detection.radius_min, parameters.detection.radius_max),  # trunks in clusters
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).digest()[:16]


class ScanCache(BlockFile):
    """Segmented scans of one source under one set of segmentation parameters; see `BlockFile`."""

    def put(self, step: Step, scan: SegmentedScan) -> None:
        """Store a scan without its points, unless its number is stored already. If the file or the disk is
        full it is not stored, and `refusal` contains the reason."""
        if step.index not in self:
            self.put_block(step.index, pack(step, scan))

    def read(self, index: int, stamp_ns: int | None = None) -> tuple[Step, SegmentedScan] | None:
        """Return a scan without its raw points. None if it is not stored, the cache is closed, or its time
        differs.

        A damaged scan is removed from the index, so that it can be stored again; `notice` reports it.

        Args:
            index: Number of the scan.
            stamp_ns: Time that it must have [ns]; None accepts any.
        """
        found = self.read_block(index, unpack)
        return found if found is not None and stamp_ns in (None, found[0].scan.stamp_ns) else None


class ScanCaches:
    """The caches of one source, one for each set of segmentation parameters; the last few used are open.

    Args:
        most: Maximum size of each file [bytes].
    """

    def __init__(self, most: int = MOST_BYTES) -> None:
        """Create the collection; no file is opened."""
        self._most = most
        self._open: OrderedDict[bytes, ScanCache] = OrderedDict()

    def of(self, parameters: Parameters) -> ScanCache:
        """Return the cache for scans that are segmented with these parameters, opened where necessary. The
        least recently used of more than MOST_OPEN caches is closed."""
        key = segmentation_key(parameters)
        if key not in self._open:
            while len(self._open) >= MOST_OPEN:
                self._open.popitem(last=False)[1].close()
            self._open[key] = ScanCache(self._most)
        self._open.move_to_end(key)
        return self._open[key]

    @property
    def nbytes(self) -> int:
        """Size of all files [bytes]."""
        return sum(each.nbytes for each in self._open.values())

    def close(self) -> None:
        """Close all caches, which deletes their files; a later `of` opens empty ones."""
        for each in self._open.values():
            each.close()
        self._open.clear()


Reread = Callable[[int], Iterator[Step]]
Segment = Callable[[Step], SegmentedScan]
SegmentSteps = Callable[[Segment, Iterator[Step]], Iterator[tuple[Step, SegmentedScan]]]


def segment_in_turn(segment: Segment, steps: Iterator[Step]) -> Iterator[tuple[Step, SegmentedScan]]:
    """Yield each step with its segmented scan, in order; each is segmented when it is consumed."""
    return ((step, segment(step)) for step in steps)


class Rerun:
    """Maps the scans of a run in turn. The map is the same as that of a first run with the same parameters.

    Args:
        mapper: A mapper with the new parameters, after `done` scans.
        cache: Cache for scans that are segmented with these parameters; missing scans are added to it.
        reread: Returns the steps of the run from the one with an index on; None for a live run.
        segment_steps: Segments the scans that are read again: in turn, or ahead of the mapping.
        done: Number of scans that the mapper has mapped with these parameters.

    Attributes:
        done: Number of scans that are mapped.
        view: View of the last one, see `SegmentedScan.view`; empty before the first.
    """

    def __init__(
        self,
        mapper: Mapper,
        cache: ScanCache,
        reread: Reread | None = None,
        segment_steps: SegmentSteps = segment_in_turn,
        *,
        done: int = 0,
    ) -> None:
        """Prepare a rerun; nothing is read."""
        self.mapper = mapper
        self.done = done
        self.view: Float = np.zeros((2, 0))
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
        self.view = scan.view
        return frame

    def require(self, scans: int) -> None:
        """Check before a rerun of a live run that it can be completed: that the cache has the scans that are
        left.

        Args:
            scans: Number of scans of the run.

        Raises:
            StemmapError: A scan is not in the cache and cannot be read again.
        """
        if self._reread is None and not all(n in self._cache for n in range(self.done, scans)):
            raise _no_points()

    def go_back(self, scans: int, state: MapperState) -> None:
        """Return to an earlier state of the mapper, taken after `scans` scans; where the source is needed, it
        is read again from there."""
        self.mapper.restore(state)
        self.done, self._segmented = scans, None

    def finish(self) -> MapperState:
        """Close the rerun, and return the state of the mapper."""
        self.close()
        return self.mapper.snapshot()

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
            raise _no_points()
        is_new = False
        while not is_new:  # a run that goes on has more scans than when reading began
            is_new = self._segmented is None
            segmented = self._segmented or self._segment_steps(self.mapper.segmenter(), self._reread(index))
            self._segmented = segmented
            for step, scan in segmented:
                if step.index == index:
                    self._cache.put(step, scan)
                    return step, scan
            self._segmented = None
        raise StemmapError(f"the source does not give scan {index} again", remedy="Open it again")


def _no_points() -> StemmapError:
    """Return the error for a rerun that needs points of a live run."""
    return StemmapError(
        "the scans of a live run cannot be read again, and these parameters need their points",
        remedy="Open the recording of the run",
    )
