"""Opening of files from outside, and questions about files and robots, in child processes with limits on
memory, computing time, time and output.

A damaged or hostile file can take gigabytes, hang, or end the process that opens it. `open_source` opens it
first in a copy of this process, with limits that grow with the size of the file. `ask` starts
`app.dashboard.inspection_process` for the server, which does not import what only that process needs.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import faulthandler
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from weakref import WeakKeyDictionary

import msgspec

from app.common.child_process import ChildError, ChildProcess, ProtocolError, python_module
from app.sources.live_address import is_live, parse_address
from app.sources.one_step import check_one_step, is_one_step
from app.sources.request import SourceRequest
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers import (
    Source,
    SourceOptions,
    check_existence,
    format_of_address,
    path_of,
)
from pipeline.io.readers import open_source as _open_source
from pipeline.simulation.scenarios import SCHEME, parse_uri

_PR_SET_PDEATHSIG = 1
_DAMAGED = "The file is damaged, or this is a fault in stemmap"


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """Limits of a child process.

    Attributes:
        memory: Memory that it may take in addition to that of its parent [bytes].
        cpu_s: Computing time [s].
        wall_s: Time [s].
    """

    memory: int
    cpu_s: int
    wall_s: float

    @classmethod
    def for_size(cls, size: int) -> ProcessLimits:
        """Return the limits for reading a file of `size` bytes: 512 MB and twice its size of memory, 6 s and
        1 s per 4 MB of computing time, 60 s and 1 s per 5 MB of time."""
        return cls((512 << 20) + 2 * size, 6 + size // 4_000_000, 60.0 + size / 5_000_000)


def run_limited(work: Callable[[], object], limits: ProcessLimits, where: str) -> bool | None:
    """Run a function in a copy of this process, which is killed at its limits. Return its result if that is a
    bool, else None.

    The copy has only the calling thread: the function must not wait for other threads. It is available on
    Linux; on other systems nothing is run.

    Args:
        work: The function.
        limits: Limits of the copy.
        where: File in errors.

    Raises:
        SourceError: The function raised a StemmapError, whose text it has; or the copy exceeded a limit, or
            ended without an answer, as after any other exception.
    """
    if sys.platform != "linux":
        return None
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        _be_child(work, limits, where, sending)
    os.close(sending)
    try:
        answer = _answer(receiving, limits.wall_s)
    finally:
        os.close(receiving)
        os.kill(child, signal.SIGKILL)  # also at Ctrl-C; not reaped yet, so the number is still its own
        _, status = os.waitpid(child, 0)
    if answer is None:
        raise SourceError("it takes too long to be read", where=where, remedy=_DAMAGED)
    if not answer:
        slow = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
        what = "it takes too long to be read" if slow else "the reader ended without an answer"
        raise SourceError(what, where=where, remedy=_DAMAGED)
    outcome: tuple[str, str, str] | bool | None = msgspec.json.decode(
        answer, type=tuple[str, str, str] | bool | None
    )
    if isinstance(outcome, tuple):
        what, place, remedy = outcome
        raise SourceError(what, where=place, remedy=remedy)
    return outcome


def _answer(receiving: int, wall_s: float) -> bytes | None:
    """Return what the child writes to the pipe `receiving` until it closes it, as at its end; None if that
    takes longer than `wall_s` [s]."""
    answer, until_s = b"", time.monotonic() + wall_s
    while select.select([receiving], [], [], max(until_s - time.monotonic(), 0.0))[0]:
        block = os.read(receiving, 1 << 16)
        if not block:
            return answer
        answer += block
    return None


def _be_child(work: Callable[[], object], limits: ProcessLimits, where: str, sending: int) -> NoReturn:
    """Run the function in the copy with its limits, write its error or its result (a bool, else null) as
    JSON, and end the copy; nothing is written after exceptions other than StemmapError and MemoryError.

    Args:
        work, limits, where: As in `run_limited`.
        sending: File descriptor of the pipe to the parent.
    """
    import resource

    outcome: tuple[str, str, str] | bool | None = None
    try:
        faulthandler.disable()
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)  # libraries print why they end the process
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        used_s = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s = int(used_s.ru_utime + used_s.ru_stime) + limits.cpu_s
        resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
        resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + limits.memory,) * 2)
        result = work()
        outcome = result if isinstance(result, bool) else None
    except StemmapError as raised:
        outcome = raised.what, raised.where, raised.remedy
    except MemoryError:
        outcome = "it takes more memory than a file of its size should", where, _DAMAGED
    except BaseException:
        os._exit(1)
    os.write(sending, msgspec.json.encode(outcome))
    os._exit(0)


def _data_bytes() -> int:
    """Return the memory of this process that RLIMIT_DATA counts (VmData) [bytes]; Linux only."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))


