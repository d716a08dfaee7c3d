"""Compiles on two cores what the first scan on a machine would compile on one, while a person waits."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time

#: No machine compiles for so long: something else is wrong, which the mapping itself will say.
PATIENCE_S = 900.0
_HALVES = ("warm_eyes", "warm_map")
_EACH_S = 0.2


def compile_ahead() -> None:
    """Wait until two processes have compiled the mapper's kernels, where nothing is kept of them yet.

    Nothing hangs on them: what they leave undone, or cannot keep, is compiled when it is called.
    """
    from pipeline.compiled import others_compile

    if (os.cpu_count() or 1) < len(_HALVES) or is_compiled():
        return
    running = [_started(half) for half in _HALVES]
    try:
        patient_until = time.monotonic() + PATIENCE_S
        while any(process.poll() is None for process in running) and time.monotonic() < patient_until:
            others_compile()
            time.sleep(_EACH_S)
    finally:
        for process in running:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.wait()


def is_compiled() -> bool:
    """Whether this machine keeps the last kernels of either half, as the sources are now."""
    from pipeline.compiled import is_kept
    from pipeline.gathering.columns import examine
    from pipeline.slam.scan import use_scan

    return is_kept(examine) and is_kept(use_scan)


def _started(half: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-c", f"from app.warming import {half}; {half}()"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C in the terminal is for this program, which then ends them
    )
