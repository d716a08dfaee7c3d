"""Comparison of parameter sets: its plan, its distribution to workers, and the store of its results."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from app.batch.run_folder import read_run, read_run_record
from app.common.text import count
from app.sources.request import SourceRequest, request_of_kept
from app.store.records import contents_of
from app.tuning.grid import PRESET, words_of
from app.tuning.jobs import Job, JobResult, RunWithTruth, code_digest
from app.tuning.scoring import open_run
from app.tuning.workers import Done, Lost, Workers
from pipeline.config import Parameters
from pipeline.config.model import Value, validated
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.remapping import segmentation_key
from pipeline.types.records import TruthTrees

NO_TRUTH = "Give its true trees with --truth trees.csv, in the frame of the map"
MOST_LOSSES = 3  # a job that loses so many workers fails
NOBODY_S = 120.0
_LARGEST_FILE = 1 << 20
_WAIT_S = 1.0


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """A run that can be mapped and scored.

    Attributes:
        name: As the user named it.
        run: The run with its true trees.
        preset: Name of the preset that suits it.
    """

    name: str
    run: RunWithTruth
    preset: str


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


def prepare_run(source: SourceRequest, truth: TruthTrees | None) -> PreparedRun:
    """Open a run, read its true trees and close it. A path in the result is absolute.

    Args:
        source: The run; the URI may be a folder that `stemmap map` wrote, which names its source.
        truth: True trees that replace the source's own; None for these.

    Raises:
        StemmapError: It cannot be read, has no true trees, or the folder's map was made of several sources.
    """
    name, source = source.uri, _source_of(source)
    with closing(open_run(source)) as run:
        trees = truth or run.own_truth
        if trees is None or not len(trees.x):
            raise StemmapError("the run has no true trees", where=name, remedy=NO_TRUTH)
        absolute = msgspec.structs.replace(source, uri=_absolute(source.uri))
        return PreparedRun(name, RunWithTruth(absolute, run.digest, contents_of(trees)), run.preset)


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
    code = code_digest()
    for s, changes in enumerate(sets):
        values = {name: value for name, value in changes.items() if name != PRESET}
        for r, run in enumerate(runs):
            try:
                jobs[s, r] = Job(run.run, base(run, changes).replace(values).model_dump(), code)
            except ParameterError as error:
                left_out[s, r] = error.what
    if not jobs:
        (s, _), why = next(iter(left_out.items()))
        raise ParameterError(f"none of {count(len(sets), 'set')} can be used: {why}", where=words_of(sets[s]))
    return SweepPlan(tuple(runs), tuple(sets), jobs, left_out)


def _source_of(source: SourceRequest) -> SourceRequest:
    """Return the request of a run; for a folder that `stemmap map` wrote, that of its source with the seed,
    topics and mounting of the folder, the requested odometry, and topics and mounting of the request where
    given.

    Raises:
        SourceError: The map of the folder was made of several sources, or its files are damaged.
    """
    folder = Path(source.uri)
    if not (folder / "run.json").is_file():
        return source
    run, record = read_run(folder), read_run_record(folder)
    if record.get("continued"):
        raise SourceError(
            "this map was made of several sources", where=source.uri, remedy="Name the sources themselves"
        )
    kept = request_of_kept(run.uri, odometry=source.odometry, seed=run.seed, choices=record.get("chosen"))
    return msgspec.structs.replace(
        kept, topics=source.topics or kept.topics, mount=source.mount or kept.mount
    )


def _absolute(uri: str) -> str:
    """Return an existing path as an absolute path, because workers run in other folders; other URIs
    unchanged."""
    try:
        path = Path(uri).expanduser()
        return str(path.absolute()) if path.exists() else uri
    except (OSError, RuntimeError, ValueError):
        return uri


class ResultStore:
    """Results on disk, each under the key of its job, so that no job is computed twice.

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

    def _file(self, key: str) -> Path | None:
        """Return the file of a key; None if nothing is stored."""
        return None if self._folder is None else self._folder / key[:2] / f"{key}.json"


@dataclass(slots=True, eq=False)
class SweepResult:
    """The results of all jobs.

    Attributes:
        answers: One result per job, in their order.
        known: Number of results that were stored before.
        lost: Number of workers that were lost during a job, by reason.
        warnings: Messages for people.
    """

    answers: list[JobResult]
    known: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)


def sweep(
    jobs: Sequence[Job],
    workers: Workers,
    kept: ResultStore,
    progress: Callable[[int], object] = lambda _jobs: None,
    nobody_s: float = NOBODY_S,
) -> SweepResult:
    """Compute all jobs, or read their stored results. Equal jobs are computed once. A job that fails has an
    error in its result.

    Args:
        jobs: The jobs; the results have the same order.
        workers: Compute the jobs; the caller closes them.
        kept: Stored results; each new result is added at once.
        progress: Called with the number of jobs that were completed since the last call; first with the
            number of stored results.
        nobody_s: Time without any worker after which the remaining jobs fail [s].

    Raises:
        StemmapError: The workers cannot be reached any more.
    """
    return _Sweep(jobs, workers, kept, progress, nobody_s).run()


