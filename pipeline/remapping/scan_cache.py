"""Scan cache: segmented scans on disk, so that a run can be mapped again without its points.

There is one file for each source and each set of the parameters that decide the segmentation. A named file
is found again when the recording is opened again. It begins with the identity of the source, of these
parameters and of the code. Then follow the scans in any order, each with a row that holds its length and its
checksum, so that a cut or damaged file is good up to that place.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import pipeline
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.config import Parameters
from pipeline.front_end import ColumnInput, SegmentedScan
from pipeline.geometry.quantisation import POINT
from pipeline.io.atomic_files import hold, is_held
from pipeline.io.block_file import MOST_BYTES, BinaryFile, BlockFile, unnamed_file
from pipeline.io.checkpoints.codec import record_bytes, record_of
from pipeline.types.records import Float, Float32, Int32, Scan, Step, UInt16

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
    """Return a step and its segmented scan as a block. Of the points only those of the column input are kept;
    clearance is omitted."""
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
    """Return the step and the segmented scan that `pack` was given, without what it omits; z of the column
    points is 0. Errors as `record_of`."""
    packed = record_of(_PackedScan, block)
    given = packed.column_input
    return packed.step, replace(packed.scan, column_input=None if given is None else given.unpacked())


MOST_IN_FOLDER = 8 << 30  # of all named files of a folder
MOST_OPEN = 3  # files of one source
SUFFIX = ".scans"
MAGIC = b"stemmap scans 4\n"
SEGMENTATION_STAGES = ("acquisition", "filters", "ground", "clustering", "shape")
SEGMENTATION_CLASSIFICATION = ("method", "every")  # they decide which scans have input for the columns


def segmentation_key(parameters: Parameters) -> bytes:
    """Return sixteen bytes that differ where `pipeline.front_end.segment` may give another result; obstacle
    parameters do not count."""
    values = {
        **{stage: getattr(parameters, stage).model_dump() for stage in SEGMENTATION_STAGES},
        "classification": parameters.classification.model_dump(include=set(SEGMENTATION_CLASSIFICATION)),
        "breast_height": parameters.tracking.breast_height,  # centres of clusters refer to it
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).digest()[:16]


class ScanCache(BlockFile):
    """Segmented scans of one source under one set of segmentation parameters; see `BlockFile`."""

    def put(self, step: Step, scan: SegmentedScan) -> None:
        """Store a scan, unless its number is stored already, see `put_block`."""
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
        folder: Folder of the files; None uses the folder of the system for temporary files.
        source: Identity of the source: digest of the recording, odometry and seed. Empty for a source that
            cannot be found again: its files have no name, and are deleted when they are closed.
        most: Size that a file may reach.
    """

    def __init__(self, folder: Path | None = None, source: str = "", most: int = MOST_BYTES) -> None:
        """Create the collection; no file is opened."""
        self._folder, self._source, self._most = folder, source, most
        self._open: OrderedDict[bytes, ScanCache] = OrderedDict()

    def of(self, parameters: Parameters) -> ScanCache:
        """Return the cache for scans that are segmented with these parameters, opened where necessary. The
        least recently used of more than MOST_OPEN caches is closed."""
        key = segmentation_key(parameters)
        if key not in self._open:
            while len(self._open) >= MOST_OPEN:
                self._open.popitem(last=False)[1].close()
            self._open[key] = self._opened(key)
        self._open.move_to_end(key)
        return self._open[key]

    def close(self) -> None:
        """Close all caches."""
        for each in self._open.values():
            each.close()
        self._open.clear()

    def _opened(self, key: bytes) -> ScanCache:
        """Return the cache of a segmentation key: in a named file if source and folder are known and no other
        process has it, otherwise in a file without a name."""
        identity = hashlib.sha256(self._source.encode() + key + _code_digest()).digest()
        header = MAGIC + identity
        file: BinaryFile = None
        if self._source and self._folder is not None:
            with contextlib.suppress(OSError):  # the disk refuses, or another process has the file
                file = _named_file(self._folder, identity)
        if file is None:
            file = unnamed_file(self._folder)
        return ScanCache(file, header, self._folder, self._most)


def _named_file(folder: Path, identity: bytes) -> BinaryFile:
    """Return the open file of an identity (32 bytes), which this process locks. Creates the folder and the
    file, and removes old files of the folder, see `_make_room`.

    Raises:
        OSError: The disk refuses, or another process has the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / (identity[:16].hex() + SUFFIX)
    _make_room(folder, path)
    file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+b", buffering=0)
    try:
        hold(file)
    except OSError:
        file.close()
        raise
    path.touch()
    return file


def _make_room(folder: Path, keep: Path) -> None:
    """Delete the cache files that were opened longest ago until all together have at most MOST_IN_FOLDER
    bytes, except `keep` and files that a process has locked."""
    sizes: list[tuple[float, int, Path]] = []
    for path in folder.glob(f"*{SUFFIX}"):
        with contextlib.suppress(OSError):
            known = path.stat()
            sizes.append((known.st_mtime, known.st_size, path))
    total = sum(size for _, size, _ in sizes)
    for _, size, path in sorted(sizes):
        if total <= MOST_IN_FOLDER:
            return
        if path != keep and not is_held(path):
            path.unlink(missing_ok=True)
            total -= size


@cache
def _code_digest() -> bytes:
    """Return the digest (32 bytes) of all sources of the pipeline, because any of them may change the
    segmentation."""
    folder = Path(pipeline.__file__).parent
    state = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        state.update(path.relative_to(folder).as_posix().encode())
        state.update(path.read_bytes())
    return state.digest()
