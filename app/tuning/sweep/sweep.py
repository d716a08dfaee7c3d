"""Distributes the jobs of a comparison to workers, replaces lost workers, and stores the results."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import msgspec

from app.common.child_process import BlockingChildProcess, exit_reason, python_module
from app.common.text import count
from app.tuning.sweep.jobs import Job, JobResult
from app.tuning.sweep.report import is_valid
from pipeline.config.model import validated
from pipeline.errors import ParameterError, StemmapError
from pipeline.io.atomic_files import write_beside
from pipeline.remapping import segmentation_key

MOST_LOSSES = 3  # a job that loses so many workers fails
NOBODY_S = 120.0
_LARGEST_FILE = 1 << 20
_WAIT_S = 1.0


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
        """Return the result of the job with this key, None if it is not stored."""
        file = self._file(key)
        if file is None:
            return None
        try:
            if file.stat().st_size <= _LARGEST_FILE:
                answer = msgspec.json.decode(file.read_bytes(), type=JobResult)
                if answer.scores is not None and is_valid(answer):
                    return answer
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError):
            pass
        self.damaged += 1
        return None

    def put(self, key: str, answer: JobResult) -> None:
        """Store a result that has scores. Failures are not stored, because they may not happen again. After a
        disk error nothing is written any more."""
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
    """Compute all jobs, or read their stored results.

    Args:
        jobs: The jobs; the results have the same order.
        workers: Compute the jobs; the caller closes them.
        kept: Stored results; each new result is added at once.
        progress: Called with the number of jobs that were completed since the last call.
        nobody_s: Time without any worker after which the remaining jobs fail [s].
    """
    return _Sweep(jobs, workers, kept, progress, nobody_s).run()


class _Sweep:
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
        fit = [g for g, jobs in self._waiting.items() if worker not in self._unfit_for(jobs[0])]
        others = {self._groups[w] for w in self._doing}
        return max(fit, key=lambda g: (g not in others, len(self._waiting[g])), default=None)

    def _unfit_for(self, number: int) -> set[str]:
        return self._unfit.get(self._jobs[number].run.digest, set())

    def _hear(self, event: Done | Lost) -> None:
        number = self._doing.pop(event.worker, None)
        if number is None:  # it was lost while it had no job; the next job restarts it
            self._groups.pop(event.worker, None)
            return
        if isinstance(event, Lost):
            self._groups.pop(event.worker, None)
            self._lost(number, event.reason)
            return
        answer = event.answer
        if not is_valid(answer):
            self._lost(number, "it sent an invalid answer")
            return
        if answer.fault in ("worker", "version"):
            self._is_unfit(event.worker, number, answer)
        else:
            self._finish(number, answer)

    def _lost(self, number: int, reason: str) -> None:
        self._outcome.lost[reason] += 1
        self._losses[number] += 1
        if self._losses[number] >= MOST_LOSSES:
            ended = f"{count(MOST_LOSSES, 'worker')} were lost during this job; the last one: {reason}"
            self._finish(number, JobResult(None, error=ended, fault="job"))
        else:
            self._again(number)

    def _is_unfit(self, worker: str, number: int, answer: JobResult) -> None:
        """Give the job to other workers. If no worker is suitable, all jobs of its run fail."""
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
        self._waiting.setdefault(_group(self._jobs[number]), deque()).appendleft(number)

    def _give_up(self) -> None:
        gone = JobResult(None, error=f"no worker was available for {self._nobody_s:.0f} s", fault="worker")
        for number in [n for jobs in self._waiting.values() for n in jobs]:
            self._finish(number, gone)
        self._waiting.clear()

    def _finish(self, number: int, answer: JobResult) -> None:
        self._answers[number] = answer
        self._kept.put(self._keys[number], answer)
        self._progress(1)

    def _storage_warnings(self) -> list[str]:
        warnings = []
        if self._kept.damaged:
            warnings.append(f"{count(self._kept.damaged, 'stored result')} could not be read; computed again")
        if self._kept.refusal:
            warnings.append(self._kept.refusal)
        return warnings


def _group(job: Job) -> bytes:
    """Return a key that is equal for jobs that share the results of the front end."""
    return msgspec.json.encode(job.run) + segmentation_key(validated(job.parameters))


COMMAND = python_module("app.tuning.sweep.scoring")
SCHEMES = ("tcp://", "tls://")
CONNECT_S = 20.0
_CHECK_S = 0.5  # between two looks at the members of a cluster


@dataclass(frozen=True, slots=True)
class Done:
    """A worker has sent a result."""

    worker: str
    answer: JobResult


@dataclass(frozen=True, slots=True)
class Lost:
    """A worker ended or left before it sent a result."""

    worker: str
    reason: str


Event = Done | Lost


class Workers(Protocol):
    """Workers that compute one job at a time each."""

    def free(self) -> list[str]:
        """Return the names of the workers without a job."""

    def give(self, worker: str, job: Job) -> None:
        """Start a job on a free worker."""

    def events(self, timeout_s: float, /) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first."""

    def close(self) -> None:
        """End all jobs and release the workers."""


