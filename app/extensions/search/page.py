"""What the page starts: the search for parameters and the sensitivity of the score to one of them, with their
processes, their state, and what the browsers show of them.

A search maps the open run and other runs of the list in a child process, with the true trees and parameters
at its start. The search is removed when the run is closed or another search begins; the results of its trials
are stored, so that a stopped search that begins again makes them at once. The points of a sensitivity curve
are computed one by one, while the run continues.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from pydantic import BaseModel, ConfigDict, Field

from app.common.child_process import ChildError, ChildProcess, ProtocolError, python_module
from app.common.text import count
from app.common.timers import cancel
from app.extensions.search.grid import spec_of
from app.extensions.search.jobs import COMMAND as SCORING
from app.extensions.search.jobs import Job, JobResult, ResultStore, RunWithTruth, ScoringProcesses
from app.extensions.search.plan import GoalName, Plan, PlannedRun, Trial, axes_of, check
from app.extensions.search.result import Result, SearchMessage, best_parameters, for_page, toml_of
from app.sources.live_address import is_live
from app.sources.request import SourceRequest, request_of_kept
from app.store.records import Content
from app.store.store import AnnotatedSource
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.readers import check_existence, path_of

COMMAND = python_module("app.extensions.search.search")
State = Literal["none", "looking", "searching", "stopping", "done", "failed"]
_GRACE_S = 3.0


class TuneSearch:
    """The newest search that the dashboard started.

    Args:
        tell: Called with the state for the browsers whenever it changes, see `as_plain`.
        command: Program and arguments of the child process.

    Attributes:
        plan, request: The search, and the request of the browser from which it was made; None if there is no
            search.
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
        self.request: SearchRequest | None = None
        self._start: Trial | None = None
        self._trials: list[Trial] = []

    @property
    def is_under_way(self) -> bool:
        """Whether the search runs in its child process."""
        return self._task is not None and not self._task.done()

    @property
    def can_go_on(self) -> bool:
        """Whether there is a search that does not run and has not made all its trials: it was stopped,
        failed, or its time was over."""
        return self.plan is not None and not self.is_under_way and len(self._trials) < self.plan.trials

    async def start(self, plan: Plan, request: SearchRequest | None = None) -> None:
        """Start a search in a child process, and send its state. The search before is removed; if no process
        can be started, it stays, and no state is sent.

        Args:
            plan: The search.
            request: The request from which the plan was made.

        Raises:
            StemmapError: Another search runs or is being started or left, or no process can be started.
        """
        if self.is_under_way or self._turn.locked():
            raise StemmapError("a search is under way", remedy="Stop it first")
        async with self._turn:
            process = self._process = await ChildProcess.start(self._command)
            self._forget()
            self.plan, self.request, self._state = plan, request, "looking"
            self._task = asyncio.create_task(self._listen(process), name="search")
            self._task.add_done_callback(lambda _: self.show())  # from now on it can continue
            await process.send(plan)
            self.show()

    async def stop(self) -> None:
        """Ask the process to stop and send the state "stopping"; the process then sends the result. Does
        nothing if no search runs."""
        if self._process is not None and self.is_under_way:
            self._state = "stopping"
            self.show()
            await self._process.send("stop")

    async def leave(self) -> None:
        """End the search, if it runs, remove its trials and its result, and send the state, because the run
        is closed."""
        async with self._turn:
            task, self._task = self._task, None
            await cancel(task)
            self._forget()
        self.show()

    def found(self) -> tuple[str, Parameters, str]:
        """Return the name of the preset, the parameters and the parameter file of the best set.

        Raises:
            StemmapError: There is no result, or no set was better than the start.
        """
        if self.plan is None or self.result is None or not self.result.better:
            raise StemmapError("no better set was found", remedy="Search, or search over other parameters")
        text = toml_of(self.plan, self.result, date.today().isoformat())
        return self.plan.preset, best_parameters(self.plan, self.result), text

    def show(self) -> None:
        """Send the state to the browsers."""
        self._tell(self.as_plain())

    def as_plain(self) -> dict[str, Any]:
        """Return a dict for the browsers with `state`, `error`, `go_on` (see `can_go_on`) and the keys of
        `for_page`; {"state": "none"} if there is no search."""
        if self.plan is None:
            return {"state": "none"}
        return {
            "state": self._state,
            "error": self._error,
            "go_on": self.can_go_on,
            **for_page(self.plan, self._trials, self._start, self.result),
        }

    def _forget(self) -> None:
        """Remove the search, its trials and its result. The child process is not ended."""
        self._state, self._error = "none", ""
        self.plan = self.result = self._start = self.request = None
        self._trials = []

    async def _listen(self, process: ChildProcess) -> None:
        """Process the messages of the child process until it ends, and send the state after each. The state
        becomes "failed" after an error of the search or a protocol error, or if the process ends without a
        result."""
        try:
            while (message := await process.receive(SearchMessage)) is not None:
                self._take(message)
                self.show()
        except (ChildError, ProtocolError) as error:
            self._fail(str(error))
        finally:
            await process.end(_GRACE_S)
        if self._state not in ("done", "failed"):
            self._fail("the search ended unexpectedly. Start it again; the terminal may show why")

    def _take(self, message: SearchMessage) -> None:
        """Update trials, result and state from a message of the child process. An empty message after a stop
        before the first score removes the search."""
        self._trials += message.trials
        if message.start is not None:
            self._start = message.start
            if self._state == "looking":
                self._state = "searching"
        if message.result is not None:
            self.result, self._state = message.result, "done"
        elif message == SearchMessage() and self._state == "stopping" and self._start is None:
            self._forget()  # there is no result
            self._state = "done"

    def _fail(self, why: str) -> None:
        """Set the state "failed" with its reason."""
        self._state, self._error = "failed", why


