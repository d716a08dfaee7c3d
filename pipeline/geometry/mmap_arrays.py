"""Large arrays on pages of their own.

The system gives a page when it is first written to and takes all back when the array goes. From the
allocator's heap, arrays of ever other sizes that live long leave holes behind, which a process keeps.
"""

from __future__ import annotations

import math
import mmap
import sys
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

SMALL = 1 << 16  # bytes; such arrays fill holes instead of making them


def zeros(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """As numpy.zeros; of a large array only the pages that were written to take memory."""
    kind = np.dtype(dtype)
    count = shape if isinstance(shape, int) else math.prod(shape)
    if count * kind.itemsize < SMALL:
        return np.zeros(shape, kind)
    return np.frombuffer(_mapped(count * kind.itemsize), kind, count).reshape(shape)


def _mapped(size: int) -> mmap.mmap:
    if sys.platform == "win32":
        return mmap.mmap(-1, size)
    return mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def copied(array: NDArray[Any]) -> NDArray[Any]:
    """A copy on pages of its own."""
    copy = zeros(array.shape, array.dtype)
    copy[...] = array
    return copy
