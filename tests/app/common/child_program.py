"""A child process of the tests: answers each number with its double, and misbehaves when asked to."""

from __future__ import annotations

import os
import signal
import time

from app.common.child_process import ParentConnection, run_child
from pipeline.errors import SourceError


def serve(parent: ParentConnection) -> None:
    """Answer messages until the parent ends."""
    while True:
        message = parent.receive(str)
        if message.isdigit():
            print("printed by a library")
            parent.send(2 * int(message))
        elif message == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        elif message == "sleep":
            time.sleep(60.0)
        elif message == "long":
            parent.send("x" * 100_000)
        elif message == "pid":
            parent.send(os.getpid())
        elif message == "allocate":
            parent.send(len(bytearray(1 << 30)))
        elif message == "refuse":
            raise SourceError("it is empty", where="a.mcap", remedy="Take another")
        else:
            raise ValueError(message)


if __name__ == "__main__":
    run_child(serve, memory_limit=512 << 20)
