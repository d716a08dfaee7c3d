"""A worker for tests that answers each job with the value of its clustering.eps and ends as the seed says.

The argument is a folder: a job with seed 666 kills the worker each time, one with seed 13 only once, which a
file in the folder records. A second argument names a file that gets the values of the jobs. While the folder
contains `wait`, no answer is sent.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from app.common.child_process import ParentConnection, run_child
from tests.app.extensions.search.scores import scores


def score(job: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The answer to a job."""
    seed, eps = job["run"]["source"]["seed"], job["parameters"]["clustering"]["eps"]
    died = folder / "died"
    if seed == 666:
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 13 and not died.exists():
        died.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    for file in sys.argv[2:]:
        with Path(file).open("a", encoding="utf-8") as log:
            log.write(f"{eps}\n")
    while (folder / "wait").exists():
        time.sleep(0.01)
    return {"scores": scores(eps), "scans": 10, "trees": 3, "seconds": 1.0, "looked": True}


def work(parent: ParentConnection) -> None:
    """Answer jobs until the parent ends."""
    while True:
        parent.send(score(parent.receive(dict), Path(sys.argv[1])))


if __name__ == "__main__":
    run_child(work)
