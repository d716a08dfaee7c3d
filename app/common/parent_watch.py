"""Detection of the end of the parent process.

The parent passes its process number, since a child that looks it up itself may be started after the parent
has ended.
"""

from __future__ import annotations

import os
import sys
import threading
import time

_LOOK_S = 1.0


def is_gone(parent: int) -> bool:
    """Return whether the parent has ended; always False on Windows, where a launcher process is in
    between."""
    return sys.platform != "win32" and os.getppid() != parent


def end_with(parent: int) -> None:
    """End this process immediately when its parent ends."""

    def watch() -> None:
        while not is_gone(parent):
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()
