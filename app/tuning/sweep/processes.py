"""Workers that are processes of this machine."""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import IO

from app.tuning.sweep.workers import Done, Lost, Told

# -P: a folder that holds a file `app.py` must not decide what runs.
WORKER = (sys.executable, "-P", "-m", "app.tuning.sweep.worker")
# The processes share the cores; libraries that each take all of them only stand in one another's way.
_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class Processes:
    """So many processes, each started when it gets its first job, and anew when it has ended.

    Args:
        count: How many.
        command: What to start.
    """

    def __init__(self, count: int, command: Sequence[str] = WORKER) -> None:
        self._command = command
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._readers: dict[str, threading.Thread] = {}
        self._free = [f"process {k + 1}" for k in range(count)]
        self._events: queue.Queue[Told] = queue.Queue()

    def free(self) -> list[str]:
        """Those that wait for a job."""
        return list(self._free)

    def give(self, worker: str, job: bytes) -> None:
        """Give it a job, and start it where it does not run."""
        self._free.remove(worker)
        process = self._running.get(worker)
        if process is None:
            process = self._running[worker] = self._started(worker)
        assert process.stdin is not None  # noqa: S101 - it was asked for
        with contextlib.suppress(BrokenPipeError):  # its end is told by whoever reads its answers
            process.stdin.write(job + b"\n")
            process.stdin.flush()

    def told(self, patience_s: float) -> list[Told]:
        """What came meanwhile."""
        events: list[Told] = []
        with contextlib.suppress(queue.Empty):
            events.append(self._events.get(timeout=patience_s))
            while True:
                events.append(self._events.get_nowait())
        for event in events:
            if isinstance(event, Lost):
                self._buried(event.worker)
            if event.worker not in self._free:  # one that waited may end too
                self._free.append(event.worker)
        return events

    def close(self) -> None:
        """End all of them."""
        for worker in list(self._running):
            self._buried(worker)

    def _started(self, worker: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in the terminal is for this program, which then ends them
            env={**_ONE_CORE, **os.environ},
        )
        assert process.stdout is not None  # noqa: S101
        reader = threading.Thread(target=self._read, args=(worker, process, process.stdout), daemon=True)
        reader.start()
        self._readers[worker] = reader
        return process

    def _read(self, worker: str, process: subprocess.Popen[bytes], answers: IO[bytes]) -> None:
        with answers:
            for line in answers:
                if line.endswith(b"\n"):  # else it ended while it wrote
                    self._events.put(Done(worker, line[:-1]))
        code = process.wait()
        if self._running.get(worker) is process:
            self._events.put(
                Lost(worker, f"it was ended by signal {-code}" if code < 0 else f"exit code {code}")
            )

    def _buried(self, worker: str) -> None:
        process = self._running.pop(worker, None)
        if process is None:
            return
        process.kill()
        self._readers.pop(worker).join()
        with contextlib.suppress(BrokenPipeError):
            assert process.stdin is not None  # noqa: S101
            process.stdin.close()
