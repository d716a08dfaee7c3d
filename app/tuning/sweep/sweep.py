"""Has all jobs done: what is known already is not done again, and who is lost on the way is replaced."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import msgspec

from app.common.text import count
from app.tuning.sweep.checking import is_answer
from app.tuning.sweep.jobs import Answer, Job
from app.tuning.sweep.kept_answers import KeptAnswers
from app.tuning.sweep.workers import Done, Lost, Workers
from pipeline.config.model import validated
from pipeline.remapping import look_key

MOST_LOSSES = 3  # workers that a job may take along before it is taken for the reason
NOBODY_S = 120.0  # so long nobody may be there
_LOOK_S = 1.0


@dataclass(slots=True, eq=False)
class Outcome:
    """What came of the jobs.

    Attributes:
        answers: One a job, in their order.
        known: How many were known from before.
        lost: How often a worker was lost in the middle of a job, by reason.
    """

    answers: list[Answer]
    known: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)


def sweep(
    jobs: Sequence[Job],
    workers: Workers,
    kept: KeptAnswers,
    progress: Callable[[int], object] = lambda _jobs: None,
    nobody_s: float = NOBODY_S,
) -> Outcome:
    """The answers to all jobs.

    Args:
        jobs: In the order of the answers.
        workers: Do them; closed by whoever made them.
        kept: Asked before, and told of each answer at once.
        progress: Told how many jobs more are done.
        nobody_s: After so long without a single worker what is left fails.
    """
    return _Sweep(jobs, workers, kept, progress, nobody_s).run()


class _Sweep:
    def __init__(
        self,
        jobs: Sequence[Job],
        workers: Workers,
        kept: KeptAnswers,
        progress: Callable[[int], object],
        nobody_s: float,
    ) -> None:
        self._jobs, self._workers, self._kept = jobs, workers, kept
        self._progress, self._nobody_s = progress, nobody_s
        self._keys = [job.key() for job in jobs]
        self._answers: dict[int, Answer] = {}
        self._waiting: dict[bytes, deque[int]] = {}  # by what can share the scans that were looked at
        self._doing: dict[str, int] = {}
        self._looked: dict[str, bytes] = {}  # what each worker did last
        self._losses = Counter[int]()
        self._unfit: dict[str, set[str]] = {}  # workers by the digest of a run that they do not have
        self._outcome = Outcome([])

    def run(self) -> Outcome:
        first = {key: number for number, key in reversed(list(enumerate(self._keys)))}
        for number in sorted(first.values()):  # jobs that are the same are done once
            job = self._jobs[number]
            answer = self._kept.get(self._keys[number])
            if answer is None:
                self._waiting.setdefault(_group(job), deque()).append(number)
            else:
                self._answers[number] = answer
        self._outcome.known = len(self._answers)
        self._progress(len(self._answers))
        somebody_at = time.monotonic()
        while self._waiting or self._doing:
            self._hand_out()
            now = time.monotonic()
            if self._doing:
                somebody_at = now
            elif now > somebody_at + self._nobody_s:
                self._give_up()
                break
            for event in self._workers.told(_LOOK_S):
                self._hear(event)
        self._outcome.answers = [self._answers[first[key]] for key in self._keys]
        self._outcome.warnings += self._told_of_keeping()
        return self._outcome

    def _hand_out(self) -> None:
        for worker in self._workers.free():
            group = self._best_group(worker)
            if group is None:
                continue
            number = self._waiting[group].popleft()
            if not self._waiting[group]:
                del self._waiting[group]
            self._doing[worker], self._looked[worker] = number, group
            self._workers.give(worker, msgspec.json.encode(self._jobs[number]))

    def _best_group(self, worker: str) -> bytes | None:
        """What it looked at last; else what nobody else is at; else what most is left of."""
        if self._looked.get(worker) in self._waiting:
            return self._looked[worker]
        fit = [g for g, jobs in self._waiting.items() if worker not in self._unfit_for(jobs[0])]
        others = {self._looked[w] for w in self._doing}
        return max(fit, key=lambda g: (g not in others, len(self._waiting[g])), default=None)

    def _unfit_for(self, number: int) -> set[str]:
        return self._unfit.get(self._jobs[number].run.digest, set())

    def _hear(self, event: Done | Lost) -> None:
        number = self._doing.pop(event.worker, None)
        if number is None:  # it was lost while it waited; the next job starts it anew
            self._looked.pop(event.worker, None)
            return
        if isinstance(event, Lost):
            self._looked.pop(event.worker, None)
            self._lost(number, event.reason)
            return
        try:
            answer = msgspec.json.decode(event.answer, type=Answer)
        except msgspec.MsgspecError:
            answer = Answer(None)
        if not is_answer(answer):
            self._lost(number, "it answered something that is no answer")
            return
        if answer.fault in ("worker", "version"):
            self._is_unfit(event.worker, number, answer)
        else:
            self._finish(number, answer)

    def _lost(self, number: int, reason: str) -> None:
        self._outcome.lost[reason] += 1
        self._losses[number] += 1
        if self._losses[number] >= MOST_LOSSES:
            ended = f"{count(MOST_LOSSES, 'worker')} ended in the middle of it, the last because {reason}"
            self._finish(number, Answer(None, error=ended, fault="job"))
        else:
            self._again(number)

    def _is_unfit(self, worker: str, number: int, answer: Answer) -> None:
        """Leave the job, and its like, to others; where there are none, it fails as it did here."""
        told = f"{worker}: {answer.error}"
        if told not in self._outcome.warnings:
            self._outcome.warnings.append(told)
        digest = self._jobs[number].run.digest
        self._looked.pop(worker, None)
        self._unfit.setdefault(digest, set()).add(worker)
        present = set(self._workers.free()) | set(self._doing)
        if present <= self._unfit[digest]:
            alike = [n for jobs in self._waiting.values() for n in jobs if self._jobs[n].run.digest == digest]
            self._waiting = {g: jobs for g, jobs in self._waiting.items() if jobs[0] not in alike}
            for each in [number, *alike]:
                self._finish(each, answer)
        else:
            self._again(number)

    def _again(self, number: int) -> None:
        self._waiting.setdefault(_group(self._jobs[number]), deque()).appendleft(number)

    def _give_up(self) -> None:
        gone = Answer(None, error=f"no worker was there for {self._nobody_s:.0f} s", fault="worker")
        for number in [n for jobs in self._waiting.values() for n in jobs]:
            self._finish(number, gone)
        self._waiting.clear()

    def _finish(self, number: int, answer: Answer) -> None:
        self._answers[number] = answer
        self._kept.put(self._keys[number], answer)
        self._progress(1)

    def _told_of_keeping(self) -> list[str]:
        told = []
        if self._kept.damaged:
            told.append(f"{count(self._kept.damaged, 'kept result')} could not be read and came anew")
        if self._kept.refusal:
            told.append(self._kept.refusal)
        return told


def _group(job: Job) -> bytes:
    """The same where two jobs look at the same scans in the same way."""
    return msgspec.json.encode(job.run) + look_key(validated(job.parameters))
