"""Limits on the rate of function calls and requests, cancellation of tasks, and measurement of the stages of
the pipeline."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from statistics import median
from typing import Any, Generic, ParamSpec

from pipeline.errors import StemmapError

P = ParamSpec("P")
_MOST_SHARE = 0.3  # of the time, spent in the calls of a Throttle
_MOST_WAITING = 4  # requests in a RequestQueue
_log = logging.getLogger(__name__)


class Throttle(Generic[P]):
    """Limits the rate of calls of a function, and the time spent in them to 30 %. A call that is too early is
    made later, with the newest arguments.

    Args:
        function: Function that is called on the event loop.
        pause_s: Minimum time between the starts of two calls [s].
    """

    def __init__(self, function: Callable[P, None], *, pause_s: float) -> None:
        self._function = function
        self._pause_s = pause_s
        self._free_at = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._call: Callable[[], None] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Call the function now, or later with the newest arguments if it was called too recently. Exceptions
        of a call now are raised here, those of a later call go to the event loop."""
        self._call = lambda: self._function(*args, **kwargs)
        loop = asyncio.get_running_loop()
        if self._timer is None and loop.time() >= self._free_at:
            self._run()
        elif self._timer is None:
            self._timer = loop.call_at(self._free_at, self._run)

    def cancel(self) -> None:
        """Cancel the pending call."""
        self._call = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _run(self) -> None:
        """Make the pending call, if there is one, and set the time before which no other is made."""
        self._timer = None
        call, self._call = self._call, None
        if call is None:
            return
        loop = asyncio.get_running_loop()
        start = loop.time()
        try:
            call()
        finally:
            end = loop.time()
            self._free_at = max(start + self._pause_s, end + (end - start) * (1 / _MOST_SHARE - 1))


class TooManyRequestsError(StemmapError):
    """Too many requests of this kind wait. The same request may succeed later."""


class RequestQueue:
    """Runs requests one after the other with a pause in between, and refuses those beyond a short queue.

    Args:
        pause_s: Pause between two requests [s].
        most_waiting: Maximum number of requests that wait for a turn. One that waits only for the end of the
            pause has the turn already.
    """

    def __init__(self, pause_s: float = 0.0, most_waiting: int = _MOST_WAITING) -> None:
        self._pause_s, self._most_waiting = pause_s, most_waiting
        self._lock = asyncio.Lock()
        self._waiting = 0
        self._free_at = 0.0

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a turn, which lasts as long as the context. Turns are in the order of the calls, with the
        pause of the queue after each, also after one that raises.

        Raises:
            TooManyRequestsError: `most_waiting` other requests wait already.
        """
        if self._waiting >= self._most_waiting:
            raise TooManyRequestsError("too many requests wait", remedy="Try again in some seconds")
        loop = asyncio.get_running_loop()
        self._waiting += 1
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        try:
            await asyncio.sleep(max(0.0, self._free_at - loop.time()))
            yield
        finally:
            self._free_at = loop.time() + self._pause_s
            self._lock.release()


async def cancel(task: asyncio.Task[Any] | None) -> None:
    """Cancel a task and wait for its end; nothing for None. An error of the task, also of one that had ended
    before, is logged. If the caller is cancelled meanwhile, the function returns and does not raise."""
    if task is None:
        return
    task.cancel()
    try:
        await task
    except asyncio.CancelledError:
        pass
    except Exception:
        _log.exception("%s had ended with a fault", task.get_name())


TOTAL = "total"


class Stopwatch:
    """Median times of the stages and of whole scans over the last scans; the `StageTimer` of a mapper.

    Measurements during which `disturb` is called are discarded.

    Args:
        scans: Number of scans over which medians are taken.
        clock: Returns the time [s] from any origin.
    """

    def __init__(self, scans: int = 50, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._scans = scans
        self._stages: dict[str, deque[float]] = {}
        self._totals: deque[float] = deque(maxlen=scans)
        self._aside = False
        self._disturbances = 0
        self._scan: dict[str, float] = {}

    def disturb(self) -> None:
        """Discard the current measurement, for example because a kernel was compiled meanwhile."""
        self._disturbances += 1

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure one stage inside the context, also one that raises, and add its time to the dict of the
        last `whole_scan`; the time is discarded if measurements are disabled by `aside` or the stage is
        disturbed."""
        start, disturbances = self._clock(), self._disturbances
        try:
            yield
        finally:
            times = self._stages.setdefault(stage, deque(maxlen=self._scans))
            if not self._aside and disturbances == self._disturbances:
                spent = self._clock() - start
                times.append(spent)
                self._scan[stage] = self._scan.get(stage, 0.0) + 1e3 * spent

    @contextmanager
    def whole_scan(self) -> Iterator[dict[str, float]]:
        """Measure the mapping of one scan including the time between the stages; `aside` has no effect on
        it. Yields a dict from the name of each stage, and TOTAL, to its time [ms], which is filled until the
        end of the context; it stays without TOTAL if the scan is disturbed."""
        start, disturbances = self._clock(), self._disturbances
        times: dict[str, float] = {}
        self._scan = times
        try:
            yield times
        finally:
            if disturbances == self._disturbances:
                spent = self._clock() - start
                self._totals.append(spent)
                times[TOTAL] = 1e3 * spent

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Disable measurements of stages inside the context, since the mapped scan does not belong to the
        run."""
        self._aside = True
        try:
            yield
        finally:
            self._aside = False

    def clear(self) -> None:
        """Discard all measurements."""
        self._stages.clear()
        self._totals.clear()

    @property
    def scan_ms(self) -> float:
        """Median time of a scan [ms]; 0 before the first."""
        return 1e3 * median(self._totals) if self._totals else 0.0

    @property
    def stage_ms(self) -> dict[str, float]:
        """Dict from the name of each stage to its median time [ms], in the order of their first run; stages
        without a measurement are left out."""
        return {stage: 1e3 * median(times) for stage, times in self._stages.items() if times}


async def ended(functions: Iterable[Callable[[], Awaitable[None]]]) -> None:
    """Call coroutine functions, which end something, one after the other. The exception of one of them is
    logged, and the others are called."""
    for function in functions:
        try:
            await function()
        except Exception:  # the code of an extension
            _log.exception("what an extension has started could not be ended")
