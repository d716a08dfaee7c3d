"""Scoring processes of a search or a comparison that score each job in this process."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from app.extensions.search.jobs import Job, JobResult, ResultStore, ScoringProcesses
from app.extensions.search.scoring import Scorer


class InlineProcesses(ScoringProcesses[Any]):
    """Some workers in this process; `does` gives the result of a job for a worker. By default the run is
    mapped.

    Attributes:
        done: Workers and their jobs.
    """

    def __init__(
        self,
        does: Callable[[int, Job], JobResult] | None = None,
        count: int = 1,
        kept: ResultStore | None = None,
    ) -> None:
        super().__init__(count, ("false",), kept)
        self._scorer = Scorer(runs=8)
        self._does = does or (lambda _worker, job: self._scorer.score(job))
        self.done: list[tuple[int, Job]] = []

    def submit(self, job: Job, worker: int = 0) -> Future[JobResult]:
        future: Future[JobResult] = Future()
        future.set_result(self._known_or_computed(worker, job))
        return future

    def _compute(self, worker: int, job: Job) -> JobResult:
        self.done.append((worker, job))
        return self._does(worker, job)

    def close(self) -> None:
        super().close()
        self._scorer.close()
