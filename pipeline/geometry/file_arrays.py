"""Arrays that grow with the length of a drive, in temporary files: their pages are no memory of the process
that the system could not take back."""

from __future__ import annotations

import math
import mmap
import os
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DISK = Path("/var/tmp")  # noqa: S108 - the default may be in memory; the files have no name
#: Folder of large temporary files; None for that of the system.
LARGE = _DISK if _DISK.is_dir() else None
LEAST = 1 << 16  # bytes; smaller arrays are in memory
SPARE_BYTES = 2 << 30  # of the disk are left to recordings and to other programs


def unnamed_file() -> Any:  # noqa: ANN401 - its class depends on the operating system
    """Return an open file without a name in LARGE, or else in the folder of temporary files of the system;
    None if neither is possible."""
    for place in (LARGE, None):
        try:
            return TemporaryFile(dir=place, buffering=0)
        except OSError:
            continue
    return None


def extended(rows: NDArray[Any], length: int) -> NDArray[Any]:
    """Return an array that begins with copies of some rows; the others have any values. From LEAST bytes on
    it is in a file without a name, which is deleted with the array, if the disk has room for all of it and
    SPARE_BYTES. A forked process shares its values.

    Args:
        rows: The rows, shape (N, ...).
        length: Number of rows of the result, at least N.
    """
    shape = (length, *rows.shape[1:])
    size = math.prod(shape) * rows.itemsize
    pages = _pages(size, np.ascontiguousarray(rows)) if size >= LEAST else None
    if pages is not None:
        return np.frombuffer(pages, rows.dtype).reshape(shape)
    array = np.empty(shape, rows.dtype)
    array[: len(rows)] = rows
    return array


def _pages(size: int, beginning: NDArray[Any]) -> mmap.mmap | None:
    """Return a file of `size` bytes that begins with those of an array; None if the disk has no room."""
    reserve = getattr(os, "posix_fallocate", None)  # else a full disk would end the process
    file = None if reserve is None else unnamed_file()
    if reserve is None or file is None:
        return None
    with file:
        try:
            disk = os.fstatvfs(file.fileno())
            if disk.f_bavail * disk.f_frsize < size + SPARE_BYTES:
                return None
            reserve(file.fileno(), 0, size)
            view = beginning.reshape(-1).view(np.uint8).data
            while view:  # several times faster than the page faults of a copy
                view = view[file.write(view) :]
            return mmap.mmap(file.fileno(), size)
        except OSError:
            return None
