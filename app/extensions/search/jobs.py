"""Jobs: a run with its true trees that is mapped and scored with one parameter set; the child processes that
compute jobs, for a comparison of sets, a search and a sensitivity curve; and the store of their results.

Jobs and results are sent to the scoring processes and back as JSON: paths, parameters and scores, never point
clouds.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from app.batch.summary import far_truth
from app.common.child_process import (
    BlockingChildProcess,
    ChildError,
    ProtocolError,
    exit_reason,
    python_module,
)
from app.common.task_pool import TaskPool
from app.common.text import code_digest, count
from app.sources.live_address import is_live
from app.sources.request import SourceRequest
from app.store.records import Content, contents_of
from pipeline.errors import StemmapError
from pipeline.evaluation import MapScores
from pipeline.io.atomic_files import write_beside
from pipeline.types.records import TruthTrees


class RunWithTruth(msgspec.Struct, frozen=True):
    """A run that is mapped and scored.

    Attributes:
        source: Source, and how it is mapped.
        digest: SHA-256 of the source; another digest means that another recording is at the path.
        truth: True trees in the frame of the map.
    """

    source: SourceRequest
    digest: str
    truth: list[Content]

    @classmethod
    def shown(cls, source: SourceRequest, digest: str, truth: TruthTrees | None) -> RunWithTruth:
        """Return the open run, after a check that it can be mapped again and scored.

        Args:
            source, digest: The open run; the digest is empty if none is open.
            truth: True trees of the run, with the annotations; None if none are known.

        Raises:
            StemmapError: No run is open, it is live, or its truth has no tree.
        """
        if not digest:
            raise StemmapError("no run is open", remedy="Open one")
        if is_live(source.uri):
            raise StemmapError(
                "a live run cannot be mapped again", where=source.uri, remedy="Open its recording"
            )
        if truth is None or "tree" not in truth.kind:
            raise StemmapError(
                "no true trees are known of this run", remedy="Annotate some in the tab Annotate"
            )
        return cls(source.request(), digest, contents_of(truth))


class Job(msgspec.Struct, frozen=True):
    """A run with one parameter set.

    Attributes:
        run: The run.
        parameters: Dict from stages to dicts from names to values, with all parameters.
    """

    run: RunWithTruth
    parameters: dict[str, dict[str, Any]]

    def key(self) -> str:
        """Return a SHA-256 (hex) of all that determines the scores except the code, without the path of the
        recording."""
        source = msgspec.structs.replace(self.run.source, uri="")
        placeless = msgspec.structs.replace(self, run=msgspec.structs.replace(self.run, source=source))
        return hashlib.sha256(msgspec.json.encode(placeless, order="sorted")).hexdigest()


class JobResult(msgspec.Struct, frozen=True):
    """The result of a job.

    Attributes:
        scores: Scores of the map; None after a failure.
        scans, trees: Number of scans (0 without a drive), and of confirmed trees in the map.
        seconds: Computing time [s].
        looked: Whether the front end ran; False if its cached results were used.
        error: Reason of the failure.
    """

    scores: MapScores | None
    scans: int = 0
    trees: int = 0
    seconds: float = 0.0
    looked: bool = False
    error: str = ""

    @property
    def problem(self) -> str:
        """Reason why the scores have no meaning, for people: a failure, or no ground truth near the path;
        empty otherwise."""
        if self.scores is not None and self.scores.TA.of + self.scores.TR.of == 0:
            return far_truth(self.scores.reach)
        return self.error


COMMAND = python_module("app.extensions.search.scoring")
MOST_LOSSES = 3  # a job that loses so many processes fails
_LARGEST_FILE = 1 << 20  # bytes of a stored result
MOST_FILES = 20_000  # stored results, 80 MB in blocks of 4 kB; a search has some hundred to thousand

T = TypeVar("T")


class LostError(StemmapError):
    """A job has no result: MOST_LOSSES processes ended or sent damaged messages during it, or the processes
    were closed."""


class ResultStore:
    """Results by the key of their job and the digest of the code, so that no job is computed twice: in files,
    or without a folder in memory. Threads may use one store; two of them may store the same result.

    Before the first result is stored in a folder, only the MOST_FILES results used last stay there.

    Args:
        folder: Folder with one file per result; None for the memory.

    Attributes:
        used: Number of results that were returned.
        damaged: Number of files that could not be read; their results are computed again.
        refusal: Reason why nothing is written any more; empty otherwise.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._memory: dict[str, JobResult] = {}
        self._lock = threading.Lock()
        self.used = self.damaged = 0
        self.refusal = ""
        self._is_tidy = False

    def get(self, key: str) -> JobResult | None:
        """Return the result of the job with this key; None if it is not stored, is larger than 1 MB or cannot
        be read. A file that cannot be used counts in `damaged`."""
        folder = self._folder
        with self._lock:
            answer = self._memory.get(key) if folder is None else self._read(self._file(folder, key))
            self.used += answer is not None
        return answer

    def put(self, key: str, answer: JobResult) -> None:
        """Store a result that has scores, in place of an earlier one. Failures are not stored, because they
        may not happen again. After a disk error nothing is written any more, and `refusal` has the reason;
        nothing is raised."""
        if answer.scores is None or self.refusal:
            return
        if self._folder is None:
            self._memory[key] = answer
            return
        file = self._file(self._folder, key)
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with self._lock, write_beside(file) as partial:
                self._tidy(self._folder)
                partial.write_bytes(msgspec.json.encode(answer))
        except (OSError, StemmapError) as error:
            why = getattr(error, "strerror", None) or str(error)
            self.refusal = f"results are not stored for later: {why}"

    def warnings(self) -> list[str]:
        """Return warnings on stored results that could not be read or written."""
        unread = f"{count(self.damaged, 'stored result')} could not be read; computed again"
        return [*([unread] if self.damaged else []), *([self.refusal] if self.refusal else [])]

    def _tidy(self, folder: Path) -> None:
        """Delete all but the MOST_FILES results used last; only the first call does so."""
        if not self._is_tidy:
            self._is_tidy = True
            for file in sorted(folder.glob("??/*.json"), key=_used_at, reverse=True)[MOST_FILES:]:
                file.unlink(missing_ok=True)

    def _read(self, file: Path) -> JobResult | None:
        """Return the result in a file, see `get`; the file counts as used now. None for a missing file, and,
        counted in `damaged`, for one that is too large, damaged or a failure."""
        try:
            if file.stat().st_size <= _LARGEST_FILE:
                answer = msgspec.json.decode(file.read_bytes(), type=JobResult)
                if answer.scores is not None:
                    with contextlib.suppress(OSError):  # a folder that cannot be written to
                        os.utime(file)
                    return answer
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError):
            pass
        self.damaged += 1
        return None

    @staticmethod
    def _file(folder: Path, key: str) -> Path:
        """Return the file of a job by its key."""
        name = hashlib.sha256(f"{code_digest()} {key}".encode()).hexdigest()
        return folder / name[:2] / f"{name}.json"


