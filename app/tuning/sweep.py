"""Comparison of parameter sets: its plan, the order of its jobs, and the store of its results."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from app.common.text import count
from app.tuning.grid import PRESET, words_of
from app.tuning.jobs import Job, JobResult, code_digest
from app.tuning.scoring import PreparedRun
from app.tuning.workers import ScoringProcesses
from pipeline.config import Parameters
from pipeline.config.model import Value, validated
from pipeline.errors import ParameterError, StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.remapping import segmentation_key

_LARGEST_FILE = 1 << 20


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """All jobs of a comparison.

    Attributes:
        runs: The runs, in the order in which they were named.
        sets: The combinations of parameter values.
        jobs: Jobs by number of the set and of the run.
        left_out: Sets whose values contradict one another for a run, by the same numbers, with the reason.
    """

    runs: tuple[PreparedRun, ...]
    sets: tuple[dict[str, Value], ...]
    jobs: dict[tuple[int, int], Job]
    left_out: dict[tuple[int, int], str]


def plan_jobs(
    runs: Sequence[PreparedRun],
    sets: Sequence[dict[str, Value]],
    base: Callable[[PreparedRun, dict[str, Value]], Parameters],
) -> SweepPlan:
    """Return the jobs of all sets and runs. Combinations that contradict themselves are left out, with the
    reason.

    Args:
        runs, sets: What is combined.
        base: Returns the parameters that a combination changes, for a run; may raise ParameterError.

    Raises:
        ParameterError: Every set contradicts itself for every run.
    """
    jobs: dict[tuple[int, int], Job] = {}
    left_out: dict[tuple[int, int], str] = {}
    for s, changes in enumerate(sets):
        values = {name: value for name, value in changes.items() if name != PRESET}
        for r, run in enumerate(runs):
            try:
                jobs[s, r] = Job(run.run, base(run, changes).replace(values).model_dump())
            except ParameterError as error:
                left_out[s, r] = error.what
    if not jobs:
        (s, _), why = next(iter(left_out.items()))
        raise ParameterError(f"none of {count(len(sets), 'set')} can be used: {why}", where=words_of(sets[s]))
    return SweepPlan(tuple(runs), tuple(sets), jobs, left_out)


class ResultStore:
    """Results on disk, each under the key of its job and of the code, so that no job is computed twice.

    Args:
        folder: Folder with one file per result; None stores nothing.

    Attributes:
        damaged: Number of files that could not be read; their results are computed again.
        refusal: Reason why nothing is written any more; empty otherwise.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.damaged = 0
        self.refusal = ""

    def get(self, key: str) -> JobResult | None:
        """Return the result of the job with this key; None if it is not stored, is larger than 1 MB or cannot
        be read. A file that cannot be used counts in `damaged`."""
        file = self._file(key)
        if file is None:
            return None
        try:
            if file.stat().st_size <= _LARGEST_FILE:
                answer = msgspec.json.decode(file.read_bytes(), type=JobResult)
                if answer.scores is not None:
                    return answer
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError):
            pass
        self.damaged += 1
        return None

    def put(self, key: str, answer: JobResult) -> None:
        """Store a result that has scores, in place of an earlier one. Failures are not stored, because they
        may not happen again. After a disk error nothing is written any more, and `refusal` has the reason;
        nothing is raised."""
        file = self._file(key)
        if file is None or answer.scores is None or self.refusal:
            return
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with write_beside(file) as partial:
                partial.write_bytes(msgspec.json.encode(answer))
        except (OSError, StemmapError) as error:
            why = getattr(error, "strerror", None) or str(error)
            self.refusal = f"results are not stored for later: {why}"

    def warnings(self) -> list[str]:
        """Return warnings on stored results that could not be read or written."""
        unread = f"{count(self.damaged, 'stored result')} could not be read; computed again"
        return [*([unread] if self.damaged else []), *([self.refusal] if self.refusal else [])]

    def _file(self, key: str) -> Path | None:
        """Return the file of a job by its key; None if nothing is stored."""
        if self._folder is None:
            return None
        name = hashlib.sha256(f"{code_digest()} {key}".encode()).hexdigest()
        return self._folder / name[:2] / f"{name}.json"


@dataclass(slots=True, eq=False)
class SweepResult:
    """The results of all jobs.

    Attributes:
        answers: One result per job, in their order.
        known: Number of results that were stored before.
        warnings: Messages for people.
    """

    answers: list[JobResult]
    known: int = 0
    warnings: list[str] = field(default_factory=list)


def sweep(
    jobs: Sequence[Job],
    processes: ScoringProcesses[int],
    kept: ResultStore,
    progress: Callable[[int], object] = lambda _jobs: None,
) -> SweepResult:
    """Compute all jobs, or read their stored results. Equal jobs are computed once. A job that fails has an
    error in its result.

    Args:
        jobs: The jobs; the results have the same order.
        processes: Compute the jobs; the caller closes them.
        kept: Stored results; each new result is added at once.
        progress: Called with the number of jobs that were completed since the last call; first with the
            number of stored results.

    Raises:
        StemmapError: No process can be started.
    """
    keys = [job.key() for job in jobs]
    first = {key: number for number, key in reversed(list(enumerate(keys)))}
    answers: dict[int, JobResult] = {}
    waiting: dict[bytes, deque[int]] = {}  # by group: jobs that share the results of the front end
    for number in sorted(first.values()):
        answer = kept.get(keys[number])
        if answer is None:
            waiting.setdefault(_group(jobs[number]), deque()).append(number)
        else:
            answers[number] = answer
    known = len(answers)
    progress(known)
    group_of: dict[int, bytes] = {}  # the last group of each process

    def next_job(worker: int) -> tuple[int, Job] | None:
        """Return a job of the last group of a process, else of one that no other process has, else of the
        largest group."""
        if group_of.get(worker) not in waiting:
            others = set(group_of.values())
            group_of[worker] = max(waiting, key=lambda g: (g not in others, len(waiting[g])), default=b"")
        group = group_of[worker]
        if group not in waiting:
            return None
        number = waiting[group].popleft()
        if not waiting[group]:
            del waiting[group]
        return number, jobs[number]

    while len(answers) < len(first):
        for number, answer in processes.advance(next_job):
            answers[number] = answer
            kept.put(keys[number], answer)
            progress(1)
    return SweepResult([answers[first[key]] for key in keys], known, kept.warnings())


def _group(job: Job) -> bytes:
    """Return a key that is equal for jobs that share the results of the front end."""
    return msgspec.json.encode(job.run) + segmentation_key(validated(job.parameters))
