"""The search for parameters that people ask for on the page: its process, and what is told of it.

It works on the run that is open, with the truth and the parameters of that moment, in a process of its own.
When the run is left or stemmap ends, the process ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Callable, Sequence
from datetime import date
from typing import Any, Literal

import msgspec

from app.tuning.goal import RunScore, pool
from app.tuning.plan import Plan
from app.tuning.result import Result, best_parameters, toml_of
from app.tuning.said import Said
from app.tuning.trial import Trial
from pipeline.errors import StemmapError
from pipeline.parameters import Parameters

# -P: a folder that holds a file `app.py` must not decide what runs.
SERVED = (sys.executable, "-P", "-m", "app.tuning.served")
State = Literal["none", "looking", "searching", "stopping", "done", "failed"]

_LONGEST_LINE = 16 << 20
_MOST_SHOWN = 400  # points of the picture
_GRACE_S = 3.0


class TuneSearch:
    """The newest search, if there was one.

    Args:
        tell: Called with what the browsers are to know, whenever that changes.
        command: The program and its arguments.
    """

    def __init__(self, tell: Callable[[dict[str, Any]], None], command: Sequence[str] = SERVED) -> None:
        self._tell, self._command = tell, command
        self._process: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()  # while one begins or is left
        self._state: State = "none"
        self._error = ""
        self.plan: Plan | None = None
        self.result: Result | None = None
        self._start: Trial | None = None
        self._trials: list[Trial] = []

    @property
    def is_under_way(self) -> bool:
        """Whether there is a process."""
        return self._task is not None and not self._task.done()

    async def start(self, plan: Plan) -> None:
        """Begin a search.

        Raises:
            StemmapError: One is under way, or no process can be started.
        """
        if self.is_under_way or self._turn.locked():
            raise StemmapError("a search is under way", remedy="Stop it first")
        async with self._turn:
            self._forget()
            process = self._process = await self._process_of_a_search()
            self.plan, self._state = plan, "looking"
            self._task = asyncio.create_task(self._listen(process), name="search")
        await self._write(process, msgspec.json.encode(plan) + b"\n")
        self.show()

    async def stop(self) -> None:
        """End the search; what it found stays."""
        if self._process is not None and self.is_under_way:
            self._state = "stopping"
            self.show()
            await self._write(self._process, b"stop\n")

    async def leave(self) -> None:
        """End the search and forget what it found: it was of a run that is left."""
        async with self._turn:
            task, self._task = self._task, None
            if task is not None:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
            self._forget()
        self.show()

    def found(self) -> tuple[str, Parameters, str]:
        """The preset, the values and the file of the best set.

        Raises:
            StemmapError: There is none.
        """
        if self.plan is None or self.result is None or not self.result.better:
            raise StemmapError("no better set was found", remedy="Search, or search over other parameters")
        text = toml_of(self.plan, self.result, date.today().isoformat())
        return self.plan.preset, best_parameters(self.plan, self.result), text

    def show(self) -> None:
        """Tell the browsers."""
        self._tell(self.as_plain())

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        plan, result = self.plan, self.result
        if plan is None:
            return {"state": "none"}
        goal = plan.aim
        points = [(t.number, _shown(goal.name, t.loss)) for t in self._trials if goal.is_kept(t.loss or 0.0)]
        every = -(-len(points) // _MOST_SHOWN) or 1
        return {
            "state": self._state,
            "error": self._error,
            "goal": goal.words,
            "label": goal.label,
            "unit": {"position": "cm", "pairs": "%"}.get(goal.name, ""),
            "over": [axis.words for axis in plan.axes],
            "wanted": plan.trials,
            "made": len(self._trials),
            "start": _told(plan, self._start),
            "best": _told(plan, self._best()),
            "points": points[::every],
            "importance": dict(list(result.importance.items())) if result else {},
            "better": bool(result and result.better),
            "changes": _changes(plan, result) if result else [],
        }

    def _forget(self) -> None:
        self._state, self._error = "none", ""
        self.plan = self.result = self._start = None
        self._trials = []

    def _best(self) -> Trial | None:
        made = [t for t in (*self._trials, *([self._start] if self._start else [])) if t.loss is not None]
        return min(made, key=lambda t: (t.loss, t.number), default=None)

    async def _process_of_a_search(self) -> asyncio.subprocess.Process:
        try:
            return await asyncio.create_subprocess_exec(
                *self._command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=_LONGEST_LINE,
                start_new_session=True,  # Ctrl-C in the terminal is for the server, which ends it
            )
        except OSError as error:
            raise StemmapError(f"no process can be started: {error.strerror}") from None

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None  # noqa: S101 - it was asked for
        try:
            while line := await process.stdout.readline():
                self._take(msgspec.json.decode(line, type=Said))
                self.show()
        except (ValueError, msgspec.MsgspecError) as error:
            self._fail(f"the search spoke gibberish: {error}")
        finally:
            await _ended(process)
        if self._state not in ("done", "failed"):
            self._fail("the search ended in the middle. Start it again; the terminal may show why")
        self.show()

    def _take(self, said: Said) -> None:
        self._trials += said.trials
        if said.start is not None:
            self._start = said.start
            if self._state == "looking":
                self._state = "searching"
        if said.result is not None:
            self.result, self._state = said.result, "done"
        elif said.error is not None:
            what, where, remedy = said.error
            self._fail(str(StemmapError(what, where=where, remedy=remedy)))
        elif said == Said() and self._state == "stopping" and self._start is None:
            self._forget()
            self._state = "done"

    def _fail(self, why: str) -> None:
        self._state, self._error = "failed", why

    async def _write(self, process: asyncio.subprocess.Process, line: bytes) -> None:
        assert process.stdin is not None  # noqa: S101 - it was asked for
        with contextlib.suppress(ConnectionError):
            process.stdin.write(line)
            await process.stdin.drain()


async def _ended(process: asyncio.subprocess.Process) -> None:
    """End it: its stdin ends, then not kindly."""
    if process.stdin is not None:
        process.stdin.close()
    try:
        await asyncio.wait_for(process.wait(), _GRACE_S)
    except (TimeoutError, asyncio.CancelledError):
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def _told(plan: Plan, trial: Trial | None) -> dict[str, Any] | None:
    if trial is None:
        return None
    return {"number": trial.number, "shown": plan.aim.shown(trial.loss or 0.0), **_figures(trial.training)}


def _figures(scores: tuple[RunScore, ...]) -> dict[str, Any]:
    pooled = pool(scores)
    return {"f1": pooled.f1, "TA": pooled.ta, "false_share": pooled.false_share}


def _shown(goal: str, loss: float | None) -> float | None:
    """A loss as the figure that is drawn; None of a set that cannot be mapped with."""
    if loss is None:
        return None
    return 1.0 - loss if goal in ("f1", "ta") else 100.0 * loss if goal == "position" else loss


def _changes(plan: Plan, result: Result) -> list[list[Any]]:
    """Name, value before and value found."""
    before = plan.parameters.flat()
    return [[name, before[name], value] for name, value in result.best.values.items()]
