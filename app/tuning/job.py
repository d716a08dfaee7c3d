"""The parameter search of the page: its process, its state, and what the browsers show of it.

A search maps the open run and other runs of the list, with the true trees and the parameters of the moment in
which it begins, in a process of its own. A stopped search can continue from its journal. The process and the
journal are removed when the run is left, another search begins or stemmap ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import weakref
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, Literal

import msgspec

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.tuning.plan import JOURNAL_FOLDER, Plan, Trial
from app.tuning.request import SearchRequest, check_same
from app.tuning.result import Result, SearchMessage, best_parameters, for_page, toml_of
from pipeline.config import Parameters
from pipeline.errors import StemmapError

COMMAND = python_module("app.tuning.search_processes", "page")
State = Literal["none", "looking", "searching", "stopping", "done", "failed"]
_GRACE_S = 3.0


class TuneSearch:
    """The newest search of the page.

    Args:
        tell: Called with the state for the browsers whenever it changes.
        command: The program of the search.

    Attributes:
        plan, asked: What is searched for, and the request of the browser.
        result: The result, once the search has ended.
    """

    def __init__(self, tell: Callable[[dict[str, Any]], None], command: Sequence[str] = COMMAND) -> None:
        self._tell, self._command = tell, command
        self._process: ChildProcess | None = None
        self._task: asyncio.Task[None] | None = None
        self._turn = asyncio.Lock()  # held while a search begins or is left
        self._state: State = "none"
        self._error = ""
        self.plan: Plan | None = None
        self.result: Result | None = None
        self.asked: SearchRequest | None = None
        self._start: Trial | None = None
        self._trials: dict[int, Trial] = {}
        # Deletes the journal, at the latest when this process ends.
        self._folder: weakref.finalize[..., TuneSearch] | None = None
        self._began = False  # whether the process has scored the start

    @property
    def is_under_way(self) -> bool:
        """Whether a process searches."""
        return self._task is not None and not self._task.done()

    @property
    def can_go_on(self) -> bool:
        """Whether a search ended before its last trial."""
        made = len(self._trials)
        return self._folder is not None and not self.is_under_way and bool(self.plan) and made < self._wanted

    @property
    def _wanted(self) -> int:
        return 0 if self.plan is None else self.plan.trials

    async def start(self, plan: Plan, asked: SearchRequest | None = None) -> None:
        """Begin a search. A stopped search is removed.

        Args:
            plan: What is searched for; the storage is chosen here.
            asked: The request from which the plan was made.

        Raises:
            StemmapError: A search is under way, or no process can be started.
        """
        self._check_idle()
        async with self._turn:
            self._forget()
            folder = _folder()
            self._folder = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            plan = msgspec.structs.replace(plan, storage=str(folder / "journal"))
            await self._run(plan, asked)

    async def go_on(self, now: Plan) -> None:
        """Continue the stopped search from its journal.

        Args:
            now: The plan that the same request makes now.

        Raises:
            StemmapError: No search was stopped, or true trees or parameters have changed since it began.
        """
        self._check_idle()
        if self.plan is None or not self.can_go_on:
            raise StemmapError("there is no stopped search", remedy="Search")
        check_same(self.plan, now)
        async with self._turn:
            await self._run(self.plan, self.asked)

    async def stop(self) -> None:
        """Stop the search. Its result stays."""
        if self._process is not None and self.is_under_way:
            self._state = "stopping"
            self.show()
            await self._process.send("stop")

    async def leave(self) -> None:
        """End the search and remove its result, because its run is left."""
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

    async def _run(self, plan: Plan, asked: SearchRequest | None) -> None:
        process = self._process = await ChildProcess.start(self._command)
        self.plan, self.asked, self._state, self._error = plan, asked, "looking", ""
        self._began = False
        self._task = asyncio.create_task(self._listen(process), name="search")
        self._task.add_done_callback(lambda _: self.show())  # from now on it can continue
        await process.send(plan)
        self.show()

    def found(self) -> tuple[str, Parameters, str]:
        """Return the name of the preset, the parameters and the parameter file of the best set.

        Raises:
            StemmapError: No better set was found.
        """
        if self.plan is None or self.result is None or not self.result.better:
            raise StemmapError("no better set was found", remedy="Search, or search over other parameters")
        text = toml_of(self.plan, self.result, date.today().isoformat())
        return self.plan.preset, best_parameters(self.plan, self.result), text

    def show(self) -> None:
        """Send the state to the browsers."""
        self._tell(self.as_plain())

    def as_plain(self) -> dict[str, Any]:
        """Return the state for the browsers."""
        if self.plan is None:
            return {"state": "none"}
        return {
            "state": self._state,
            "error": self._error,
            "go_on": self.can_go_on,
            **for_page(self.plan, self._made(), self._start, self.result),
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

    async def _listen(self, process: ChildProcess) -> None:
        try:
            while (message := await process.receive(SearchMessage)) is not None:
                self._take(message)
                self.show()
        except ProtocolError as error:
            self._fail(error.what)
        finally:
            await process.end(_GRACE_S)
        if self._state not in ("done", "failed"):
            self._fail("the search ended unexpectedly. Start it again; the terminal may show why")

    def _take(self, message: SearchMessage) -> None:
        self._trials |= {trial.number: trial for trial in message.trials}
        if message.start is not None:
            self._start, self._began = message.start, True
            if self._state == "looking":
                self._state = "searching"
        if message.result is not None:
            self.result, self._state = message.result, "done"
        elif message.error is not None:
            what, where, remedy = message.error
            self._fail(str(StemmapError(what, where=where, remedy=remedy)))
        elif message == SearchMessage() and self._state == "stopping" and not self._began:
            if self._start is None:  # there is no result, also not from before
                self._forget()
            self._state = "done"

    def _fail(self, why: str) -> None:
        self._state, self._error = "failed", why


def _folder() -> Path:
    """Make a folder for a journal."""
    try:
        return Path(mkdtemp(prefix=JOURNAL_FOLDER))
    except OSError as error:
        raise StemmapError(f"the trials cannot be kept: {error.strerror}") from None