class Processes:
    """Processes on this machine. Each starts with its first job and restarts after a loss.

    Args:
        count: Number of processes.
        command: The program of a process.
    """

    def __init__(self, count: int, command: Sequence[str] = ()) -> None:
        self._command = command or COMMAND
        self._children: dict[str, BlockingChildProcess] = {}
        self._names = [f"process {k + 1}" for k in range(count)]
        self._pool = ThreadPoolExecutor(count)
        self._jobs: dict[Future[JobResult | str], str] = {}

    def free(self) -> list[str]:
        """Return the names of the processes without a job."""
        busy = set(self._jobs.values())
        return [name for name in self._names if name not in busy]

    def give(self, worker: str, job: Job) -> None:
        """Start a job on a process; start the process if necessary."""
        child = self._children.get(worker)
        if child is None or child.returncode is not None:
            if child is not None:
                child.end()
            child = self._children[worker] = BlockingChildProcess(self._command, one_thread=True)
        self._jobs[self._pool.submit(_ask, child, job)] = worker

    def events(self, timeout_s: float) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first."""
        if not self._jobs:
            time.sleep(timeout_s)
            return []
        done, _ = wait(self._jobs, timeout_s, FIRST_COMPLETED)
        events: list[Event] = []
        for future in done:
            worker, answer = self._jobs.pop(future), future.result()
            events.append(Lost(worker, answer) if isinstance(answer, str) else Done(worker, answer))
        return events

    def close(self) -> None:
        """End all processes."""
        for child in self._children.values():
            child.end()
        self._children.clear()
        self._pool.shutdown()


def _ask(child: BlockingChildProcess, job: Job) -> JobResult | str:
    """Return the result of a job, or the reason why the process was lost."""
    try:
        child.send(job)
        answer = child.receive(JobResult)
    except StemmapError as error:
        child.end()
        return error.what
    return exit_reason(child.end(1.0)) if answer is None else answer


class DaskWorkers:
    """The workers of a Dask cluster. Workers that join later are used too. The JSON of a job is sent; the
    function that computes it is imported on the worker.

    Args:
        address: Address of the scheduler, tcp://host:port or tls://host:port.
        score: Function that returns the JSON of an answer; every worker must be able to import it. Default:
            `app.tuning.sweep.scoring.score_json`.
        connect_s: Time limit for the connection [s].

    Raises:
        ParameterError: The address is invalid, or the package distributed is not installed.
        StemmapError: No scheduler answers.
    """

    def __init__(
        self, address: str, score: Callable[[bytes], bytes] | None = None, connect_s: float = CONNECT_S
    ) -> None:
        if not address.startswith(SCHEMES):
            raise ParameterError(
                f"{address!r} is not the address of a Dask scheduler",
                remedy="Give tcp://host:port or tls://host:port",
            )
        try:
            from distributed import Client
        except ImportError:
            raise ParameterError(
                "--dask needs the package distributed, which is not installed",
                remedy="Install the extra: pip install 'stemmap[dask]', or in a clone `uv sync --extra dask`",
            ) from None
        try:
            self._client: Any = Client(address, timeout=connect_s, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:  # TimeoutError is an OSError
            raise StemmapError(
                f"no Dask scheduler answers: {type(error).__name__}",
                where=address,
                remedy="Start it with `dask scheduler`, and workers with `dask worker`",
            ) from None
        if score is None:
            from app.tuning.sweep.scoring import score_json

            score = score_json
        self._score = score
        self._doing: dict[str, Any] = {}

    def free(self) -> list[str]:
        """Return the workers without a job of this comparison."""
        return sorted(self._present() - set(self._doing))

    def give(self, worker: str, job: Job) -> None:
        """Start a job on a worker. No other worker may take it, because the cached front-end results are on
        this one."""
        self._doing[worker] = self._client.submit(
            self._score,
            msgspec.json.encode(job),
            workers=[worker],
            allow_other_workers=False,
            pure=False,
            retries=0,
        )

    def events(self, timeout_s: float) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first."""
        until = time.monotonic() + timeout_s
        while True:
            events = self._events()
            left = until - time.monotonic()
            if events or left <= 0.0:
                return events
            self._wait(min(left, _CHECK_S))

    def close(self) -> None:
        """Cancel the jobs and leave the cluster."""
        for future in self._doing.values():
            future.cancel()
        self._doing.clear()
        self._client.close()

    def _present(self) -> set[str]:
        try:
            return set(self._client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, ValueError) as error:
            raise StemmapError(
                f"the Dask scheduler has ended: {error}", remedy="Start it again, then this command"
            ) from None

    def _wait(self, seconds: float) -> None:
        """Wait until a job is done, at most this time."""
        from distributed import TimeoutError as TooLong
        from distributed import wait

        if not self._doing:
            time.sleep(seconds)
            return
        with contextlib.suppress(TooLong, TimeoutError), self._client.as_current():
            wait(list(self._doing.values()), timeout=seconds, return_when="FIRST_COMPLETED")

    def _events(self) -> list[Event]:
        if self._client.status not in ("running", "connecting"):
            raise StemmapError("the Dask scheduler has ended", remedy="Start it again, then this command")
        present, events = self._present(), []
        for worker, future in list(self._doing.items()):
            event: Event | None = None
            if future.status == "finished":
                event = _answered(worker, bytes(future.result()))
            elif future.status in ("error", "cancelled", "lost"):
                event = Lost(worker, _why(future))
            elif worker not in present:
                future.cancel()
                event = Lost(worker, "it left the cluster")
            if event is not None:
                del self._doing[worker]
                future.release()
                events.append(event)
        return events


def _answered(worker: str, text: bytes) -> Event:
    try:
        return Done(worker, msgspec.json.decode(text, type=JobResult))
    except msgspec.MsgspecError:
        return Lost(worker, "it sent an invalid answer")


def _why(future: Any) -> str:  # noqa: ANN401 - a future of the library
    if future.status != "error":
        return str(future.status)
    error = future.exception()
    return f"{type(error).__name__}: {error}"[:300]
