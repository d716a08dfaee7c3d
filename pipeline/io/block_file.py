"""A temporary file of numbered blocks, for results that are too large for memory."""

from __future__ import annotations

import copy
import shutil
import weakref
from collections.abc import Callable
from pathlib import Path
from tempfile import gettempdir
from typing import Any, TypeVar

import zstandard

from pipeline.geometry.file_arrays import LARGE, SPARE_BYTES, unnamed_file

B = TypeVar("B")

MOST_BYTES = 4 << 30  # of one file
LARGEST = 1 << 28  # bytes of a block before compression; the largest known clouds need a fiftieth
_LEVEL = 1  # of the compression; higher levels take longer and save one percent
BLOCKS_BETWEEN_CHECKS = 50  # of the free space of the disk
DAMAGED = "a temporary file is damaged: {} parts are intact, the others are processed again"


class _File:
    """An open file without a name, the number of the indices that have blocks in it, and its positions: those
    of a file that drops its oldest blocks go on beyond its size, and begin again in the file itself."""

    def __init__(self, handle: Any) -> None:  # noqa: ANN401 - its class depends on the operating system
        self.handle = handle
        self.users = 1
        self.end = self.kept_from = 0  # position after the last block; that of the oldest intact byte
        weakref.finalize(self, handle.close)