def _used_at(file: Path) -> float:
    """Return when a file was used last [s since 1970]; 0 if it was deleted meanwhile."""
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0


class ScoringProcesses(Generic[T]):
    """Processes that compute one job at a time each, unless its result is stored. A process starts with its
    first job; one that is lost is replaced and computes the job again.

    Args:
        count: Number of processes, at least 1; with a pool, that of the pool is used.
        command: Program and arguments of a process; empty for `app.extensions.search.scoring`.
        kept: Results that are known, to which each new one is added; None for those of this object.
        pool: Where the jobs are computed; None for processes on this machine.

    Attributes:
        count: Number of processes.
        kept: The stored results.
        lost: Counter from the reason to the number of processes that were lost during a job.
    """

    def __init__(
        self,
        count: int,
        command: Sequence[str] = (),
        kept: ResultStore | None = None,
        pool: TaskPool | None = None,
    ) -> None:
        self.count, self.kept, self._pool = count if pool is None else pool.count, kept or ResultStore(), pool
        self.lost = Counter[str]()
        self._command = command or COMMAND
        self._children: dict[int, BlockingChildProcess] = {}
        self._threads = ThreadPoolExecutor(self.count, "scoring")
        self._doing: dict[Future[JobResult], tuple[int, T]] = {}
        self._lock = threading.Lock()
        self._is_closed = False

    def advance(
        self, next_job: Callable[[int], tuple[T, Job] | None], wait_s: float | None = None
    ) -> list[tuple[T, JobResult]]:
        """Give a job to each free process, wait for the first result, and return the jobs that are done as
        tuples of identifier and result, in any order. A job with LostError has a result with `error`.

        Args:
            next_job: Returns an identifier and the next job for the process with this number; None if there
                is no job now.
            wait_s: Longest wait [s]; None for no limit. Without jobs in progress there is no wait.

        Raises:
            StemmapError: No process can be started.
        """
        busy = {worker for worker, _ in self._doing.values()}
        for worker in range(self.count):
            following = None if worker in busy else next_job(worker)
            if following is not None:
                self._doing[self.submit(following[1], worker)] = (worker, following[0])
        done, _ = wait(self._doing, wait_s, FIRST_COMPLETED)
        return [(self._doing.pop(future)[1], _result(future)) for future in done]

    def submit(self, job: Job, worker: int = 0) -> Future[JobResult]:
        """Start a job on the process with the number `worker`, which must be free, unless its result is
        stored; returns at once. The result of the future raises LostError after `MOST_LOSSES` lost processes,
        and StemmapError if no process can be started."""
        return self._threads.submit(self._known_or_computed, worker, job)

    def warnings(self) -> list[str]:
        """Return warnings on lost processes, and on stored results that could not be read or written."""
        lost = [
            f"{count(times, 'process', 'processes')} lost during a job and replaced: {reason}"
            for reason, times in sorted(self.lost.items())
        ]
        return [*self.kept.warnings(), *lost, *([] if self._pool is None else self._pool.warnings())]

    def close(self) -> None:
        """End all processes at once and wait for their threads; jobs in progress fail with LostError."""
        with self._lock:
            self._is_closed = True
            for child in self._children.values():
                child.end()
        if self._pool is not None:
            self._pool.close(close_runs)
        self._threads.shutdown()

    def _known_or_computed(self, worker: int, job: Job) -> JobResult:
        """Return the stored result of a job, or compute and store it; see `submit`. Runs in a thread."""
        key = job.key()
        answer = self.kept.get(key)
        if answer is None:
            answer = self._compute(worker, job)
            self.kept.put(key, answer)
        return answer

    def _compute(self, worker: int, job: Job) -> JobResult:
        """Return the result of a job that a process computes; a process that ends is replaced. Raises
        LostError after MOST_LOSSES lost processes or `close`, and StemmapError if none can be started."""
        if self._pool is not None:
            try:
                return msgspec.json.decode(
                    self._pool.call(score_job, msgspec.json.encode(job), worker), type=JobResult
                )
            except StemmapError as error:
                raise LostError(error.what) from error
        reason = ""
        for _ in range(MOST_LOSSES):
            child = self._child(worker)
            try:
                child.send(job)
                result = child.receive(JobResult)
                if result is not None:
                    return result
                reason = exit_reason(child.end(1.0))
            except (ChildError, ProtocolError) as error:
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


_scorers: list[Any] = []  # in a process of a pool: those that compute no job now


def score_job(job: bytes) -> bytes:
    """Return the result of a job in JSON, see `app.extensions.search.scoring.Scorer.score`. The run stays
    open in this process until another one is opened or `close_runs` is called."""
    from app.extensions.search.scoring import Scorer

    scorer = _scorers.pop() if _scorers else Scorer()
    try:
        return msgspec.json.encode(scorer.score(msgspec.json.decode(job, type=Job)))
    finally:
        _scorers.append(scorer)


def close_runs() -> None:
    """Close the runs that `score_job` left open in this process."""
    while _scorers:
        _scorers.pop().close()


def _result(future: Future[JobResult]) -> JobResult:
    """Return the result of a future that is done; the loss of its processes becomes the error of a result."""
    try:
        return future.result()
    except LostError as error:
        return JobResult(None, error=error.what)