_MOST_TRIALS = 5000
_LONGEST_MINUTES = 24 * 60.0
MOST_OTHERS = 7  # each keeps up to 0.5 GB of points in memory

_Record = Annotated[int, Field(ge=0, le=2**31 - 1)]
_Records = Annotated[list[_Record], Field(max_length=MOST_OTHERS)]


class SearchRequest(BaseModel):
    """Request of a browser for a search.

    Attributes:
        over: Parameters with their bounds, as `stemmap tune --over` takes them.
        goal, false_max: See `app.extensions.search.plan.Goal`.
        trials, minutes: Limits of the search.
        also: Record numbers of further runs that guide the search.
        held_out: Record numbers of runs that are only scored.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    over: Annotated[list[Annotated[str, Field(max_length=200)]], Field(min_length=1, max_length=30)]
    goal: GoalName = "f1"
    false_max: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    trials: Annotated[int, Field(ge=1, le=_MOST_TRIALS)] = 200
    minutes: Annotated[float, Field(gt=0.0, le=_LONGEST_MINUTES)] = 10.0
    also: _Records = []
    held_out: _Records = []


class OtherRun(msgspec.Struct, frozen=True):
    """A run in the list of runs that is not open.

    Attributes:
        records: Numbers of the records of the run, the newest first.
        name: Name in the list.
        digest: Digest of the source.
        opened: Request with which it was opened last.
        annotations: Annotations of the run.
        why_not: Reason why it cannot be scored; empty if it can.
    """

    records: list[int]
    name: str
    digest: str
    opened: SourceRequest
    annotations: tuple[Content, ...]
    why_not: str

    def as_plain(self) -> dict[str, Any]:
        """Return the run as a dict of JSON values for the browsers. The keys are `record`, the number of the
        newest record; `name`; `truth`, the number of annotations in words, or "its own true trees" if there
        are none; and `why_not`."""
        truth = count(len(self.annotations), "annotation") if self.annotations else "its own true trees"
        return {"record": self.records[0], "name": self.name, "truth": truth, "why_not": self.why_not}


def other_runs(
    rows: Sequence[dict[str, Any]],
    annotated: Sequence[AnnotatedSource],
    open_digest: str,
    may_be_opened: Callable[[str], str | None],
) -> list[OtherRun]:
    """Return one run per digest of a source except `open_digest`, in the order of their newest records.

    A run that cannot be scored is included, with the reason in `why_not`: it may not be opened, it was live,
    its file does not exist, or no true trees are known (no record has scores, and no tree is annotated).

    Args:
        rows: Records of the store as dicts, the newest first, see `RunRecords.listed`.
        annotated: Sources with annotations.
        open_digest: Digest of the open run; empty if none is open.
        may_be_opened: Returns the URI that is opened for a URI, or None if that is not allowed.
    """
    contents = {each.source: each.annotations for each in annotated}
    found: dict[str, OtherRun] = {}
    scored: set[str] = set()
    for row in rows:
        digest = row["source"]
        if digest == open_digest:
            continue
        if row["scores"] is not None:
            scored.add(digest)
        if digest in found:
            found[digest].records.append(row["id"])
            continue
        uri = may_be_opened(row["uri"])
        opened = request_of_kept(
            uri or row["uri"], odometry=row["odometry"], seed=row["seed"], choices=row["chosen"]
        )
        known = contents.get(digest, ())
        why = "from another machine it cannot be opened" if uri is None else _why_gone(uri)
        found[digest] = OtherRun([row["id"]], row["name"], digest, opened, known, why)
    return [
        run
        if run.why_not or digest in scored or any(each.kind == "tree" for each in run.annotations)
        else msgspec.structs.replace(run, why_not="no true trees are known of it")
        for digest, run in found.items()
    ]


def plan_of(
    request: SearchRequest,
    shown: RunWithTruth,
    parameters: Parameters,
    preset: str,
    others: Sequence[OtherRun],
    kept: Path | None,
) -> Plan:
    """Return the plan of a search over the open run and the other runs that the request names.

    Args:
        request: The request.
        shown: The open run.
        parameters, preset: Those in force.
        others: The other runs of the list.
        kept: Folder of stored results; None keeps them in memory.

    Raises:
        StemmapError: A parameter or its bounds are invalid; or a further run is unknown, named twice or
            cannot be scored, or there are more than `MOST_OTHERS`.
    """
    axes = axes_of(request.over)
    check(axes, parameters)
    source = shown.source
    return Plan(
        runs=(PlannedRun(source, tuple(shown.truth), "annotations"), *_planned(request, others)),
        axes=axes,
        start=parameters.model_dump(),
        kept="" if kept is None else str(kept),
        preset=preset,
        goal=request.goal,
        false_max=request.false_max,
        seed=source.seed,
        odometry=source.odometry,
        trials=request.trials,
        seconds=60.0 * request.minutes,
    )


def _planned(request: SearchRequest, others: Sequence[OtherRun]) -> list[PlannedRun]:
    """Return the further runs of a request, first those that guide the search, then the held-out ones.

    Raises:
        StemmapError: A record is not in the list, its run cannot be scored or is named twice, or there are
            more than `MOST_OTHERS` runs.
    """
    by_record = {record: run for run in others for record in run.records}
    planned: list[PlannedRun] = []
    named: set[str] = set()
    for record, held_out in [(r, False) for r in request.also] + [(r, True) for r in request.held_out]:
        run = by_record.get(record)
        if run is None:
            raise StemmapError(
                "there is no such run in the list", where=f"run {record}", remedy="Reload the list"
            )
        if run.why_not:
            raise StemmapError(run.why_not, where=run.name, remedy="Leave it out")
        if run.digest in named:
            raise StemmapError("a run is named twice", where=run.name, remedy="Name it once")
        named.add(run.digest)
        name = "annotations" if run.annotations else ""
        digest = "" if run.digest == run.opened.uri else run.digest  # a source without digest has its URI
        planned.append(PlannedRun(run.opened, None, name, held_out, run.annotations, digest))
    if len(planned) > MOST_OTHERS:
        raise StemmapError(
            f"{count(len(planned), 'other run')} are too many",
            remedy=f"Name {MOST_OTHERS} at most, or use `stemmap tune`",
        )
    return planned


def _why_gone(uri: str) -> str:
    """Return the reason why a source cannot be opened again: it is live, or its file does not exist; "" if it
    can be opened. A simulated run can always be opened."""
    if is_live(uri):
        return "it is a live run, which cannot be mapped again"
    try:
        check_existence(path_of(uri))
    except SourceError:
        return "its recording does not exist any more"
    return ""


# --- sensitivity ------------------------------------------------------------------------------------

POINT_COMMAND = (*SCORING, "--low-priority")
MOST_VALUES = 65
IDLE_S = 120.0  # the process and its cache end after this time without a question


@dataclass(frozen=True, slots=True)
class Question:
    """A sensitivity curve to be computed.

    Attributes:
        run: The run with its true trees.
        parameters: The parameters in force.
        name: Dotted name of the parameter.
        values: Values of the parameter in the order in which they are computed, coarse steps first.
    """

    run: RunWithTruth
    parameters: Parameters
    name: str
    values: tuple[Value, ...]


class Sensitivity:
    """Computes the newest sensitivity curve, point by point.

    Args:
        tell: Called with the curve and its points so far after each point (see `_state_of`), and with {} when
            the curve is removed.
        command: Program and arguments of the child process.
        idle_s: Time without a new curve after which the process ends [s].
        kept: Folder of stored results; None keeps them in memory.
    """

    def __init__(
        self,
        tell: Callable[[dict[str, Any]], None],
        command: Sequence[str] = POINT_COMMAND,
        idle_s: float = IDLE_S,
        kept: Path | None = None,
    ) -> None:
        self._tell, self._command, self._idle_s = tell, command, idle_s
        self._kept = ResultStore(kept)
        self._question: Question | None = None
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def ask(self, question: Question) -> None:
        """Start a curve, and send it without points. It replaces the one before, whose current point is still
        completed, because its cache serves both. The caller needs a running event loop.

        Raises:
            ParameterError: There is no such parameter, or there are no or more than `MOST_VALUES` values.
        """
        spec_of(question.name)
        if not 1 <= len(question.values) <= MOST_VALUES:
            raise ParameterError(f"{len(question.values)} values are not between 1 and {MOST_VALUES}")
        self._question = question
        self._changed.set()
        self._tell(_state_of(question, []))
        if self._task is None:
            self._task = asyncio.create_task(self._work(), name="sensitivity")

    async def leave(self) -> None:
        """Cancel the curve, wait until the process has ended, and send {}, because the run or the curve is
        closed. Without a curve only {} is sent."""
        task, self._task, self._question = self._task, None, None
        await cancel(task)
        self._tell({})

    async def _work(self) -> None:
        """Compute curves until none was requested for `idle_s`; then end the process."""
        process: ScoringProcesses[None] = ScoringProcesses(1, self._command, self._kept)
        try:
            while (question := self._question) is not None:
                self._changed.clear()
                await self._compute(question, process)
                if self._question is question:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(self._changed.wait(), self._idle_s)
                    if self._question is question:
                        break
        finally:
            if self._task is asyncio.current_task():
                self._task = None
            await asyncio.to_thread(process.close)

    async def _compute(self, question: Question, process: ScoringProcesses[None]) -> None:
        """Compute the points of a curve until it is complete or replaced, and send it after each point. A
        StemmapError is sent with the curve and ends it; it is not raised."""
        points: list[dict[str, Any]] = []
        try:
            for value in question.values:
                points = [*points, await self._point(question, value, process)]
                if self._question is not question:
                    return
                self._tell(_state_of(question, points))
        except StemmapError as failure:
            if self._question is question:
                self._tell(_state_of(question, points, str(failure)))

    async def _point(
        self, question: Question, value: Value, process: ScoringProcesses[None]
    ) -> dict[str, Any]:
        """Return a point of the curve as a dict: `value` with its scores (see `_figures`), or with `error` if
        the value contradicts other parameters or the job failed.

        Args:
            question: The curve.
            value: Value of its parameter.
            process: Computes the job.

        Raises:
            StemmapError: The process cannot be started, or ended too often.
        """
        try:
            parameters = question.parameters.replace({question.name: value})
        except ParameterError as error:  # it contradicts another one
            return {"value": value, "error": error.what}
        answer = await asyncio.wrap_future(process.submit(Job(question.run, parameters.model_dump())))
        return {"value": value, **_figures(answer)}


def _state_of(question: Question, points: list[dict[str, Any]], error: str = "") -> dict[str, Any]:
    """Return a curve as a dict: `name`; `asked_with`, a dict from the dotted names of all parameters in force
    to their values; `of`, the number of values; `points`; and `error`.

    Args:
        question: Parameter, its values, and the other parameters.
        points: Points so far, see `Sensitivity._point`.
        error: Why the computation ended early; empty if it did not.
    """
    return {
        "name": question.name,
        "asked_with": question.parameters.flat(),
        "of": len(question.values),
        "points": points,
        "error": error,
    }


def _figures(answer: JobResult) -> dict[str, Any]:
    """Return the scores of a point as a dict: `f1`, `TA` and `TA_of`, `false` (number of false trees),
    `position_rmse_m`, `mean_pair_error_percent` and `trees`; only `error` if the job failed or no ground
    truth is near the path."""
    s = answer.scores
    if s is None or answer.problem:
        return {"error": answer.problem}
    return {
        "f1": s.f1,
        "TA": s.TA.count,
        "TA_of": s.TA.of,
        "false": s.FA.count + s.spurious,
        "position_rmse_m": s.position_rmse,
        "mean_pair_error_percent": s.mean_pair_error_percent,
        "trees": answer.trees,
    }
