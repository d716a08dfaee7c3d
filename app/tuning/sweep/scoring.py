"""Worker of a comparison: maps and scores one job after the other.

It runs as `python -m app.tuning.sweep.scoring`, with a job per line and a result per line, or as a function
on the workers of a Dask cluster. The last run stays open, so that its front end runs once for all sets that
do not change it.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import msgspec

import pipeline.jit
from app.batch.summary import far_truth
from app.common.child_process import ParentConnection, run_child
from app.training.learned_forests import kept_forests
from app.tuning.scored_runs import OpenRun, open_run
from app.tuning.sweep.jobs import Fault, Job, JobResult, RunWithTruth, code_digest
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError, StemmapError
from pipeline.jit import on_compiling


class NotHereError(StemmapError):
    """The recording or the random forest is missing on this worker; another worker may have it."""


class Scorer:
    """Scores jobs; the run of the last job stays open."""

    def __init__(self) -> None:
        self._requested: RunWithTruth | None = None
        self._run: OpenRun | None = None

    def score(self, job: Job) -> JobResult:
        """Return the result of a job; an exception becomes its `error`."""
        if job.code != code_digest():
            other = f"this worker has stemmap {code_digest()}, the job comes from {job.code}"
            return JobResult(None, error=f"{other}. Install the same version on both", fault="version")
        begun = time.perf_counter()
        try:
            parameters = validated(job.parameters)
            _check_forest(parameters)
            scores, front_end_ran = self._score(job.run, parameters)
        except NotHereError as error:
            return _failed(str(error), "worker")
        except StemmapError as error:
            return _failed(str(error))
        except MemoryError:
            return _failed("this needs more memory than the machine has")
        except Exception as error:  # a fault with one set must not end the others
            return _failed(f"this is a fault in stemmap: {type(error).__name__}: {error}")
        return JobResult(scores, time.perf_counter() - begun, front_end_ran)

    def close(self) -> None:
        """Close the run."""
        if self._run is not None:
            self._run.close()
        self._run = self._requested = None

    def _score(self, requested: RunWithTruth, parameters: Parameters) -> tuple[dict[str, Any], bool]:
        if self._run is None or self._requested != requested:
            self.close()
            self._run, self._requested = _open(requested), requested
        mapped = self._run.map(parameters)
        evaluation = mapped.evaluate(requested.truth.trees(), parameters)
        if evaluation.TA.of + evaluation.TR.of == 0:
            raise StemmapError(far_truth(evaluation.reach))
        scores = {**asdict(evaluation), "scans": mapped.scans, "trees": len(mapped.trees.number)}
        return scores, mapped.front_end_ran


_scorer = Scorer()  # of a process that gets one job after the other
_scorer_lock = threading.Lock()  # a worker of a cluster may have several threads


def score_json(text: bytes) -> bytes:
    """Return the result of a job, both as JSON."""
    try:
        job = msgspec.json.decode(text, type=Job)
    except msgspec.MsgspecError as error:
        return msgspec.json.encode(_failed(f"this is not a job: {error}", "version"))
    with _scorer_lock, one_compiler_at_a_time():
        return msgspec.json.encode(_scorer.score(job))


@contextlib.contextmanager
def one_compiler_at_a_time() -> Iterator[None]:
    """Inside, a kernel that must be compiled waits until no other worker of this machine compiles. The second
    worker then finds the compiled kernel."""
    with contextlib.ExitStack() as stack:
        held: list[IO[bytes]] = []

        def wait() -> None:
            if not held:
                held.append(stack.enter_context(Path(pipeline.jit.__file__).open("rb")))
                _lock(held[0])

        with on_compiling(wait):
            yield


def _lock(file: IO[bytes]) -> None:
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX)


def _open(requested: RunWithTruth) -> OpenRun:
    try:
        run = open_run(requested.source)
    except ParameterError:
        raise
    except StemmapError as error:
        raise NotHereError(error.what, where=error.where, remedy=error.remedy) from None
    if run.digest != requested.digest:
        run.close()
        raise NotHereError(
            "this worker has another recording of that name",
            where=requested.source.uri,
            remedy="All workers must have the same file at this place",
        )
    return run


def _check_forest(parameters: Parameters) -> None:
    """Learned random forests are in the data folder of each machine."""
    try:
        kept_forests().check(parameters)
    except StemmapError as error:
        raise NotHereError(error.what, where=error.where, remedy=error.remedy) from None


def _failed(error: str, fault: Fault = "job") -> JobResult:
    return JobResult(None, error=error, fault=fault)


def work(parent: ParentConnection) -> None:
    """Receive jobs and send their results until the parent ends."""
    while True:
        parent.send(msgspec.Raw(score_json(bytes(parent.receive(msgspec.Raw)))))


if __name__ == "__main__":
    run_child(work, low_priority="--low-priority" in sys.argv[1:])
