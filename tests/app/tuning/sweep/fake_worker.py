"""A worker for tests: answers each job with its eps, and dies as its seed says.

Run with a folder: of the seed 666 it dies each time, of 13 once, which it writes down there. With the name
of a file too, it writes there what it was asked for. While the folder holds `wait`, it gives no answer.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

from app.tuning.sweep.worker import work
from tests.app.tuning.sweep.scores import scores


def score(text: bytes, folder: Path) -> bytes:
    """The answer to a job, or death."""
    job = json.loads(text)
    seed, eps = job["run"]["seed"], job["parameters"]["clustering"]["eps"]
    died = folder / "died"
    if seed == 666:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 13 and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    for file in sys.argv[2:]:
        with Path(file).open("a", encoding="utf-8") as told:
            told.write(f"{eps}\n")
    while (folder / "wait").exists():
        time.sleep(0.01)
    return json.dumps({"scores": scores(eps), "seconds": 1.0, "looked": True}).encode()


if __name__ == "__main__":
    work(sys.stdin.buffer, sys.stdout.buffer, lambda text: score(text, Path(sys.argv[1])))