def check_address(uri: str) -> bool:
    """Check that a file or folder exists, and the form of the address of a live robot or a simulated run.
    Nothing is opened.

    Returns:
        True for a file or folder; False for the address of a live robot or a simulated run.

    Raises:
        StemmapError: The source does not exist, or the address is wrong.
    """
    if is_live(uri):
        parse_address(uri)
    elif uri.startswith(SCHEME) and not Path(uri).exists():
        kind = format_of_address(uri)
        check = parse_uri if kind is None else kind.check
        if check is not None:
            check(uri)
    else:
        check_existence(uri)
        return True
    return False


def open_source(uri: str, options: SourceOptions | None = None) -> Source:
    """Open a run, see `pipeline.io.readers.open_source`. On Linux a file or folder is first opened, with its
    ground truth, in a child process with limits, so that it is read twice.

    Raises:
        SourceError: The source cannot be read, or takes more time or memory than a file of its size should.
    """
    if not is_one_step(uri, options):  # else the extension that opens it checks it
        check_opening(lambda: _open_source(uri, options).truth(), uri)
    return _open_source(uri, options)


def check_opening(opening: Callable[[], object], uri: str) -> bool | None:
    """Run an opening with limits, see `run_limited`, if the source is a file or a folder; otherwise do
    nothing. Return its result if it is a bool. Raises SourceError if it fails or exceeds its limits."""
    size = _size(uri)
    return None if size is None else run_limited(opening, ProcessLimits.for_size(size), uri)


def _size(uri: str) -> int | None:
    """Return the size of a file, or of all files in a folder, also in subfolders [bytes]; None if there is no
    such path or it cannot be read."""
    with contextlib.suppress(OSError, ValueError, RuntimeError):
        path = Path(path_of(uri)).expanduser()
        if path.is_dir():
            return sum(inside.stat().st_size for inside in path.rglob("*") if inside.is_file())
        return path.stat().st_size
    return None


# --- questions of the server ------------------------------------------------------------------------

COMMAND = python_module("app.dashboard.inspection_process")
PATIENCE_S = 120.0
#: A large recording on a slow disk takes minutes to be opened.
OPENING_LIMIT_S = 300.0
LARGEST_ANSWER = 64 << 20
MEMORY_LIMIT = 8 << 30
_MOST_AT_ONCE = 2
# A semaphore belongs to the event loop of its first use.
_semaphores: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = WeakKeyDictionary()


class TookTooLongError(StemmapError):
    """The child process was ended because it took too long."""


async def ask(
    question: dict[str, Any], *, patience_s: float = PATIENCE_S, command: Sequence[str] = COMMAND
) -> dict[str, Any]:
    """Return the answer of a child process to a question. At most two questions of an event loop are answered
    at the same time; further ones wait, without a time limit. A path that does not exist is refused without a
    process.

    Args:
        question: `ask` is a key of `inspection_process.QUESTIONS`, `path` the source; further values depend
            on the question.
        patience_s: Time limit of the answer [s].
        command: Program and arguments of the child process.

    Raises:
        SourceError: The path does not exist, the child reports an error, whatever its kind, or it ends
            without a valid answer.
        TookTooLongError: There was no answer in time.
        StemmapError: The process cannot be started.
    """
    path = question.get("path", "")
    if path:
        check_existence(path)  # at once: the child process needs seconds to start
    free = _semaphores.setdefault(asyncio.get_running_loop(), asyncio.Semaphore(_MOST_AT_ONCE))
    async with free, await ChildProcess.start(command, line_limit=LARGEST_ANSWER) as child:
        try:
            await child.send(question)
            answer: dict[str, Any] | None = await child.receive(dict, patience_s)
        except ProtocolError:
            answer = None
        except ChildError as error:
            raise SourceError(error.what, where=error.where, remedy=error.remedy) from None
        except TimeoutError:
            raise TookTooLongError("it takes too long to be read", where=path) from None
    if answer is None:
        raise SourceError(
            "it could not be read: the reader ended without an answer",
            where=path,
            remedy="The file is damaged, or this is a fault in stemmap; the terminal may show more",
        )
    return answer


async def check_source(request: SourceRequest) -> None:
    """Check that a source can be opened. Of a recording, a child process reads the first scan, within
    OPENING_LIMIT_S. A source that is mapped in one step is checked by its extension. Of simulated runs and
    live robots, only the address is checked.

    Raises:
        StemmapError: The source cannot be opened or takes too long; the error gives the reason.
    """
    if not check_address(request.uri):
        return
    options = request.options()
    if not await asyncio.to_thread(check_one_step, request.uri, options):
        question = {"ask": "first_scan", "path": request.uri, "request": msgspec.to_builtins(request)}
        await ask(question, patience_s=OPENING_LIMIT_S)
