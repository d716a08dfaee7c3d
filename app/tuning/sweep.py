"""Comparison of parameter sets: its plan, and the order of its jobs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec

from app.common.text import count
from app.tuning.grid import PRESET, words_of
from app.tuning.jobs import Job, JobResult
from app.tuning.scoring import PreparedRun
from app.tuning.workers import ScoringProcesses
from pipeline.config import Parameters
from pipeline.config.model import Value, validated
from pipeline.errors import ParameterError
from pipeline.remapping import segmentation_key


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


def sweep(
    jobs: Sequence[Job],
    processes: ScoringProcesses[int],
    progress: Callable[[int], object] = lambda _jobs: None,
) -> list[JobResult]:
    """Compute all jobs, or read their stored results; return the results in the order of the jobs. A job that
    fails has an error in its result.

    Args:
        jobs: The jobs.
        processes: Compute the jobs; the caller closes them.
        progress: Called with 1 for each job that was completed.

    Raises:
        StemmapError: No process can be started.
    """
    answers: dict[int, JobResult] = {}
    waiting: dict[bytes, deque[int]] = {}  # by group: jobs that share the results of the front end
    for number, job in enumerate(jobs):
        waiting.setdefault(_group(job), deque()).append(number)
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

    while len(answers) < len(jobs):
        for number, answer in processes.advance(next_job):
            answers[number] = answer
            progress(1)
    return [answers[number] for number in range(len(jobs))]


def _group(job: Job) -> bytes:
    """Return a key that is equal for jobs that share the results of the front end."""
    return msgspec.json.encode(job.run) + segmentation_key(validated(job.parameters))
