"""Memory of this process: freed arrays are returned to the system."""

from __future__ import annotations

import ctypes
import sys

#: Parameters of mallopt, see malloc.h of glibc.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
#: Bytes. Smaller blocks are reused; a scan of a page has 0.1 to 1 MB, a path or a cloud more.
_LARGE = 1 << 20
_ARENAS = 2  # heaps; glibc's default is eight of each core, and each keeps its largest use


def return_freed_memory() -> None:
    """Let the C library return freed memory to the system; nothing on systems without glibc.

    By default, glibc keeps a heap for each thread and raises the size from which blocks are mapped alone up
    to 32 MB, so that threads that pack large maps one after another keep the memory of each of them.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl
        return
    for parameter, value in (
        (_M_ARENA_MAX, _ARENAS),
        (_M_MMAP_THRESHOLD, _LARGE),
        (_M_TRIM_THRESHOLD, _LARGE),
    ):
        mallopt(parameter, value)
