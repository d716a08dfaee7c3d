"""A process that scores runs: `python -m app.tuning.sweep.worker`.

A job a line comes as JSON on stdin, its answer goes as a line to stdout. It ends when stdin ends, in the
middle of a job too, so it never outlives the program that asks.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from typing import BinaryIO


def work(incoming: BinaryIO, outgoing: BinaryIO, score: Callable[[bytes], bytes]) -> None:
    """Answer one line after the other until there are no more."""
    asked: queue.Queue[bytes] = queue.Queue()
    threading.Thread(target=_read, args=(incoming, asked), daemon=True).start()
    while True:
        outgoing.write(score(asked.get()) + b"\n")
        outgoing.flush()


def _read(incoming: BinaryIO, asked: queue.Queue[bytes]) -> None:
    for line in incoming:
        asked.put(line)
    os._exit(0)  # nobody waits for what is being done


def main() -> None:
    """Be a worker; with `--last` one that gives way to all other processes."""
    if "--last" in sys.argv[1:] and hasattr(os, "nice"):
        os.nice(10)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that asks, which then ends us
    outgoing = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library may print
    from app.tuning.sweep.scoring import score_text

    work(sys.stdin.buffer, outgoing, score_text)


if __name__ == "__main__":
    main()
