"""A file of numbered blocks, for results that are too large for memory.

It begins with a header. Then follow the blocks in any order, compressed, each with a row that holds its
number, its length and its checksum, so that a cut or damaged file is good up to that place.
"""

from __future__ import annotations

import os
import shutil
import weakref
import zlib
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import Any, TypeVar

import numpy as np
import zstandard

B = TypeVar("B")

MOST_BYTES = 4 << 30  # of one file
LARGEST = 1 << 28  # bytes of a block before compression; the largest known clouds need a fiftieth
_LEVEL = 1  # of the compression; higher levels take longer and save one percent
SPARE_BYTES = 2 << 30  # of the disk are left to recordings and to other programs
BLOCKS_BETWEEN_CHECKS = 50  # of the free space of the disk
ROW = np.dtype([("index", "<i8"), ("length", "<i8"), ("block_crc", "<u4"), ("row_crc", "<u4")])
DAMAGED = "the scan cache of this recording is damaged: {} scans are intact, the others are processed again"

BinaryFile = Any  # with seek, write and readinto; its class depends on the operating system


class BlockFile:
    """Blocks of bytes by number.

    Args:
        file: An open file that holds the header, or is empty; None where no file can be had.
        header: Header of the file.
        folder: Folder of the file, of which the free space is checked.
        most: Size that the file may reach. A block that does not fit is not stored.

    Attributes:
        refusal: Why some blocks are not stored, for people; empty where all are.
        notice: What is wrong with the file that was found, for people; empty where nothing is.
    """

    def __init__(
        self, file: BinaryFile, header: bytes = b"", folder: Path | None = None, most: int = MOST_BYTES
    ) -> None:
        """Open the file and find its blocks. A file with another header is emptied; one that is cut or
        damaged is cut after the last valid row, with a `notice`. Errors of the disk appear in `refusal`."""
        self._file: BinaryFile = file
        self._folder, self._most = folder, most
        self._rows: dict[int, tuple[int, Any]] = {}  # by number: position of its block, and its row
        self.refusal = self.notice = ""
        self._start = self._end = len(header)
        if file is None:
            self.refusal = "no scan is cached: no folder can be written to"
            return
        weakref.finalize(self, file.close)
        try:
            self._open(header)
        except OSError as error:
            self.refusal = f"no scan is cached: {error.strerror or error}"

    def __len__(self) -> int:
        """Return the number of stored blocks."""
        return len(self._rows)

    def __contains__(self, index: int) -> bool:
        """Return whether a block with this number is stored."""
        return index in self._rows

    @property
    def nbytes(self) -> int:
        """Size of the file [bytes]."""
        return self._end

    def has_all(self, blocks: int) -> bool:
        """Return whether the blocks 0 to `blocks` - 1 are all stored."""
        return len(self._rows) >= blocks and all(index in self._rows for index in range(blocks))

    def put_block(self, index: int, content: bytes) -> bool:
        """Store a block at the end of the file, unless its number is stored already or the file is closed. If
        it is larger than LARGEST, the file or the disk is full, or writing fails, it is not stored and
        `refusal` contains the reason; nothing is raised.

        Returns:
            Whether a block with this number is stored.
        """
        if self._file is None or index in self._rows:
            return index in self._rows
        if len(content) > LARGEST:
            self._refuse(index, f"its data takes more than {LARGEST >> 20} MB")
            return False
        block = zstandard.ZstdCompressor(_LEVEL).compress(content)
        try:
            if self._end + ROW.itemsize + len(block) > self._most:
                self._refuse(index, f"the cache is limited to {self._most / 1e9:.1f} GB")
                return False
            if index % BLOCKS_BETWEEN_CHECKS == 0 and free_space(self._folder) < SPARE_BYTES + len(block):
                self._refuse(index, f"less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left")
                return False
            row = np.array((index, len(block), zlib.crc32(block), 0), ROW)
            row["row_crc"] = _checksum(row)
            _write(self._file, self._end, row.tobytes() + block)
        except OSError as error:
            self._refuse(index, error.strerror or str(error))
            return False
        self._rows[index] = (self._end + ROW.itemsize, row)
        self._end += ROW.itemsize + len(block)
        return True

    def read_block(self, index: int, unpack: Callable[[bytes], B]) -> B | None:
        """Return the content of a block; None if it is not stored or the file is closed. Its size is checked
        before memory is taken.

        A damaged block is removed from the index, so that it can be stored again; `notice` reports it.

        Args:
            index: Number of the block.
            unpack: Returns the record of the bytes; it raises ValueError, KeyError, TypeError or
                RuntimeError if they are damaged.
        """
        if index not in self._rows or self._file is None:
            return None
        at, row = self._rows[index]
        block = bytearray(int(row["length"]))
        try:
            if _read(self._file, at, block) != int(row["block_crc"]):
                raise ValueError("the checksum is wrong")
            if not 0 <= zstandard.frame_content_size(block) <= LARGEST:
                raise ValueError("the size of the block is not valid")
            return unpack(zstandard.ZstdDecompressor().decompress(block))
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, zstandard.ZstdError):
            del self._rows[index]
            self.notice = DAMAGED.format(len(self._rows))
            return None

    def forget_from(self, index: int) -> None:
        """Remove the blocks with this number and larger ones. The space after the last block that stays is
        used again; a file that is opened again must not be shortened this way."""
        self._rows = {number: row for number, row in self._rows.items() if number < index}
        self._end = max((at + int(row["length"]) for at, row in self._rows.values()), default=self._start)

    def close(self) -> None:
        """Close the file; a file without a name is deleted. Later calls store and return nothing."""
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
        """Set `refusal` to the first block that is not stored and the reason; later ones may be smaller and
        fit."""
        self.refusal = self.refusal or f"scan {index} and possibly later scans are not cached: {why}"


def free_space(folder: Path | None) -> int:
    """Return the number of free bytes on the disk of a folder; that of temporary files for None or a missing
    folder."""
    return shutil.disk_usage(folder if folder is not None and folder.is_dir() else gettempdir()).free


def unnamed_file(folder: Path | None) -> BinaryFile:
    """Return an open file without a name in the folder, or else in the folder of the system; None if neither
    is possible."""
    for place in (folder, None):
        try:
            return TemporaryFile(dir=place, buffering=0)
        except OSError:
            continue
    return None


def _checksum(row: Any) -> int:  # noqa: ANN401 - of ROW
    """Return the CRC-32 of a row (ROW) without its last field, which contains it."""
    return zlib.crc32(row.tobytes()[:-4])


def _write(file: BinaryFile, at: int, block: bytes) -> None:
    """Write a block completely at a position of the file [bytes].

    Raises:
        OSError: The disk refuses.
    """
    file.seek(at)
    view = memoryview(block)
    while view:
        view = view[file.write(view) or 0 :]


def _read(file: BinaryFile, at: int, into: bytearray) -> int:
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