class BlockFile:
    """Compressed blocks of bytes by number, in a file without a name, which is deleted when it is closed.
    Numbers begin at 0; the memory grows with the number of stored blocks.

    Args:
        most: Maximum size of the file [bytes]. A block that does not fit is not stored.
        drops_oldest: Whether a block that does not fit takes the place of those that were stored first.

    Attributes:
        refusal: Reason why some blocks are not stored, for people; "" if all are stored, or were.
        refused: Number of the first block that was not stored; later ones may be smaller and be stored.
        notice: Message for people that stored blocks could not be read; "" if all could be read.
    """

    def __init__(self, most: int = MOST_BYTES, *, drops_oldest: bool = False) -> None:
        """Create the file; an error of the disk appears in `refusal`."""
        handle = unnamed_file()
        self._file = None if handle is None else _File(handle)
        self._most, self._drops_oldest = most, drops_oldest
        # Begin and length of each block by its number, those that were stored first come first.
        self._places: dict[int, tuple[int, int]] = {}
        self.refusal = self.notice = ""
        self.refused = 0
        if self._file is None:
            self.refusal = "no folder can be written to"

    def copy(self) -> BlockFile:
        """Return the same blocks with an index of its own: what either stores or forgets from now on is not
        in the other one. The file is shared, and deleted when both are closed."""
        other = copy.copy(self)
        other._places = self._places.copy()
        if self._file is not None:
            self._file.users += 1
        return other

    def __len__(self) -> int:
        """Return the number of stored blocks."""
        return sum(begin >= self._kept_from for begin, _ in self._places.values())

    def __contains__(self, index: int) -> bool:
        """Return whether a block with this number is stored."""
        return self._places.get(index, (-1, 0))[0] >= self._kept_from

    @property
    def nbytes(self) -> int:
        """Size of the file [bytes]."""
        return 0 if self._file is None else min(self._file.end, self._most)

    @property
    def _kept_from(self) -> int:
        """Position of the oldest byte that no later block took the place of."""
        return 0 if self._file is None else self._file.kept_from

    def has_all(self, blocks: int) -> bool:
        """Return whether the blocks 0 to `blocks` - 1 are all stored."""
        return all(index in self for index in range(blocks))

    def is_new(self, index: int) -> bool:
        """Return whether a block is stored, and is among those in the newest eighth of a full file."""
        eighth = 0 if self._file is None or not self._drops_oldest else self._file.end - self._most // 8
        return index in self and self._places[index][0] >= eighth

    def put_block(self, index: int, content: bytes) -> bool:
        """Store a block at the end of the file, unless its number is stored already or the file is closed. If
        it is larger than LARGEST, the file would exceed its limit, the disk would have less than SPARE_BYTES
        left (checked for every BLOCKS_BETWEEN_CHECKS-th number), or writing fails, it is not stored and
        `refusal` contains the reason of the first such block; nothing is raised.

        Returns:
            Whether a block with this number is stored.
        """
        file = self._file
        if file is None or index in self:
            return index in self
        if len(content) > LARGEST:
            self._refuse(index, f"its data takes more than {LARGEST >> 20} MB")
            return False
        block = zstandard.ZstdCompressor(_LEVEL, write_checksum=True).compress(content)
        begin = self._place(file.end, len(block))
        try:
            if begin is None:
                self._refuse(index, f"the limit of {self._most / 1e9:.1f} GB is reached")
                return False
            grows = begin + len(block) <= self._most  # else it takes the place of others
            is_due = grows and index % BLOCKS_BETWEEN_CHECKS == 0
            if is_due and free_space(LARGE) < SPARE_BYTES + len(block):
                self._refuse(index, f"less than {SPARE_BYTES / 1e9:.0f} GB of the disk would be left")
                return False
            file.kept_from = max(file.kept_from, begin + len(block) - self._most)
            file.handle.seek(begin % self._most)
            view = memoryview(block)
            while view:
                view = view[file.handle.write(view) or 0 :]
        except OSError as error:
            self._refuse(index, error.strerror or str(error))
            return False
        self._places.pop(index, None)
        self._places[index] = begin, len(block)
        while (first := next(iter(self._places.items())))[1][0] < file.kept_from:
            del self._places[first[0]]
        file.end = begin + len(block)
        return True

    def _place(self, end: int, size: int) -> int | None:
        """Return the position of a block of `size` bytes after the position `end`; None if it does not fit.
        No block goes across the end of the file."""
        if end + size <= self._most:
            return end
        if not self._drops_oldest or size > self._most:
            return None
        return end if end % self._most + size <= self._most else (end // self._most + 1) * self._most

    def read_block(self, index: int, unpack: Callable[[bytes], B]) -> B | None:
        """Return the result of `unpack` for the content of a block; None if the block is not stored or is
        damaged, or the file is closed.

        A damaged block is removed from the index, so that it can be stored again; `notice` reports it.

        Args:
            index: Number of the block.
            unpack: Function of the bytes of the block. A ValueError, KeyError, TypeError or RuntimeError that
                it raises means that they are damaged.
        """
        if index not in self or self._file is None:
            return None
        try:
            begin, length = self._places[index]
            self._file.handle.seek(begin % self._most)
            block = self._file.handle.read(length)
            if not 0 <= zstandard.frame_content_size(block) <= LARGEST:
                raise ValueError("the size of the block is not valid")
            return unpack(zstandard.ZstdDecompressor().decompress(block))
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, zstandard.ZstdError):
            del self._places[index]
            self.notice = DAMAGED.format(len(self))
            return None

    def forget_from(self, index: int) -> None:
        """Remove the blocks with this number and larger ones. The space after the last block that stays is
        used again, unless the file is shared."""
        self._places = {number: place for number, place in self._places.items() if number < index}
        if self._file is not None and self._file.users == 1:
            self._file.end = max((self._file.kept_from, *map(sum, self._places.values())))

    def close(self) -> None:
        """Close the file, which is deleted unless it is shared. Later calls store and return nothing."""
        if self._file is not None:
            self._file.users -= 1
            if self._file.users == 0:
                self._file.handle.close()
            self._file = None

    def _refuse(self, index: int, why: str) -> None:
        """Set `refusal` and `refused` at the first block that is not stored."""
        if not self.refusal:
            self.refusal, self.refused = why, index


def free_space(folder: Path | None) -> int:
    """Return the number of free bytes on the disk of a folder; for None or a missing folder, on the disk of
    the folder of temporary files of the system."""
    return shutil.disk_usage(folder if folder is not None and folder.is_dir() else gettempdir()).free
