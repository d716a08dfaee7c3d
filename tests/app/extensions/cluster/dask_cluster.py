"""A Dask scheduler with workers on this machine, as programs of their own; for tests and the benchmark."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[4]
_PATIENCE_S = 60.0


@contextmanager
def dask_cluster(folder: Path, workers: int = 2) -> Iterator[str]:
    """Yield the address of a scheduler when its workers, of one thread each, have arrived; all end with the
    context.

    Args:
        folder: Folder for their files.
        workers: Number of workers.
    """
    contact = folder / "scheduler.json"
    with ExitStack() as stack:

        def start(program: str, *words: str) -> None:
            log = stack.enter_context((folder / f"{program}.log").open("w"))
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *words],
                stdout=log,
                stderr=log,
                cwd=ROOT,
            )
            stack.callback(_end, process)

        def wait_for(text: str, count: int, file: Path) -> None:
            until = time.monotonic() + _PATIENCE_S
            while not file.exists() or file.read_text().count(text) < count:
                assert time.monotonic() < until, [log.read_text() for log in folder.glob("*.log")]
                time.sleep(0.1)

        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(contact))
        wait_for('"address"', 1, contact)
        start(
            "dask_worker", "--scheduler-file", str(contact), "--host", "127.0.0.1", "--nthreads", "1",
            "--nworkers", str(workers), "--local-directory", str(folder / "work"),
        )  # fmt: skip
        wait_for("Register worker", workers, folder / "dask_scheduler.log")
        yield json.loads(contact.read_text())["address"]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program, by force if it does not follow."""
    process.terminate()
    try:
        process.wait(_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def end_one_process(task: bytes) -> bytes:
    """Kill the process of a worker, but only for the first task that names a file; return the task."""
    file = Path(task.decode())
    try:
        file.touch(exist_ok=False)
    except FileExistsError:
        return task
    os.kill(os.getpid(), 9)
    return b""


def end_the_worker(task: bytes) -> bytes:
    """Kill the process of a worker and its parent, which would start another one."""
    os.kill(os.getppid(), 9)
    os.kill(os.getpid(), 9)
    return task


def fail(task: bytes) -> bytes:
    """Raise an error."""
    raise ValueError(task.decode())
