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
import shutil
import struct
import weakref
import zlib
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import Any

import msgspec
import numpy as np
import zstandard

import pipeline
from pipeline.classification.voxel_map import SLICE, SLICES
from pipeline.config import Parameters
from pipeline.front_end import ColumnInput, SegmentedScan
from pipeline.geometry.quantisation import POINT
from pipeline.io.atomic_files import hold, is_held
from pipeline.io.checkpoints.codec import decode, encode
from pipeline.types.records import Float, Float32, Int32, Scan, Step, SynchroniserState, UInt16

HIGHEST = SLICES * SLICE  # m above the ground; higher points are not integrated into the columns
LARGEST = 1 << 28  # bytes of a block; the largest known clouds need a fiftieth
_LEVEL = 1  # higher levels take longer and save one percent
_LENGTH = struct.Struct("<I")


class TooLargeError(ValueError):
    """A scan is larger than the cache accepts."""


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
    """Return a step and its segmented scan as a compressed block. Of the points only those of the column
    input are kept; clearance and the state of the synchroniser are omitted.

    Raises:
        TooLargeError: The block is larger than `unpack` accepts, LARGEST bytes before compression.
    """
    no_points: Float32 = np.zeros((0, 3), np.float32)
    lean = replace(
        scan, raw=no_points, filtered=no_points, labels=scan.labels[:0], column_input=None, clearance=None
    )
    packed = _PackedScan(
        replace(step, scan=Scan(step.scan.stamp_ns, no_points), synchroniser_state=SynchroniserState()),
        lean,
        None if scan.column_input is None else _PackedColumnInput.of(scan.column_input),
    )
    tree, arrays = encode(packed, planes=True)
    text = msgspec.json.encode(tree)
    block = _LENGTH.pack(len(text)) + text + arrays
    if len(block) > LARGEST:
        raise TooLargeError(f"its data takes more than {LARGEST >> 20} MB")
    return zstandard.ZstdCompressor(level=_LEVEL).compress(block)


def unpack(block: bytes | bytearray) -> tuple[Step, SegmentedScan]:
    """Return the step and the segmented scan that `pack` was given, without what it omits; z of the column
    points is 0. Sizes are checked before memory is taken.

    Raises:
        ValueError: The block is damaged. A damaged block can also raise KeyError, TypeError or RuntimeError.
    """
    try:
        if not 0 <= zstandard.frame_content_size(block) <= LARGEST:
            raise ValueError("the size of the block is not valid")
        data = zstandard.ZstdDecompressor().decompress(block)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None
    if len(data) < _LENGTH.size:
        raise ValueError("the block is cut off")
    end = _LENGTH.size + _LENGTH.unpack_from(data)[0]
    packed = decode(_PackedScan, msgspec.json.decode(data[_LENGTH.size : end]), data[end:], planes=True)
    given = packed.column_input
    return packed.step, replace(packed.scan, column_input=None if given is None else given.unpacked())


MOST_BYTES = 4 << 30  # of one file
MOST_IN_FOLDER = 8 << 30  # of all named files of a folder
MOST_OPEN = 3  # files of one source
SPARE_BYTES = 2 << 30  # of the disk are left to recordings and to other programs
SCANS_BETWEEN_CHECKS = 50  # of the free space of the disk
SUFFIX = ".scans"
MAGIC = b"stemmap scans 4\n"
ROW = np.dtype([("index", "<i8"), ("length", "<i8"), ("block_crc", "<u4"), ("row_crc", "<u4")])

SEGMENTATION_STAGES = ("acquisition", "filters", "ground", "clustering", "shape")
SEGMENTATION_CLASSIFICATION = ("method", "every")  # they decide which scans have input for the columns
DAMAGED = "the scan cache of this recording is damaged: {} scans are intact, the others are processed again"

_File = Any  # binary, with seek, write and readinto; its class depends on the operating system


def segmentation_key(parameters: Parameters) -> bytes:
    """Return sixteen bytes that differ where `pipeline.front_end.segment` may give another result; obstacle
    parameters do not count."""
    values = {
        **{stage: getattr(parameters, stage).model_dump() for stage in SEGMENTATION_STAGES},
        "classification": parameters.classification.model_dump(include=set(SEGMENTATION_CLASSIFICATION)),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).digest()[:16]


