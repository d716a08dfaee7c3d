"""Sensitivity of the score to a parameter: the score of the whole run over the range of the parameter.

The points are computed one by one in a child process of low priority, while the run continues.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from app.common.child_process import ChildProcess, ProtocolError, python_module
from app.sources.request import SourceRequest
from app.tuning.plan import TruthTable
from app.tuning.sweep.jobs import Job, JobResult, RunWithTruth, code_digest
from app.worker.protocol import Status
from pipeline.config import Parameters, field_specs
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError
from pipeline.types.records import TruthTrees

COMMAND = python_module("app.tuning.sweep.scoring", "--low-priority")
MOST_VALUES = 65
REMEMBERED = 4096  # answers
IDLE_S = 120.0  # the process and its cache end after this time without a question
_LONGEST_ANSWER = 1 << 20


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


def question_of(
    source: SourceRequest,
    digest: str,
    status: Status,
    truth: TruthTrees | None,
    parameters: Parameters,
    name: str,
    values: list[Value],
) -> Question:
    """Return the sensitivity curve of the open run that is to be computed.

    Args:
        source, digest, status: The open run; the digest is empty if none is open.
        truth: True trees, with the annotations.
        parameters: The parameters in force.
        name: Dotted name of the parameter.
        values: Its values, in the order in which they are computed.

    Raises:
        StemmapError: The run cannot be read again, or has no true trees.
    """
    if not digest:
        raise StemmapError("no run is open", remedy="Open one")
    if status.live:
        raise StemmapError("a live run cannot be read again", remedy="Open its recording")
    if truth is None or not len(truth.x):
        raise StemmapError(
            "the run has no true trees to score by",
            remedy="Annotate some trees in the tab Annotate, or import a table",
        )
    run = RunWithTruth(source.request(), digest, TruthTable.of(truth))
    return Question(run, parameters, name, tuple(values))


class Sensitivity:
    """Computes the newest sensitivity curve, point by point.

    Args:
        tell: Called with the points so far after each point, and with {} when the curve is removed.
        command: Program and arguments of the child process.
        idle_s: Time without a new curve after which the process ends [s].
    """

    def __init__(
        self,
        tell: Callable[[dict[str, Any]], None],
        command: Sequence[str] = COMMAND,
        idle_s: float = IDLE_S,
    ) -> None:
        self._tell, self._command, self._idle_s = tell, command, idle_s
        self._task: asyncio.Task[None] | None = None
        self._process: ChildProcess | None = None
        self._turn = asyncio.Lock()
        self._known: dict[str, JobResult] = {}
        self._scorings: set[asyncio.Task[JobResult]] = set()
        self._lefts = self._asked = 0

    def ask(self, question: Question) -> None:
        """Start a curve; the one before is cancelled.

        Raises:
            ParameterError: There is no such parameter, or there are too many values.
        """
        if question.name not in {spec.name for spec in field_specs()}:
            raise ParameterError(f"there is no parameter {question.name!r}")
        if not 1 <= len(question.values) <= MOST_VALUES:
            raise ParameterError(f"{len(question.values)} values are not between 1 and {MOST_VALUES}")
        self._stop()
        self._asked += 1
        self._task = asyncio.create_task(self._answer(question), name="sensitivity")

    async def leave(self) -> None:
        """Cancel the curve and end the process, because the run or the curve is closed."""
        self._lefts += 1
        task, scorings = self._stop(), set(self._scorings)
        if task is not None:
            await asyncio.wait([task])
        await self._end()
        if scorings:  # one of them may just start the process, and then ends it
            await asyncio.wait(scorings)
        self._known.clear()
        self._tell({})

    def _stop(self) -> asyncio.Task[None] | None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
        return task

    async def _answer(self, question: Question) -> None:
        state: dict[str, Any] = {
            "name": question.name,
            "asked_with": question.parameters.flat(),
            "of": len(question.values),
            "points": [],
            "error": "",
        }
        self._tell(state)
        try:
            code = await asyncio.to_thread(code_digest)
            for value in question.values:
                point = await self._point(question, value, code)
                state = {**state, "points": [*state["points"], point]}
                self._tell(state)
        except StemmapError as error:
            self._tell({**state, "error": str(error)})
        await asyncio.sleep(self._idle_s)
        async with self._turn:  # a job of an earlier question may still run
            await self._end()

    async def _point(self, question: Question, value: Value, code: str) -> dict[str, Any]:
        try:
            parameters = question.parameters.replace({question.name: value})
        except ParameterError as error:  # it contradicts another one
            return {"value": value, "error": error.what}
        job = Job(question.run, parameters.model_dump(), code)
        key = job.key()
        answer = self._known.get(key)
        if answer is None:
            # A job is completed even if another question comes meanwhile, because its cache serves both.
            scoring = asyncio.create_task(
                self._scored(job, key, (self._lefts, self._asked)), name="sensitivity of a value"
            )
            self._scorings.add(scoring)
            scoring.add_done_callback(self._is_scored)
            answer = await asyncio.shield(scoring)
        if answer.fault in ("worker", "version"):
            raise StemmapError(answer.error)
        return {"value": value, **_figures(answer)}

    async def _scored(self, job: Job, key: str, asked: tuple[int, int]) -> JobResult:
        """Return the result of a job from the child process, which is restarted once if it ends.

        Args:
            job: The job.
            key: Its key.
            asked: Numbers of calls of `leave` and `ask` when the job was requested; other numbers cancel it.

        Raises:
            StemmapError: The process ended twice, or the job was cancelled.
        """
        async with self._turn:
            if asked != (self._lefts, self._asked):  # not begun yet
                raise StemmapError("something else was asked for")
            if key in self._known:  # the earlier question had it computed
                return self._known[key]
            for _ in range(2):
                process = await self._started()
                if asked[0] != self._lefts:  # `leave` could not end it while it started
                    await self._end()
                    break
                answer = await _ask(process, job)
                if answer is not None:
                    if asked[0] == self._lefts and len(self._known) < REMEMBERED:
                        self._known[key] = answer
                    return answer
                await self._end()
        raise StemmapError("the process that maps the run ended twice", remedy="The terminal may show why")

    def _is_scored(self, scoring: asyncio.Task[JobResult]) -> None:
        self._scorings.discard(scoring)
        if not scoring.cancelled():
            scoring.exception()  # retrieved, because no task may wait for it any more

    async def _started(self) -> ChildProcess:
        if self._process is None:
            self._process = await ChildProcess.start(
                self._command, line_limit=_LONGEST_ANSWER, one_thread=True
            )
        return self._process

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            await process.end()


async def _ask(process: ChildProcess, job: Job) -> JobResult | None:
    """Return the result of a job; None if the process ends or sends something else."""
    await process.send(job)
    try:
        return await process.receive(JobResult)
    except ProtocolError:
        return None


def _figures(answer: JobResult) -> dict[str, Any]:
    """Return the scores of a point for the page, with units in the names."""
    s = answer.scores
    if s is None:
        return {"error": answer.error}
    return {
        "f1": s["f1"],
        "TA": s["TA"]["count"],
        "TA_of": s["TA"]["of"],
        "false": s["FA"]["count"] + s["spurious"],
        "position_rmse_m": s["position_rmse"],
        "mean_pair_error_percent": s["mean_pair_error_percent"],
        "trees": s["trees"],
    }
