"""Sensitivity of the score to a parameter: the score of the whole run over the range of the parameter.

The points are computed one by one in a child process of low priority, while the run continues.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.common.timers import cancel
from app.sources.request import SourceRequest
from app.tuning.grid import spec_of
from app.tuning.jobs import COMMAND as SCORING
from app.tuning.jobs import Job, JobResult, ResultStore, RunWithTruth, ScoringProcesses, check_run
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError
from pipeline.types.records import TruthTrees

COMMAND = (*SCORING, "--low-priority")
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


def question_of(
    source: SourceRequest,
    digest: str,
    truth: TruthTrees | None,
    parameters: Parameters,
    name: str,
    values: list[Value],
) -> Question:
    """Return the sensitivity curve of the open run that is to be computed. The name and the number of values
    are checked by `Sensitivity.ask`.

    Args:
        source, digest: The open run; the digest is empty if none is open.
        truth: True trees, with the annotations; None if none are known.
        parameters: The parameters in force.
        name: Dotted name of the parameter.
        values: Values of the parameter, in the order in which they are computed.

    Raises:
        StemmapError: No run is open, it is live, or it has no true trees.
    """
    run = RunWithTruth(source.request(), digest, check_run(digest, source.uri, truth))
    return Question(run, parameters, name, tuple(values))


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
        command: Sequence[str] = COMMAND,
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
