"""The web process's side of the worker: starts it, talks to it, and starts it again when it dies."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence

from app.robot.address import is_live
from app.worker.codec import LENGTH_BYTES, WireError, check_size, from_worker, to_worker
from app.worker.internal_protocol import FromWorker, Report, ToWorker
from app.worker.protocol import Open, Play, SetParameters, SetSpeed, Status

# -P: a folder that holds a file `app.py` must not decide what runs.
WORKER = (sys.executable, "-P", "-m", "app.worker.process")

_log = logging.getLogger(__name__)

_PAUSES_S = (0.2, 0.5, 1.0, 2.0, 4.0)
_FORGIVEN_AFTER_S = 60.0
_GRACE_S = 0.7
#: Of a live run: the worker finishes the recording, then leaves the robot's network.
_LIVE_GRACE_S = 10.0
_BUFFER = 8 * 1024 * 1024


class WorkerProcess:
    """A worker that is kept alive.

    When it dies it is started again, with the same parameters, speed and source; the owner sees
    `Opened` again and decides how it goes on. After five deaths within a minute it stays dead until
    somebody plays or opens again.

    Args:
        on_message: Awaited on the event loop for each message in turn; must not block it.
        command: The program and its arguments.
        clock: Seconds from any start.
    """

    def __init__(
        self,
        on_message: Callable[[FromWorker], Awaitable[None]],
        command: Sequence[str] = WORKER,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._on_message = on_message
        self._command = command
        self._clock = clock
        self._channel_in, self._channel_out = from_worker(), to_worker()
        self._process: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None
        self._closing = False
        self._open: Open | None = None
        self._settings: dict[type, ToWorker] = {}
        self._pauses_s = _PAUSES_S
        self._deaths: deque[float] = deque(maxlen=len(_PAUSES_S))
        self._wanted = asyncio.Event()
        self.restarts = 0

    @property
    def pid(self) -> int | None:
        """Of the worker, None while there is none."""
        return self._process.pid if self._process else None

    async def start(self) -> None:
        """Start the worker and watch over it."""
        await self._spawn()
        self._task = asyncio.create_task(self._watch(), name="worker")

    async def send(self, command: ToWorker) -> None:
        """Send a command. What the worker must know again after a restart is remembered; while it is
        down, other commands are lost."""
        if isinstance(command, SetParameters | SetSpeed):
            self._settings[type(command)] = command
        elif isinstance(command, Open):
            self._open = command
        if isinstance(command, Open | Play):
            self._wanted.set()
        await self._write(command)

    async def close(self) -> None:
        """End the worker: kindly, then not."""
        self._closing = True
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        await self._end()

    async def _spawn(self) -> None:
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=_BUFFER,
                start_new_session=True,  # Ctrl-C in the terminal must not reach it
            )
        except OSError:  # no memory, no process: counts as a death, so it is tried again
            return
        for command in (*self._settings.values(), self._open):
            if command is not None:
                await self._write(command)

    async def _write(self, command: ToWorker) -> None:
        process = self._process
        if process is None or process.stdin is None or process.stdin.is_closing():
            return
        with contextlib.suppress(ConnectionError):
            process.stdin.write(self._channel_out.encode(command))
            await process.stdin.drain()

    async def _watch(self) -> None:
        while True:
            reason = await self._listen()
            await self._end()
            self._deaths.append(self._clock())
            await self._pause(reason)
            self.restarts += 1
            await self._spawn()

    async def _listen(self) -> str:
        """Hand on messages until the worker ends. Returns why it ended, in words."""
        process = self._process
        if process is None or process.stdout is None:
            return "it could not be started"
        try:
            while True:
                size = int.from_bytes(await process.stdout.readexactly(LENGTH_BYTES), "little")
                check_size(size)
                await self._hand_on(self._channel_in.decode(await process.stdout.readexactly(size)))
        except asyncio.IncompleteReadError:
            return _ending(await process.wait())
        except WireError as error:
            return f"it spoke gibberish: {error}"

    async def _hand_on(self, message: FromWorker) -> None:
        try:
            await self._on_message(message)
        except Exception:  # a fault in showing must not end the watch over the worker
            _log.exception("a message of the worker could not be handled")

    async def _pause(self, reason: str) -> None:
        """Wait before the next start, longer each time; forever when it dies again and again."""
        what = f"The mapping process ended ({reason})"
        recent = [t for t in self._deaths if self._clock() - t < _FORGIVEN_AFTER_S]
        if len(recent) < len(self._pauses_s):
            await self._tell(f"{what}; it is being started again")
            await asyncio.sleep(self._pauses_s[len(recent) - 1])
            return
        await self._tell(
            f"{what}, {len(recent)} times within a minute. Press play to try again, or open another run"
        )
        self._deaths.clear()
        self._wanted.clear()
        await self._wanted.wait()

    async def _tell(self, detail: str) -> None:
        source = self._open.uri if self._open else ""
        await self._hand_on(Report(Status(state="failed", detail=detail, source=source)))

    async def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            grace_s = _LIVE_GRACE_S if self._open is not None and is_live(self._open.uri) else _GRACE_S
            await asyncio.wait_for(process.wait(), grace_s)
        except TimeoutError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()


def _ending(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    with contextlib.suppress(ValueError):
        return f"signal {-code}, {signal.Signals(-code).name}"
    return f"signal {-code}"
