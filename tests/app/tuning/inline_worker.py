"""A worker of a search or a comparison that scores each job in this process."""

from __future__ import annotations

from collections.abc import Callable

from app.tuning.jobs import Job, JobResult
from app.tuning.scoring import Scorer
from app.tuning.workers import Done, Event, Lost


class InlineWorker:
    """A single worker; `does` gives the answer, or why the worker is lost. By default the run is mapped."""

    def __init__(self, does: Callable[[Job], JobResult | str] | None = None) -> None:
        self._scorer = Scorer(runs=8)
        self._does = does or self._scorer.score
        self._events: list[Event] = []

    def free(self) -> list[str]:
        return [] if self._events else ["here"]

    def give(self, worker: str, job: Job) -> None:
        answer = self._does(job)
        self._events.append(Lost(worker, answer) if isinstance(answer, str) else Done(worker, answer))

    def events(self, _timeout_s: float, /) -> list[Event]:
        events, self._events = self._events, []
        return events

    def close(self) -> None:
        self._scorer.close()