class ScanCache:
    """Segmented scans of one source under one set of segmentation parameters.

    Args:
        file: An open file that holds the header, or is empty; None where no file can be had.
        header: Header of the file.
        folder: Folder of the file, of which the free space is checked.
        most: Size that the file may reach. A scan that does not fit is not stored.

    Attributes:
        refusal: Why some scans are not stored, for people; empty where all are.
        notice: What is wrong with the file that was found, for people; empty where nothing is.
    """

    def __init__(
        self, file: _File, header: bytes, folder: Path | None = None, most: int = MOST_BYTES
    ) -> None:
        """Open the cache and find its scans. A file with another header is emptied; one that is cut or
        damaged is cut after the last valid row, with a `notice`. Errors of the disk appear in `refusal`."""
        self._file: _File = file
        self._folder, self._most = folder, most
        self._rows: dict[int, tuple[int, Any]] = {}  # by scan: position of its block, and its row
        self.refusal = self.notice = ""
        self._end = len(header)
        if file is None:
            self.refusal = "no scan is cached: no folder can be written to"
            return
        weakref.finalize(self, file.close)
        try:
            self._open(header)
        except OSError as error:
            self.refusal = f"no scan is cached: {error.strerror or error}"

    def __len__(self) -> int:
        """Return the number of stored scans."""
        return len(self._rows)

    @property
    def nbytes(self) -> int:
        """Size of the file [bytes]."""
        return self._end

    def has_all(self, scans: int) -> bool:
        """Return whether the scans 0 to `scans` - 1 are all stored."""
        return len(self._rows) >= scans and all(index in self._rows for index in range(scans))

    def put(self, step: Step, scan: SegmentedScan) -> None:
        """Store a scan at the end of the file, unless its number is stored already or the cache is closed. If
        the block, the file or the disk is full, or writing fails, it is not stored and `refusal` contains the
        reason; nothing is raised."""
        if self._file is None or step.index in self._rows:
            return
        try:
            block = pack(step, scan)
            if self._end + ROW.itemsize + len(block) > self._most:
                self._refuse(step.index, f"the cache is limited to {self._most / 1e9:.1f} GB")
                return
            if step.index % SCANS_BETWEEN_CHECKS == 0 and free_space(self._folder) < SPARE_BYTES + len(block):
                self._refuse(step.index, f"less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left")
                return
            row = np.array((step.index, len(block), zlib.crc32(block), 0), ROW)
            row["row_crc"] = _checksum(row)
            _write(self._file, self._end, row.tobytes() + block)
        except TooLargeError as error:
            self._refuse(step.index, str(error))
            return
        except OSError as error:
            self._refuse(step.index, error.strerror or str(error))
            return
        self._rows[step.index] = (self._end + ROW.itemsize, row)
        self._end += ROW.itemsize + len(block)

    def read(self, index: int, stamp_ns: int | None = None) -> tuple[Step, SegmentedScan] | None:
        """Return a scan without its raw points. None if it is not stored, the cache is closed, or its time
        differs.

        A damaged scan is removed from the index, so that it can be stored again; `notice` reports it.

        Args:
            index: Number of the scan.
            stamp_ns: Time that it must have [ns]; None accepts any.
        """
        if index not in self._rows or self._file is None:
            return None
        at, row = self._rows[index]
        block = bytearray(int(row["length"]))
        try:
            if _read(self._file, at, block) != int(row["block_crc"]):
                raise ValueError("the checksum is wrong")
            step, scan = unpack(block)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError):
            del self._rows[index]
            self.notice = DAMAGED.format(len(self._rows))
            return None
        return (step, scan) if stamp_ns in (None, step.scan.stamp_ns) else None

    def close(self) -> None:
        """Close the file; a file without a name is deleted. Later calls of `put` and `read` do nothing."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _open(self, header: bytes) -> None:
        """Read the rows of the file, without their blocks. A file without this header is emptied; the part
        after the last valid row is cut off.

        Raises:
            OSError: The disk refuses.
        """
        size = self._file.seek(0, os.SEEK_END)
        start = bytearray(len(header))
        if size < len(header) or _read(self._file, 0, start) < 0 or start != header:
            self._file.truncate(0)
            _write(self._file, 0, header)
            return
        while self._end + ROW.itemsize <= size:
            data = bytearray(ROW.itemsize)
            _read(self._file, self._end, data)
            row: Any = np.frombuffer(data, ROW)[0]
            length, at = int(row["length"]), self._end + ROW.itemsize
            if row["row_crc"] != _checksum(row) or length < 0 or at + length > size:
                break
            self._rows[int(row["index"])] = (at, row)
            self._end = at + length
        if self._end < size:
            self.notice = DAMAGED.format(len(self._rows))
            self._file.truncate(self._end)

    def _refuse(self, index: int, why: str) -> None:
        """Set `refusal` to the first scan that is not stored and the reason; later ones may be smaller and
        fit."""
        self.refusal = self.refusal or f"scan {index} and possibly later scans are not cached: {why}"


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
        file: _File = None
        if self._source and self._folder is not None:
            with contextlib.suppress(OSError):  # the disk refuses, or another process has the file
                file = _named_file(self._folder, identity)
        if file is None:
            file = _unnamed_file(self._folder)
        return ScanCache(file, header, self._folder, self._most)


def free_space(folder: Path | None) -> int:
    """Return the number of free bytes on the disk of a folder; that of temporary files for None or a missing
    folder."""
    return shutil.disk_usage(folder if folder is not None and folder.is_dir() else gettempdir()).free


def _named_file(folder: Path, identity: bytes) -> _File:
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


def _unnamed_file(folder: Path | None) -> _File:
    """Return an open file without a name in the folder, or else in the folder of the system; None if neither
    is possible."""
    for place in (folder, None):
        with contextlib.suppress(OSError):
            return TemporaryFile(dir=place, buffering=0)
    return None


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


def _checksum(row: Any) -> int:  # noqa: ANN401 - of ROW
    """Return the CRC-32 of a row (ROW) without its last field, which contains it."""
    return zlib.crc32(row.tobytes()[:-4])


def _write(file: _File, at: int, block: bytes) -> None:
    """Write a block completely at a position of the file [bytes].

    Raises:
        OSError: The disk refuses.
    """
    file.seek(at)
    view = memoryview(block)
    while view:
        view = view[file.write(view) or 0 :]


def _read(file: _File, at: int, into: bytearray) -> int:
    """Fill a block from a position of the file [bytes]; return its CRC-32, -1 if the file ends before.

    Raises:
        OSError: The disk refuses.
    """
    file.seek(at)
    view = memoryview(into)
    while view:
        read = file.readinto(view) or 0
        if not read:
            return -1
        view = view[read:]
    return zlib.crc32(into)
