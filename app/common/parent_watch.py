"""Whether the process that asked for this one is still there.

Its number is handed over: who looks it up may look when it has gone already, and then waits for another one.
"""

from __future__ import annotations

import os
import sys
import threading
import time

_LOOK_S = 1.0


def is_gone(parent: int) -> bool:
    """Whether the process that started this one has ended; never on Windows, where one stands between."""
    return sys.platform != "win32" and os.getppid() != parent


def end_with(parent: int) -> None:
    """End this process when its parent does, in the middle of whatever it is doing."""

    def watch() -> None:
        while not is_gone(parent):
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()
