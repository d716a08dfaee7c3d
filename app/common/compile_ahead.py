"""Compiles the kernels of the mapper on two cores before the first scan."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import IO

from app.common.settings import data_folder

#: A small machine that does other things beside may take half of it; what is kept until then is not lost.
PATIENCE_S = 1800.0
_HALVES = ("warm_eyes", "warm_map")
# A process that is killed takes its children with it.
_PROGRAM = (
    "from app.common.parent_watch import end_with; end_with({parent}); "
    "from app.worker.numba_warmup import {half}; {half}()"
)
_EACH_S = 0.2


def compile_ahead() -> None:
    """Compile the kernels of the mapper in two processes, unless they are cached already.

    Kernels that remain uncompiled are compiled at their first call.
    """
    from pipeline.jit import others_compile

    if _cores() < len(_HALVES) or is_compiled():
        return
    with _one_at_a_time():
        if not is_compiled():  # by the process that was first
            _compile(others_compile)


def is_compiled() -> bool:
    """Return whether the kernels of both halves are cached for the current sources."""
    from pipeline.jit import is_kept
    from pipeline.tracking.track_classification import judge, nearest_other

    return is_kept(nearest_other) and is_kept(judge)


def _cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _compile(tell: Callable[[], None]) -> None:
    running: list[subprocess.Popen[bytes]] = []
    try:
        for half in _HALVES:
            running.append(_started(half))
        patient_until = time.monotonic() + PATIENCE_S
        while any(process.poll() is None for process in running) and time.monotonic() < patient_until:
            tell()
            time.sleep(_EACH_S)
    finally:
        for process in running:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()


@contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Hold the lock that lets one process of a user compile at a time; the next one then finds the cache.

    Without a folder for the lock or file locks on this system, no process waits.
    """
    from pipeline.jit import others_compile

    with ExitStack() as stack:
        patient_until = time.monotonic() + PATIENCE_S
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            folder = data_folder(os.environ)
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / "compiling.lock").open("a"))
                while not _taken(lock, fcntl.flock, fcntl.LOCK_EX | fcntl.LOCK_NB):
                    if time.monotonic() > patient_until:
                        break
                    others_compile()
                    time.sleep(_EACH_S)
        yield


def _taken(lock: IO[str], take: Callable[[IO[str], int], None], how: int) -> bool:
    try:
        take(lock, how)
    except BlockingIOError:
        return False
    return True


def _started(half: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _PROGRAM.format(parent=os.getpid(), half=half)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C in the terminal is for this process, which then ends its children
    )
