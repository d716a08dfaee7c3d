"""The further processes of a search, watched: one that ends before its time is started again."""

from __future__ import annotations

import os
import subprocess
import sys

import msgspec

from app.tuning.plan import Plan

# -P: a folder that holds a file `app.py` must not decide what runs.
WORKER = (sys.executable, "-P", "-m", "app.tuning.worker")
_MOST_STARTS = 4
_GRACE_S = 2.0


class Helpers:
    """Processes that make trials of the same search.

    Args:
        plan: Of the search; its storage is shared.
        number: How many.

    Attributes:
        lost: How many ended before their time.
    """

    def __init__(self, plan: Plan, number: int) -> None:
        self._plan = msgspec.json.encode(plan)
        self.lost = 0
        self._starts = [1] * number
        self._processes = [self._started(k) for k in range(number)]

    @property
    def pids(self) -> list[int]:
        """Of those that run."""
        return [process.pid for process in self._processes if process.poll() is None]

    def watch(self) -> None:
        """Start again what ended before its time, a few times at most."""
        for k, process in enumerate(self._processes):
            if process.poll() in (None, 0) or self._starts[k] >= _MOST_STARTS:
                continue
            self.lost += 1
            self._starts[k] += 1
            self._processes[k] = self._started(k)

    def close(self) -> None:
        """End them."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            try:
                process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _started(self, k: int) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [*WORKER, str(k + 1), str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the process that watches
        )
        assert process.stdin is not None  # noqa: S101 - it was asked for
        try:
            process.stdin.write(self._plan)
            process.stdin.close()
        except BrokenPipeError:  # it ended at once, which `watch` sees
            pass
        return process
