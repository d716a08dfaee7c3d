"""The child processes that score jobs, for a comparison of sets, a search and a sensitivity curve."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

from app.common.child_process import BlockingChildProcess, ProtocolError, exit_reason, python_module
from app.tuning.jobs import Job, JobResult
from pipeline.errors import StemmapError

COMMAND = python_module("app.tuning.scoring")
MOST_LOSSES = 3  # a job that loses so many processes fails

T = TypeVar("T")


class LostError(StemmapError):
    """Every process that computed a job ended before it sent a result."""


class ScoringProcesses(Generic[T]):
    """Processes that compute one job at a time each. A process starts with its first job; one that is lost is
    replaced and computes the job again.

    Args:
        count: Number of processes, at least 1.
        command: Program and arguments of a process; empty for `app.tuning.scoring`.

    Attributes:
        lost: Number of processes that ended during a job, by reason.
    """

    def __init__(self, count: int, command: Sequence[str] = ()) -> None:
        self.lost = Counter[str]()
        self._command, self._count = command or COMMAND, count
        self._children: dict[int, BlockingChildProcess] = {}
        self._threads = ThreadPoolExecutor(count, "scoring")
        self._doing: dict[Future[JobResult], tuple[int, T]] = {}
        self._lock = threading.Lock()
        self._is_closed = False

    def advance(
        self, next_job: Callable[[int], tuple[T, Job] | None], wait_s: float | None = None
    ) -> list[tuple[T, JobResult]]:
        """Give a job to each free process, wait for the first result, and return the results since the last
        call. A job whose processes were lost has an error as result.

        Args:
            next_job: Returns the next job for the process with this number, and what identifies it in the
                result; None if there is none now.
            wait_s: Longest wait [s]; None for no limit. Without jobs in progress there is no wait.

        Raises:
            StemmapError: No process can be started.
        """
        busy = {worker for worker, _ in self._doing.values()}
        for worker in range(self._count):
            following = None if worker in busy else next_job(worker)
            if following is not None:
                self._doing[self.submit(following[1], worker)] = (worker, following[0])
        done, _ = wait(self._doing, wait_s, FIRST_COMPLETED)
        return [(self._doing.pop(future)[1], _result(future)) for future in done]

    def submit(self, job: Job, worker: int = 0) -> Future[JobResult]:
        """Start a job on a process that is free. The result raises LostError after `MOST_LOSSES` lost
        processes, and StemmapError if no process can be started."""
        return self._threads.submit(self._compute, worker, job)

    def close(self) -> None:
        """End all processes and wait for their threads."""
        with self._lock:
            self._is_closed = True
            for child in self._children.values():
                child.end()
        self._threads.shutdown()

    def _compute(self, worker: int, job: Job) -> JobResult:
        """Return the result of a job; see `submit`. Runs in a thread."""
        reason = ""
        for _ in range(MOST_LOSSES):
            child = self._child(worker)
            try:
                child.send(job)
                result = child.receive(JobResult)
                if result is not None:
                    return result
                reason = exit_reason(child.end(1.0))
            except ProtocolError as error:
                child.end()
                reason = error.what
            with self._lock:
                self.lost[reason] += 1
        raise LostError(f"{MOST_LOSSES} processes were lost during this job; the last one: {reason}")

    def _child(self, worker: int) -> BlockingChildProcess:
        """Return the running process with this number, started if necessary; raises LostError after
        `close`."""
        with self._lock:
            if self._is_closed:
                raise LostError("the processes were ended")
            child = self._children.get(worker)
            if child is None or child.returncode is not None:
                child = self._children[worker] = BlockingChildProcess(self._command, one_thread=True)
            return child


def _result(future: Future[JobResult]) -> JobResult:
    """Return the result of a future that is done; the loss of its processes becomes the error of a result."""
    try:
        return future.result()
    except LostError as error:
        return JobResult(None, error=error.what)
