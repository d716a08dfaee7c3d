"""Of several processes that find nothing compiled, one compiles at a time: two that write the same kernels at
once may spoil what is kept of them, and the second finds most of them ready."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pipeline.jit
from pipeline.jit import on_compiling


@contextlib.contextmanager
def one_at_a_time() -> Iterator[None]:
    """Inside, each kernel that has to be compiled waits until no other process compiles."""
    with contextlib.ExitStack() as stack:
        held: list[IO[bytes]] = []

        def wait() -> None:
            if not held:
                held.append(stack.enter_context(Path(pipeline.jit.__file__).open("rb")))
                _hold(held[0])

        with on_compiling(wait):
            yield


def _hold(file: IO[bytes]) -> None:
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX)
