"""The web process's side of the worker: starts it, exchanges messages, and restarts it when it ends."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from typing import Literal

import msgspec

from app.common.child_process import ChildProcess, exit_reason, python_module, starved_s
from app.common.timers import cancel
from app.sources.live_address import is_live
from app.worker import protocol
from pipeline.errors import StemmapError

WORKER = python_module("app.worker.process")

OnMessage = Callable[[protocol.FromWorker], Awaitable[None]]

_log = logging.getLogger(__name__)

_PAUSES_S = (0.2, 0.5, 1.0, 2.0, 4.0)
_FORGIVEN_AFTER_S = 60.0
_GRACE_S = 0.7
#: Of a live run: the worker finishes the recording, then leaves the robot's network.
_LIVE_GRACE_S = 10.0
_BUFFER = 8 * 1024 * 1024
# Longest time without a message while a source is opened; a large recording on a slow disk takes a minute.
OPENING_LIMIT_S = 300.0
# Another source may be opened before the first is open. A live recording that is left may need 10 s to close.
_REPLACE_AFTER_S = 12.0
_WRITE_LIMIT_S = 5.0
# Longest time without a message while a run plays or a command is executed. A part of it is reported before.
SILENCE_LIMIT_S = 30.0
_NOTICE_SHARE = 6
# Commands that are stored and sent again after a restart, or that a new process does not need.
_REMEMBERED = (
    protocol.SetParameters,
    protocol.SetSpeed,
    protocol.Open,
    protocol.Play,
    protocol.Pause,
    protocol.Begin,
)


class WorkerProcess:
    """A worker process that is restarted when it ends.

    A restart repeats parameters, speed and source; the owner receives `Opened` again and decides how the run
    continues. After five ends within a minute, or when a source does not finish opening, the worker is not
    restarted until the next `Play` or `Open`.

    Args:
        command: Program and arguments of the process.
        clock: Returns the time [s] from any origin.
        opening_limit_s: Maximum time without a message while a source is being opened or kernels are compiled
            [s]. Time in which the worker waits for a processor is not counted, here and below.
        silence_limit_s: Maximum time without a message while a run plays or a command is executed [s].

    Attributes:
        restarts: Number of restarts after an unexpected end.
    """

    def __init__(
        self,
        command: Sequence[str] = WORKER,
        clock: Callable[[], float] = time.monotonic,
        opening_limit_s: float = OPENING_LIMIT_S,
        silence_limit_s: float = SILENCE_LIMIT_S,
    ) -> None:
        self._command = command
        self._clock = clock
        self._codec_in, self._codec_out = protocol.from_worker(), protocol.to_worker()
        self._on_message: OnMessage  # set by `start`
        self._process: ChildProcess | None = None
        self._task: asyncio.Task[None] | None = None
        self._open: protocol.Open | None = None
        self._settings: dict[type, protocol.ToWorker] = {}
        self._pauses_s = _PAUSES_S
        self._deaths: deque[float] = deque(maxlen=len(_PAUSES_S))
        self._wanted = asyncio.Event()
        self._opening_limit_s = opening_limit_s
        self._opening: Literal["", "requested", "begun"] = ""
        self._opening_since = 0.0
        self._replaced = False
        self._gave_up = False
        self._silence_limit_s = silence_limit_s
        self._silence: asyncio.Timeout | None = None
        self._status = protocol.Status(state="starting")
        self._has_command = False
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """Process number of the worker; None while it does not run."""
        return self._process.pid if self._process else None

    async def start(self, on_message: OnMessage) -> None:
        """Start the worker, unless it runs, and restart it whenever it ends. A worker that cannot be
        started is tried again.

        Args:
            on_message: Awaited on the event loop for each message in turn; must not block it.
        """
        self._on_message = on_message
        if self._process is None:
            await self.spawn()
        self._task = asyncio.create_task(self._watch(), name="worker")

    async def send(self, command: protocol.ToWorker) -> None:
        """Send a command. Parameters, speed and source are stored and sent again after a restart.

        An `Open` more than 12 s after another one whose source is still not open kills the worker, which then
        opens the new source. The call waits at most 5 s for the worker to read.

        Raises:
            WorkerBusyError: The worker does not run or does not read in time, and the command is a step, a
                seek or a question. Play, Pause and Begin are dropped without an error: after a restart, the
                answer to the next `Opened` states whether the run plays.
        """
        if isinstance(command, protocol.SetParameters | protocol.SetSpeed):
            self._settings[type(command)] = command
        elif isinstance(command, protocol.BeginRecording) and self._open is not None:
            self._open = msgspec.structs.replace(self._open, record=command.path)
        elif isinstance(command, protocol.Open):
            self._open = command
            if self._opening and self._clock() - self._opening_since > _REPLACE_AFTER_S:
                self._kill_while_opening()
                return
            self._await_opening()
        if isinstance(command, protocol.Open | protocol.Play):
            self._wanted.set()
        if not await self._write(command) and not isinstance(command, _REMEMBERED):
            raise protocol.WorkerBusyError(
                "the mapping process is not ready for commands", remedy="Try again in some seconds"
            )

    async def close(self) -> None:
        """Stop the supervision, ask the worker to end, and kill it if it does not within 0.7 s (10 s for a
        live run)."""
        await cancel(self._task)
        await self._end()

    async def spawn(self) -> None:
        """Start the process, and send it the stored parameters, speed and source. Its messages wait in the
        pipe until `start`. If the system cannot start it, it counts as ended."""
        try:
            self._process = await ChildProcess.start(self._command, line_limit=_BUFFER)
        except StemmapError:  # no memory, no process: counts as an end, so it is tried again
            return
        for command in (*self._settings.values(), self._open):
            if command is not None:
                await self._write(command)
        if self._open is not None:
            self._await_opening()

    async def _write(self, command: protocol.ToWorker) -> bool:
        """Write a command to the worker; return whether the worker accepted it in time. After an accepted
        command a message of the worker is due, see `_limit_s`."""
        process = self._process
        if process is None or process.stdin.is_closing():
            return False
        try:
            process.stdin.write(self._codec_out.encode(command))
            async with asyncio.timeout(_WRITE_LIMIT_S):
                await process.stdin.drain()
        except (ConnectionError, TimeoutError):
            return False
        self._has_command = True
        limit_s = self._limit_s()
        if self._silence is not None and self._silence.when() is None and limit_s is not None:
            self._silence.reschedule(asyncio.get_running_loop().time() + limit_s / _NOTICE_SHARE)
        return True

    async def _watch(self) -> None:
        """Pass on the messages of the worker and restart it whenever it ends, until the task is cancelled: at
        once if it was killed for another source, after `Play` or `Open` if opening took too long, else after
        `_pause`."""
        while True:
            reason = await self._listen()
            self._opening = ""
            await self._end()
            if self._replaced:  # another source was requested for while one did not finish opening
                self._replaced = False
            elif self._gave_up:
                self._gave_up = False
                await self._wait_for_a_person(
                    f"Opening took longer than {self._opening_limit_s:g} s and was ended. Open another "
                    "source, or press play to try again"
                )
            else:
                self._deaths.append(self._clock())
                await self._pause(reason)
                self.restarts += 1
            await self.spawn()

    # --- a source that does not finish opening ---------------------------------------------------

    def _await_opening(self) -> None:
        """Note that the source must be opened or refused in time."""
        self._opening, self._opening_since = "requested", self._clock()

    def _note_opening(self, message: protocol.FromWorker) -> None:
        """Update `_opening` from a message of the worker. Opening ends with `Opened` for the requested
        source, or with a status of it that is not "starting" after one that is."""
        if not self._opening or self._open is None:
            return
        if isinstance(message, protocol.Opened) and message.requested in ("", self._open.uri):
            self._opening = ""
        elif isinstance(message, protocol.Report) and message.status.source == self._open.uri:
            if message.status.state == "starting":
                self._opening = "begun"
            elif self._opening == "begun":
                self._opening = ""

    def _kill_while_opening(self) -> None:
        """Kill the worker because another source is requested; it is restarted at once."""
        self._replaced = True
        self._wanted.set()
        self._opening = ""
        if self._process is not None:
            self._process.kill()

    # --- messages ---------------------------------------------------------------------------------

    async def _listen(self) -> str:
        """Pass messages on until the worker ends, and return the reason of the end. A worker that hangs is
        killed; `_gave_up` then states whether a source was being opened."""
        process = self._process
        if process is None:
            return "it could not be started"
        self._status, self._has_command = protocol.Status(state="starting"), False
        try:
            while (head := await self._head(process.stdout)) is not None:
                size = int.from_bytes(head, "little")
                protocol.check_size(size)
                message = self._codec_in.decode(await process.stdout.readexactly(size))
                if isinstance(message, protocol.Report):
                    self._status = message.status
                await self._deliver(message)
        except asyncio.IncompleteReadError:
            return exit_reason(await process.end(self._grace_s))
        except protocol.WireError as error:
            return f"protocol error: {error}"
        self._gave_up = bool(self._opening)
        process.kill()
        return "it did not answer"

    async def _head(self, stdout: asyncio.StreamReader) -> bytes | None:
        """Wait for the length of the next message; None if the worker hangs, which is reported before, unless
        a source is being opened or kernels are compiled. Time in which the worker waits for a processor is
        not counted. Raises IncompleteReadError at its end."""
        silent_s = hung_s = 0.0
        before_s = starved_s(self.pid or 0)
        while True:
            limit_s = self._limit_s()
            pause_s = None if limit_s is None else limit_s / _NOTICE_SHARE
            try:
                async with asyncio.timeout(pause_s) as self._silence:
                    head = await stdout.readexactly(protocol.LENGTH_BYTES)
            except TimeoutError:
                limit_s = self._limit_s()
                if limit_s is None:
                    silent_s = hung_s = 0.0
                    continue
                now_s = starved_s(self.pid or 0)
                waited_s = pause_s or limit_s / _NOTICE_SHARE  # the latter since a command, see `_write`
                silent_s += waited_s
                hung_s += max(0.0, waited_s - (now_s - before_s))
                before_s = now_s
                if hung_s >= limit_s:
                    return None
                if limit_s == self._silence_limit_s:
                    detail = f"The mapping process has not answered for {silent_s:.0f} s"
                    await self._deliver(
                        protocol.Report(replace(self._status, state="waiting", detail=detail))
                    )
            else:
                self._has_command = False
                return head
            finally:
                self._silence = None

    def _limit_s(self) -> float | None:
        """Return the longest time [s] until the next message: the limit of opening while a source is being
        opened or kernels are compiled, and after a command to a failed run; the limit of silence while a run
        plays or waits, and after any other command; None otherwise and without a source."""
        status = self._status
        if self._open is None:
            return None
        if self._opening or status.state == "starting" or status.compiling_since_s is not None:
            return self._opening_limit_s
        if status.state == "failed":  # Play opens the source again
            return self._opening_limit_s if self._has_command else None
        return self._silence_limit_s if self._has_command or status.state in ("playing", "waiting") else None

    async def _deliver(self, message: protocol.FromWorker) -> None:
        """Await the function given to `start` with a message, and note from it whether the source is open.
        Errors of the function are logged and, except for a `Report`, reported as a failure; they do not end
        the supervision."""
        self._note_opening(message)
        try:
            await self._on_message(message)
        except Exception as error:  # logged; it must not end the supervision of the worker
            _log.exception("a message of the worker could not be handled")
            if not isinstance(message, protocol.Report):
                await self._report_failure(
                    f"A result could not be shown: {type(error).__name__}: {error}. This is a fault in "
                    "stemmap; the terminal shows where"
                )

    async def _pause(self, reason: str) -> None:
        """Report the end and wait before the next start, 0.2 s to 4 s; after five ends within a minute, wait
        for `Play` or `Open`.

        Args:
            reason: How the process ended, for people.
        """
        what = f"The mapping process ended ({reason})"
        recent = [t for t in self._deaths if self._clock() - t < _FORGIVEN_AFTER_S]
        if len(recent) < len(self._pauses_s):
            await self._report_failure(f"{what}; it is being started again")
            await asyncio.sleep(self._pauses_s[len(recent) - 1])
            return
        await self._wait_for_a_person(
            f"{what}, {len(recent)} times within a minute. Press play to try again, or open another run"
        )
        self._deaths.clear()

    async def _wait_for_a_person(self, detail: str) -> None:
        """Report why the worker does not run, and wait for `Play` or `Open`."""
        self._wanted.clear()
        await self._report_failure(detail)
        await self._wanted.wait()

    async def _report_failure(self, detail: str) -> None:
        """Deliver the status "failed" with a reason."""
        source = self._open.uri if self._open else ""
        await self._deliver(protocol.Report(protocol.Status(state="failed", detail=detail, source=source)))

    async def _end(self) -> None:
        """Close the standard input of the worker, wait for its end, and kill it after a grace period; nothing
        if it does not run."""
        process, self._process = self._process, None
        if process is None:
            return
        await process.end(self._grace_s)

    @property
    def _grace_s(self) -> float:
        """Time in which a worker ends by itself [s]: a live one first completes its recording."""
        return _LIVE_GRACE_S if self._open is not None and is_live(self._open.uri) else _GRACE_S
