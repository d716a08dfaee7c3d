"""The search for parameters that people ask for on the page: its process, and what is told of it.

It works on the run that is open and others of the list, with the truth and the parameters of that moment, in
a process of its own. What was stopped can go on from its journal. When the run is left, another search begins
or stemmap ends, the process and the journal go.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import sys
import weakref
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Literal

import msgspec

from app.tuning.payload import told_of
from app.tuning.plan import Plan
from app.tuning.request import SearchAsked, check_same
from app.tuning.result import Result, best_parameters, toml_of
from app.tuning.said import FOLDER, Said
from app.tuning.trial import Trial
from pipeline.config import Parameters
from pipeline.errors import StemmapError

# -P: a folder that holds a file `app.py` must not decide what runs.
SERVED = (sys.executable, "-P", "-m", "app.tuning.served")
State = Literal["none", "looking", "searching", "stopping", "done", "failed"]

_LONGEST_LINE = 16 << 20
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
        self.asked: SearchAsked | None = None
        self._start: Trial | None = None
        self._trials: dict[int, Trial] = {}
        # Takes the journal away, at the latest when this process ends.
        self._folder: weakref.finalize[..., TuneSearch] | None = None
        self._began = False  # the process that runs has scored what it begins with

    @property
    def is_under_way(self) -> bool:
        """Whether there is a process."""
        return self._task is not None and not self._task.done()

    @property
    def can_go_on(self) -> bool:
        """Whether a search ended before it had made all that it was to make."""
        made = len(self._trials)
        return self._folder is not None and not self.is_under_way and bool(self.plan) and made < self._wanted

    @property
    def _wanted(self) -> int:
        return 0 if self.plan is None else self.plan.trials

    async def start(self, plan: Plan, asked: SearchAsked | None = None) -> None:
        """Begin a search; one that was stopped is forgotten.

        Args:
            plan: What is searched for; its storage is chosen here.
            asked: Of which the plan was made.

        Raises:
            StemmapError: One is under way, or no process can be started.
        """
        self._check_idle()
        async with self._turn:
            self._forget()
            folder = _folder()
            self._folder = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            plan = msgspec.structs.replace(plan, storage=str(folder / "journal"))
            await self._run(plan, asked)

    async def go_on(self, now: Plan) -> None:
        """Go on with the search that was stopped, from its journal.

        Args:
            now: The plan that the same choices make now.

        Raises:
            StemmapError: There is none, or truth or parameters have changed since it began.
        """
        self._check_idle()
        if self.plan is None or not self.can_go_on:
            raise StemmapError("there is no stopped search", remedy="Search")
        check_same(self.plan, now)
        async with self._turn:
            await self._run(self.plan, self.asked)

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

    def _check_idle(self) -> None:
        if self.is_under_way or self._turn.locked():
            raise StemmapError("a search is under way", remedy="Stop it first")

    async def _run(self, plan: Plan, asked: SearchAsked | None) -> None:
        process = self._process = await self._process_of_a_search()
        self.plan, self.asked, self._state, self._error = plan, asked, "looking", ""
        self._began = False
        self._task = asyncio.create_task(self._listen(process), name="search")
        self._task.add_done_callback(lambda _: self.show())  # only now it may go on
        await self._write(process, msgspec.json.encode(plan) + b"\n")
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
        if self.plan is None:
            return {"state": "none"}
        return {
            "state": self._state,
            "error": self._error,
            "go_on": self.can_go_on,
            **told_of(self.plan, self._made(), self._start, self.result),
        }

    def _forget(self) -> None:
        self._state, self._error = "none", ""
        self.plan = self.result = self._start = self.asked = None
        self._trials = {}
        if self._folder is not None:
            self._folder()
            self._folder = None

    def _made(self) -> list[Trial]:
        return [self._trials[number] for number in sorted(self._trials)]

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

    def _take(self, said: Said) -> None:
        self._trials |= {trial.number: trial for trial in said.trials}
        if said.start is not None:
            self._start, self._began = said.start, True
            if self._state == "looking":
                self._state = "searching"
        if said.result is not None:
            self.result, self._state = said.result, "done"
        elif said.error is not None:
            what, where, remedy = said.error
            self._fail(str(StemmapError(what, where=where, remedy=remedy)))
        elif said == Said() and self._state == "stopping" and not self._began:
            if self._start is None:  # nothing was found, now or before
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


def _folder() -> Path:
    """A new folder for a journal."""
    try:
        return Path(mkdtemp(prefix=FOLDER))
    except OSError as error:
        raise StemmapError(f"the trials cannot be kept: {error.strerror}") from None
