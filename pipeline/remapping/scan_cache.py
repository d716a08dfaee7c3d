"""What the scans of a run showed, kept on disk so that the run can be mapped again without them."""

from __future__ import annotations

import contextlib
import errno
import shutil
import weakref
import zlib
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import Any

import numpy as np

from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan
from pipeline.remapping.clusters import ClusterTable
from pipeline.remapping.named_cache import BEGIN, CUT, ROW, Name, open_named, sealed
from pipeline.remapping.packing import TooLargeError, pack, unpack
from pipeline.types.records import Step

_FIRST_ROWS = 1024
MOST_BYTES = 4 << 30
SPARE_BYTES = 2 << 30  # of the disk are left to others: recordings, and whoever else
_LOOK_AT_ROOM = 50  # scans between two looks at the disk
_File = Any  # with seek, write and readinto; on Windows it is another class


class DamagedError(StemmapError):
    """What is read is not what was kept."""


class KeptScans:
    """The scans of a run from its first on, in a file that is found again, or in one without a name that goes
    with the process.

    Args:
        folder: Where there is room on disk; None, or where nobody may write there, the system's.
        most: Bytes that may be kept; a scan for which there is no room is not kept, and none after it.
        name: Of a file that is found again; where it cannot be had, one without a name is used.

    Attributes:
        clusters: Of the scans that were put, in memory.
        told: What a person should know of what was kept before.
        refusal: Why nothing is kept from some scan on, in words; empty where all is.
    """

    def __init__(self, folder: Path | None = None, most: int = MOST_BYTES, name: Name | None = None) -> None:
        self.folder = folder
        self._begin = 0
        self._rows = np.zeros(_FIRST_ROWS, ROW)
        self._count = 0
        self._most = most
        self.clusters = ClusterTable()
        self.refusal = self.told = ""
        self._file: _File = None
        try:
            self._file = (self._found_again(name) if name else None) or _without_name(folder)
            weakref.finalize(self, self._file.close)
        except OSError as error:
            self._refuse(0, error.strerror or str(error))

    def __len__(self) -> int:
        return self._count

    @property
    def nbytes(self) -> int:
        """Of the file."""
        return self._end(self._count)

    def put(self, step: Step, looked: SegmentedScan, key: bytes) -> None:
        """Keep a scan, which is the next one or one that is there; those after it are forgotten. Where there
        is no room, `refusal` says so.

        Args:
            key: Of the parameters that it was looked at with (see `look_key`).
        """
        if self._file is None or step.index > self._count:
            return  # one before it was refused
        if self.has(step.index, key) and self._rows["head"]["stamp_ns"][step.index] == step.scan.stamp_ns:
            self.clusters.put(step.index, looked.clusters)
            return
        try:
            head, block = pack(step, looked)
        except TooLargeError as error:
            self._refuse(step.index, str(error))
            return
        at = self._end(step.index) + ROW.itemsize
        if at + len(block) > self._most:
            self._refuse(step.index, f"more than {self._most / 1e9:.1f} GB would be kept")
            return
        try:
            if step.index % _LOOK_AT_ROOM == 0 and room(self.folder) < SPARE_BYTES + len(block):
                self._refuse(step.index, f"less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left")
                return
            row = np.array((at, len(block), zlib.crc32(block), np.void(key), head, 0), ROW)
            if step.index < self._count:  # what follows is of other parameters
                self._file.truncate(self._end(step.index))
            _write(self._file, at - ROW.itemsize, sealed(row) + block)
        except OSError as error:
            self._refuse(step.index, error.strerror or str(error))
            return
        self._count = step.index
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = row
        self._count += 1
        self.clusters.put(step.index, looked.clusters)
        self.refusal = ""

    def has(self, index: int, key: bytes) -> bool:
        """Whether a scan is kept that was looked at with these parameters."""
        return index < self._count and self.key_of(index) == key

    def looked(self, step: Step, key: bytes) -> SegmentedScan | None:
        """What a scan showed, if it is kept and was looked at with these parameters."""
        if not self.has(step.index, key):
            return None
        try:
            known, looked = self.scan(step.index)
        except DamagedError:
            self.forget_from(step.index)
            return None
        return looked if known.scan.stamp_ns == step.scan.stamp_ns else None

    def holds(self, scans: int, key: bytes) -> bool:
        """Whether all of the first scans are kept that were looked at with these parameters."""
        return self._count >= scans and all(self.key_of(k) == key for k in range(scans))

    def forget_from(self, index: int) -> None:
        """Keep the scans before it alone."""
        self._count = min(self._count, index)
        if self._file is not None:
            self.told = CUT.format(index)
            with contextlib.suppress(OSError):
                self._file.truncate(self._end(self._count))

    def key_of(self, index: int) -> bytes:
        """Of the parameters that a scan was looked at with."""
        return bytes(self._rows["key"][index])

    def scan(self, index: int) -> tuple[Step, SegmentedScan]:
        """One scan.

        Raises:
            DamagedError: What is read is not what was kept.
        """
        row = self._rows[index]
        block = bytearray(int(row["length"]))
        if self._file is None or _read(self._file, int(row["at"]), block) != int(row["crc"]):
            raise DamagedError(
                f"what was kept of scan {index} is damaged", remedy="Play the run from its start again"
            )
        try:
            return unpack(row["head"], block)
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            raise DamagedError(
                f"what was kept of scan {index} cannot be read", remedy="Play the run from its start again"
            ) from error

    def close(self) -> None:
        """Give the disk's room back."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _end(self, scans: int) -> int:
        if scans == 0:
            return self._begin
        last: Any = self._rows[scans - 1]
        return int(last["at"] + last["length"])

    def _found_again(self, name: Name) -> _File:
        """The file of this name; None where it cannot be had."""
        try:
            file, rows, self.told = open_named(name)
        except OSError:
            return None
        self._begin, self._count = BEGIN, len(rows)
        self._rows = np.concatenate([rows, np.zeros(_FIRST_ROWS, ROW)])
        return file

    def _refuse(self, index: int, why: str) -> None:
        self._count = min(self._count, index)
        self.refusal = f"from scan {index} on nothing is kept of the scans: {why}"


def _without_name(folder: Path | None) -> _File:
    """A file that goes with the process, in a folder or where the system has room for such files."""
    for place in (folder, None):
        with contextlib.suppress(OSError):
            return TemporaryFile(dir=place, buffering=0)
    raise OSError(errno.EACCES, "no folder can be written to")


def room(folder: Path | None) -> int:
    """Bytes that are free on a disk."""
    return shutil.disk_usage(folder if folder is not None and folder.is_dir() else gettempdir()).free


def _write(file: _File, at: int, block: bytes) -> None:
    file.seek(at)
    view = memoryview(block)
    while view:
        view = view[file.write(view) or 0 :]


def _read(file: _File, at: int, into: bytearray) -> int:
    """Fill the block; gives its sum, -1 where the file ends before."""
    file.seek(at)
    view = memoryview(into)
    while view:
        read = file.readinto(view) or 0
        if not read:
            return -1
        view = view[read:]
    return zlib.crc32(into)
