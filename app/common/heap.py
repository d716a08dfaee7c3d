"""Return of freed memory to the system.

Arrays of changing sizes leave holes in the heap of the C library. glibc returns only the end of the heap by
itself, so a process that maps for hours would keep more and more memory that nothing uses.
"""

from __future__ import annotations

import ctypes
import threading
from time import sleep

INTERVAL_S = 60.0


def trim_regularly() -> None:
    """Trim the heap every INTERVAL_S in a thread, until the process ends. Nothing happens where the C library
    is not glibc."""

    def run() -> None:
        while trim_heap():
            sleep(INTERVAL_S)

    threading.Thread(target=run, name="heap", daemon=True).start()


def trim_heap() -> bool:
    """Return all free pages of the heap to the system; return whether the C library can do that. It takes up
    to 50 ms, in which other threads run."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # another C library; TypeError: Windows
        return False
    trim(0)
    return True
