"""A worker for tests: answers each job with its eps, and dies as its seed says.

Run with a folder: of the seed 666 it dies each time, of 13 once, which it writes down there. With the name
of a file too, it writes there what it was asked for. While the folder holds `wait`, it gives no answer.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import msgspec

from app.sweeping.jobs import Answer, Job
from app.sweeping.worker import work
from tests.sweeping.jobs import scores


def score(text: bytes, folder: Path) -> bytes:
    """The answer to a job, or death."""
    job = msgspec.json.decode(text, type=Job)
    died = folder / "died"
    if job.run.seed == 666:
        os.kill(os.getpid(), signal.SIGKILL)
    if job.run.seed == 13 and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    for file in sys.argv[2:]:
        with Path(file).open("a", encoding="utf-8") as told:
            told.write(f"{job.parameters['clustering']['eps']}\n")
    while (folder / "wait").exists():
        time.sleep(0.01)
    return msgspec.json.encode(Answer(scores(job.parameters["clustering"]["eps"]), 1.0, looked=True))


if __name__ == "__main__":
    work(sys.stdin.buffer, sys.stdout.buffer, lambda text: score(text, Path(sys.argv[1])))
