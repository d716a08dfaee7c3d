"""How much a parameter matters: the score of the whole run over its range, computed in a process of its own
that gives way to all others, while the run goes on."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from app.tuning.sweep.jobs import Answer, Job, RunAsked, code_digest
from pipeline.config import Parameters, field_specs
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError

# -P: a folder that holds a file `app.py` must not decide what runs.
WORKER = (sys.executable, "-P", "-m", "app.tuning.sweep.worker", "--last")
MOST_VALUES = 65
REMEMBERED = 4096  # answers
IDLE_S = 120.0  # after which the process is ended, with what it keeps of the run
_LONGEST_ANSWER = 1 << 20
_ONE_CORE = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked.

    Attributes:
        run: The run, with its truth.
        parameters: All values; that of the parameter is replaced.
        name: Of the parameter, dotted.
        values: In the order in which they are computed: coarse first.
    """

    run: RunAsked
    parameters: Parameters
    name: str
    values: tuple[Value, ...]


class Sensitivity:
    """Answers the newest question, point by point.

    Args:
        tell: Told what is known, as plain values, after each point; {} where nothing is asked any more.
        command: Of the process.
        idle_s: How long the process waits for another question.
    """

    def __init__(
        self,
        tell: Callable[[dict[str, Any]], None],
        command: Sequence[str] = WORKER,
        idle_s: float = IDLE_S,
    ) -> None:
        self._tell, self._command, self._idle_s = tell, command, idle_s
        self._task: asyncio.Task[None] | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self._known: dict[str, Answer] = {}
        self._scorings: set[asyncio.Task[Answer]] = set()
        self._lefts = self._asked = 0

    def ask(self, question: Question) -> None:
        """Begin with a question; the one before is given up.

        Raises:
            ParameterError: There is no such parameter, or there are too many values.
        """
        if question.name not in {spec.name for spec in field_specs()}:
            raise ParameterError(f"there is no parameter {question.name!r}")
        if not 1 <= len(question.values) <= MOST_VALUES:
            raise ParameterError(f"{len(question.values)} values are not 1 to {MOST_VALUES}")
        self._stop()
        self._asked += 1
        self._task = asyncio.create_task(self._answer(question), name="sensitivity")

    async def leave(self) -> None:
        """Nobody asks any more, or the run is left: the process ends."""
        self._lefts += 1
        task, scorings = self._stop(), set(self._scorings)
        if task is not None:
            await asyncio.wait([task])
        await self._end()
        if scorings:  # one of them may be starting the process, and ends it then
            await asyncio.wait(scorings)
        self._known.clear()
        self._tell({})

    def _stop(self) -> asyncio.Task[None] | None:
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
        return task

    async def _answer(self, question: Question) -> None:
        told: dict[str, Any] = {
            "name": question.name,
            "asked_with": question.parameters.flat(),
            "of": len(question.values),
            "points": [],
            "error": "",
        }
        self._tell(told)
        try:
            code = await asyncio.to_thread(code_digest)
            for value in question.values:
                point = await self._point(question, value, code)
                told = {**told, "points": [*told["points"], point]}
                self._tell(told)
        except StemmapError as error:
            self._tell({**told, "error": str(error)})
        await asyncio.sleep(self._idle_s)
        async with self._turn:  # what was begun for a question before may still be under way
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
            # What is begun is ended even if another is asked meanwhile: the scans are looked at for both.
            scoring = asyncio.create_task(self._scored(job, key), name="sensitivity of a value")
            self._scorings.add(scoring)
            scoring.add_done_callback(self._is_scored)
            answer = await asyncio.shield(scoring)
        if answer.fault in ("worker", "version"):
            raise StemmapError(answer.error)
        return {"value": value, **_figures(answer)}

    async def _scored(self, job: Job, key: str) -> Answer:
        """What the process answers; it is started anew once where it ends.

        Raises:
            StemmapError: It ends again, or nobody asks for this any more.
        """
        lefts, asked = self._lefts, self._asked
        async with self._turn:
            if (lefts, asked) != (self._lefts, self._asked):  # it was not begun
                raise StemmapError("something else was asked for")
            if key in self._known:  # begun for the question before
                return self._known[key]
            for _ in range(2):
                process = await self._started()
                if lefts != self._lefts:  # nobody else ends one that was being started then
                    await self._end()
                    break
                answer = await _said(process, job)
                if answer is not None:
                    if lefts == self._lefts and len(self._known) < REMEMBERED:
                        self._known[key] = answer
                    return answer
                await self._end()
        raise StemmapError("the process that maps the run ended twice", remedy="The terminal may show why")

    def _is_scored(self, scoring: asyncio.Task[Answer]) -> None:
        self._scorings.discard(scoring)
        if not scoring.cancelled():
            scoring.exception()  # heard, though nobody may wait for it any more

    async def _started(self) -> asyncio.subprocess.Process:
        if self._process is None:
            try:
                self._process = await asyncio.create_subprocess_exec(
                    *self._command,
                    stdin=asyncio.subprocess.PIPE,
                    stdout=asyncio.subprocess.PIPE,
                    start_new_session=True,  # Ctrl-C in the terminal is for the server
                    env={**_ONE_CORE, **os.environ},
                    limit=_LONGEST_ANSWER,
                )
            except OSError as error:
                raise StemmapError(
                    f"no process can be started to map the run: {error.strerror}",
                    remedy="Close other programs, and ask again",
                ) from None
        return self._process

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


async def _said(process: asyncio.subprocess.Process, job: Job) -> Answer | None:
    """The answer to a job; None where the process ends, or says something else."""
    assert process.stdin is not None  # noqa: S101 - it was asked for
    assert process.stdout is not None  # noqa: S101
    with contextlib.suppress(ConnectionError):
        process.stdin.write(msgspec.json.encode(job) + b"\n")
        await process.stdin.drain()
    try:
        return msgspec.json.decode(await process.stdout.readline(), type=Answer)
    except (msgspec.MsgspecError, ValueError):  # a line may be too long
        return None


def _figures(answer: Answer) -> dict[str, Any]:
    """Of a point, with the units in the names."""
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
