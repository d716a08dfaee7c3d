"""Workers that compute the jobs of a comparison or a search: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from app.common.child_process import BlockingChildProcess, exit_reason, python_module
from app.tuning.jobs import Job, JobResult
from pipeline.errors import ParameterError, StemmapError

SCORING = "app.tuning.scoring"
COMMAND = python_module(SCORING)
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
        """Start a job on a worker, which must be free."""

    def events(self, timeout_s: float, /) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first."""

    def close(self) -> None:
        """End all jobs and release the workers."""


class Processes:
    """Processes on this machine. Each starts with its first job and restarts after a loss.

    Args:
        count: Number of processes, at least 1.
        command: The program of a process; empty for `app.tuning.scoring`.
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
        """Start a job on a process; start the process if it does not run. An error of the job or the process
        becomes an event."""
        child = self._children.get(worker)
        if child is None or child.returncode is not None:
            if child is not None:
                child.end()
            child = self._children[worker] = BlockingChildProcess(self._command, one_thread=True)
        self._jobs[self._pool.submit(_ask, child, job)] = worker

    def events(self, timeout_s: float) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first. Without jobs
        it waits the whole time."""
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
    """Return the result of a job, or the reason why the process was lost, as text. In the second case the
    process is ended."""
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
            `app.tuning.scoring.score_json`.
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
            from app.tuning.scoring import score_json

            score = score_json
        self._score = score
        self._doing: dict[str, Any] = {}

    def free(self) -> list[str]:
        """Return the names of the workers of the cluster without a job of this comparison, sorted.

        Raises:
            StemmapError: The scheduler has ended.
        """
        return sorted(self._present() - set(self._doing))

    def give(self, worker: str, job: Job) -> None:
        """Start a job on a worker, which must be free. No other worker may take it, because the cached
        front-end results are on this one."""
        self._doing[worker] = self._client.submit(
            self._score,
            msgspec.json.encode(job),
            workers=[worker],
            allow_other_workers=False,
            pure=False,
            retries=0,
        )

    def events(self, timeout_s: float) -> list[Event]:
        """Return results and losses since the last call; wait at most `timeout_s` for the first.

        Raises:
            StemmapError: The scheduler has ended.
        """
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
        """Return the names of the workers that are connected to the scheduler; raises StemmapError if it has
        ended."""
        try:
            return set(self._client.scheduler_info(n_workers=-1)["workers"])
        except (OSError, ValueError) as error:
            raise StemmapError(
                f"the Dask scheduler has ended: {error}", remedy="Start it again, then this command"
            ) from None

    def _wait(self, seconds: float) -> None:
        """Wait until a job is done, at most `seconds`; without jobs the whole time."""
        from distributed import TimeoutError as TooLong
        from distributed import wait

        if not self._doing:
            time.sleep(seconds)
            return
        with contextlib.suppress(TooLong, TimeoutError), self._client.as_current():
            wait(list(self._doing.values()), timeout=seconds, return_when="FIRST_COMPLETED")

    def _events(self) -> list[Event]:
        """Return the events of all jobs that have ended, without waiting, and forget these jobs. A job whose
        worker left the cluster is cancelled and reported as lost.

        Raises:
            StemmapError: The scheduler has ended.
        """
        if self._client.status not in ("running", "connecting"):
            raise StemmapError("the Dask scheduler has ended", remedy="Start it again, then this command")
        present, events = self._present(), []
        for worker, future in list(self._doing.items()):
            event: Event | None = None
            if future.status == "finished":
                event = answered(worker, bytes(future.result()))
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


def answered(worker: str, text: bytes) -> Event:
    """Return the event of a worker of a cluster that sent a result as JSON; `Lost` if the JSON is invalid."""
    try:
        return Done(worker, msgspec.json.decode(text, type=JobResult))
    except msgspec.MsgspecError:
        return Lost(worker, "it sent an invalid answer")


def _why(future: Any) -> str:  # noqa: ANN401 - a future of the library
    """Return the reason why a Dask job ended without a result: its status, or the exception, of at most 300
    characters."""
    if future.status != "error":
        return str(future.status)
    error = future.exception()
    return f"{type(error).__name__}: {error}"[:300]