class _Sweep:
    """The state of one call of `sweep`, with the same arguments."""

    def __init__(
        self,
        jobs: Sequence[Job],
        workers: Workers,
        kept: ResultStore,
        progress: Callable[[int], object],
        nobody_s: float,
    ) -> None:
        self._jobs, self._workers, self._kept = jobs, workers, kept
        self._progress, self._nobody_s = progress, nobody_s
        self._keys = [job.key() for job in jobs]
        self._answers: dict[int, JobResult] = {}
        self._waiting: dict[bytes, deque[int]] = {}  # by group: jobs that share front-end results
        self._doing: dict[str, int] = {}
        self._groups: dict[str, bytes] = {}  # the last group of each worker
        self._losses = Counter[int]()
        self._unfit: dict[str, set[str]] = {}  # workers that lack a run, by the run's digest
        self._outcome = SweepResult([])

    def run(self) -> SweepResult:
        """Compute all jobs; see `sweep`."""
        first = {key: number for number, key in reversed(list(enumerate(self._keys)))}
        for number in sorted(first.values()):  # equal jobs are computed once
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
            for event in self._workers.events(_WAIT_S):
                self._hear(event)
        self._outcome.answers = [self._answers[first[key]] for key in self._keys]
        self._outcome.warnings += self._storage_warnings()
        return self._outcome

    def _hand_out(self) -> None:
        """Give a waiting job to each free worker that is suitable for one."""
        for worker in self._workers.free():
            group = self._best_group(worker)
            if group is None:
                continue
            number = self._waiting[group].popleft()
            if not self._waiting[group]:
                del self._waiting[group]
            self._doing[worker], self._groups[worker] = number, group
            self._workers.give(worker, self._jobs[number])

    def _best_group(self, worker: str) -> bytes | None:
        """Return the group for a free worker: that of its last job; else one that no other worker has; else
        the largest; None if no remaining job suits the worker."""
        if self._groups.get(worker) in self._waiting:
            return self._groups[worker]
        fit = [
            g
            for g, jobs in self._waiting.items()
            if worker not in self._unfit.get(self._jobs[jobs[0]].run.digest, ())
        ]
        others = {self._groups[w] for w in self._doing}
        return max(fit, key=lambda g: (g not in others, len(self._waiting[g])), default=None)

    def _hear(self, event: Done | Lost) -> None:
        """Process an event: store the result, or queue the job again. An event of a worker without a job is
        ignored."""
        number = self._doing.pop(event.worker, None)
        if number is None:  # it was lost while it had no job; the next job restarts it
            self._groups.pop(event.worker, None)
            return
        if isinstance(event, Lost):
            self._groups.pop(event.worker, None)
            self._lost(number, event.reason)
            return
        answer = event.answer
        if answer.fault in ("worker", "version"):
            self._is_unfit(event.worker, number, answer)
        else:
            self._finish(number, answer)

    def _lost(self, number: int, reason: str) -> None:
        """Count a lost worker; the job is queued again, or fails after `MOST_LOSSES` losses.

        Args:
            number: Number of the job.
            reason: Why the worker was lost.
        """
        self._outcome.lost[reason] += 1
        self._losses[number] += 1
        if self._losses[number] >= MOST_LOSSES:
            ended = f"{count(MOST_LOSSES, 'worker')} were lost during this job; the last one: {reason}"
            self._finish(number, JobResult(None, error=ended, fault="job"))
        else:
            self._again(number)

    def _is_unfit(self, worker: str, number: int, answer: JobResult) -> None:
        """Give a job to other workers. If no worker is suitable, this job and all waiting jobs of its run
        fail.

        Args:
            worker: Name of the worker that refused it.
            number: Number of the job.
            answer: Answer with the reason, which becomes a warning.
        """
        warning = f"{worker}: {answer.error}"
        if warning not in self._outcome.warnings:
            self._outcome.warnings.append(warning)
        digest = self._jobs[number].run.digest
        self._groups.pop(worker, None)
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
        """Queue a job as the next one of its group."""
        self._waiting.setdefault(_group(self._jobs[number]), deque()).appendleft(number)

    def _give_up(self) -> None:
        """Let all waiting jobs fail, because there was no worker."""
        gone = JobResult(None, error=f"no worker was available for {self._nobody_s:.0f} s", fault="worker")
        for number in [n for jobs in self._waiting.values() for n in jobs]:
            self._finish(number, gone)
        self._waiting.clear()

    def _finish(self, number: int, answer: JobResult) -> None:
        """Record the result of a job, store it, and report progress."""
        self._answers[number] = answer
        self._kept.put(self._keys[number], answer)
        self._progress(1)

    def _storage_warnings(self) -> list[str]:
        """Return warnings on stored results that could not be read or written."""
        warnings = []
        if self._kept.damaged:
            warnings.append(f"{count(self._kept.damaged, 'stored result')} could not be read; computed again")
        if self._kept.refusal:
            warnings.append(self._kept.refusal)
        return warnings


def _group(job: Job) -> bytes:
    """Return a key that is equal for jobs that share the results of the front end."""
    return msgspec.json.encode(job.run) + segmentation_key(validated(job.parameters))
