"""Child processes that exchange lines of JSON with the process that started them.

The parent starts `python -m MODULE` without a shell, writes one JSON value per line to the child's standard
input and reads one JSON value per line from its standard output. A child ends when its standard input does,
so that it never outlives its parent. The parent limits the length of a line and the time that it waits; a
child that reads files from outside limits its own memory.

The parent uses `ChildProcess` on an event loop and `BlockingChildProcess` in a thread; the child's program is
a function that is passed to `run_child`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO, NoReturn, SupportsFloat, TypeVar

import msgspec

from pipeline.errors import StemmapError

T = TypeVar("T")

#: Default limit of a line [bytes].
LINE_LIMIT = 16 << 20
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


# First byte of a line with the error that ended a child; no JSON begins with it.
_FAILURE = b"!"


class ProtocolError(StemmapError):
    """A child process sent a line that is too long or is not the expected JSON."""


class ChildError(StemmapError):
    """The error for people with which the program of a child process ended."""


def python_module(name: str, *arguments: str) -> tuple[str, ...]:
    """Return the command that runs a module of this program in another Python process.

    Args:
        name: Dotted name of the module.
        arguments: Arguments of the command line.
    """
    # -P: a file `app.py` in the working directory must not replace this package.
    return (sys.executable, "-P", "-m", name, *arguments)


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def exit_reason(returncode: int) -> str:
    """Return how a process ended: "signal 9, SIGKILL" or "exit code 1"; "signal 99" for an unknown signal.

    Args:
        returncode: Return code; that of a process that a signal ended is the negative number of the signal.
    """
    if returncode >= 0:
        return f"exit code {returncode}"
    with contextlib.suppress(ValueError):
        return f"signal {-returncode}, {signal.Signals(-returncode).name}"
    return f"signal {-returncode}"


def starved_s(pid: int) -> float:
    """Return the time [s] for which the main thread of a process has waited for a processor since its start;
    0 if the process does not exist or the system does not report it."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="ascii").split()[1]) / 1e9
    except (OSError, ValueError, IndexError):
        return 0.0


class ChildProcess:
    """A child process, used from an event loop. Create it with `start`; as a context manager it ends the
    process.

    Attributes:
        pid: Process number.
        stdin, stdout: Standard input and output of the process, for other messages than lines of JSON.
    """

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdin is not None  # noqa: S101 - `start` opens both
        assert process.stdout is not None  # noqa: S101
        self._process, self.stdin, self.stdout = process, process.stdin, process.stdout
        self.pid = process.pid

    @classmethod
    async def start(cls, command: Sequence[str], *, line_limit: int = LINE_LIMIT) -> ChildProcess:
        """Start a process; its standard error is that of this process.

        Args:
            command: Program and arguments, see `python_module`.
            line_limit: Longest line that is accepted [bytes].

        Raises:
            StemmapError: The system cannot start it.
        """
        try:
            process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=line_limit,
                start_new_session=True,  # Ctrl-C in the terminal is for the parent, which ends its children
            )
        except OSError as error:
            raise _cannot_start(error) from None
        return cls(process)

    async def __aenter__(self) -> ChildProcess:
        return self

    async def __aexit__(self, *_error: object) -> None:
        await self.end()

    async def send(self, message: object) -> None:
        """Send a message as a line of JSON; waits while the pipe is full. If the child has ended, nothing is
        raised; `receive` then returns None.

        Raises:
            NotImplementedError: The message has a value without a form in JSON; nothing is sent.
        """
        with contextlib.suppress(ConnectionError):
            self.stdin.write(_encoded(message))
            await self.stdin.drain()

    async def receive(self, kind: type[T], timeout_s: float | None = None) -> T | None:
        """Wait for the next message; None when the child has ended.

        Args:
            kind: Type that the message must have.
            timeout_s: Longest wait [s]; None for no limit.

        Raises:
            ChildError: The program of the child ended with this error.
            ProtocolError: The line is too long or is not of this type; the child is to be ended.
            TimeoutError: No line came in time; the child still runs.
        """
        try:
            async with asyncio.timeout(timeout_s):
                line = await self.stdout.readline()
        except ValueError:
            raise ProtocolError("protocol error: a line is too long") from None
        return _decoded(line, kind)

    async def end(self, grace_s: float = 0.0) -> int:
        """Close the child's standard input, wait for `grace_s` [s] and kill the child if it still runs. A
        second call returns the same code.

        Returns:
            Its return code; negative number of the signal that ended it.
        """
        self.stdin.close()
        try:
            if grace_s > 0.0:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._wait(), grace_s)
        finally:
            self.kill()
            await self._wait()
        return self._process.returncode or 0

    def kill(self) -> None:
        """Kill the child, if it runs, without waiting for its end."""
        if self._process.returncode is None:
            # `Process.kill` would reap a child that has just died, and its return code would be lost.
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    async def _wait(self) -> None:
        """Wait for the end of the process. Its remaining output is read, because a full pipe would block
        it."""
        with contextlib.suppress(RuntimeError):  # another task waits in `receive`, which reads it
            while await self.stdout.read(1 << 16):
                pass
        await self._process.wait()


class BlockingChildProcess:
    """A child process, used from a thread that may wait. It starts at once; its standard error is that of
    this process. The caller ends it with `end`.

    Args:
        command: Program and arguments, see `python_module`.
        line_limit: Longest line that is accepted [bytes].
        one_thread: Whether its numerical libraries use one thread each, unless the environment sets a number.

    Attributes:
        pid: Process number.

    Raises:
        StemmapError: The system cannot start it.
    """

    def __init__(
        self, command: Sequence[str], *, line_limit: int = LINE_LIMIT, one_thread: bool = False
    ) -> None:
        self._line_limit = line_limit
        try:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C in the terminal is for the parent, which ends its children
                env={**(dict.fromkeys(_THREAD_VARIABLES, "1") if one_thread else {}), **os.environ},
            )
        except OSError as error:
            raise _cannot_start(error) from None
        assert self._process.stdin is not None  # noqa: S101 - opened above
        assert self._process.stdout is not None  # noqa: S101
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """The return code; None while the child runs."""
        return self._process.poll()

    def send(self, message: object) -> None:
        """Send a message as a line of JSON; waits while the pipe is full. If the child has ended, nothing is
        raised; `receive` then returns None.

        Raises:
            NotImplementedError: The message has a value without a form in JSON; nothing is sent.
        """
        with contextlib.suppress(ConnectionError):
            self._stdin.write(_encoded(message))
            self._stdin.flush()

    def receive(self, kind: type[T], timeout_s: float | None = None) -> T | None:
        """Wait for the next message; None when the child has ended, also because it took too long.

        Args:
            kind: Type that the message must have.
            timeout_s: After this time the child is killed [s]; None for no limit.

        Raises:
            ChildError: The program of the child ended with this error.
            ProtocolError: The line is too long or is not of this type; the child is to be ended.
        """
        timer = None if timeout_s is None else threading.Timer(timeout_s, self._process.kill)
        if timer is not None:
            timer.start()
        try:
            line = self._stdout.readline(self._line_limit + 1)
        finally:
            if timer is not None:
                timer.cancel()
        if len(line) > self._line_limit:
            raise ProtocolError("protocol error: a line is too long")
        return _decoded(line, kind)

    def end(self, grace_s: float = 0.0) -> int:
        """Close the child's standard input, wait for `grace_s` [s] and kill the child if it still runs. A
        thread that waits in `receive` gets None.

        Returns:
            Its return code; negative number of the signal that ended it.
        """
        with contextlib.suppress(ConnectionError):
            self._stdin.close()
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
        returncode = self._process.wait()
        self._stdout.close()
        return returncode


class ParentConnection:
    """The child's end: messages from and to the parent. A thread reads from the parent from now on; it ends
    this process with code 1 when the parent closes the connection or ends.

    Args:
        incoming, outgoing: Streams of lines from and to the parent.
    """

    def __init__(self, incoming: BinaryIO, outgoing: BinaryIO) -> None:
        self._incoming, self._outgoing = incoming, outgoing
        self._lines: queue.Queue[bytes] = queue.Queue()
        threading.Thread(target=self._read, name="parent", daemon=True).start()

    @property
    def has_message(self) -> bool:
        """Whether `receive` would return at once."""
        return not self._lines.empty()

    def receive(self, kind: type[T]) -> T:
        """Return the next message, of type `kind`; waits for it without a time limit.

        Raises:
            ProtocolError: The message is not of this type.
        """
        message = _decoded(self._lines.get(), kind)
        assert message is not None  # noqa: S101 - only whole lines are queued
        return message

    def send(self, message: object) -> None:
        """Send a message as a line of JSON to the parent.

        Raises:
            NotImplementedError: The message has a value without a form in JSON.
            BrokenPipeError: The parent has ended.
        """
        self._outgoing.write(_encoded(message))
        self._outgoing.flush()

    def fail(self, error: StemmapError) -> int:
        """Send the error that ends the program, unless the parent has ended; return 1, the exit code."""
        with contextlib.suppress(BrokenPipeError):
            self._outgoing.write(_FAILURE + _encoded((error.what, error.where, error.remedy)))
            self._outgoing.flush()
        return 1

    def _read(self) -> None:
        """Queue the lines of the parent until it closes the connection; then end this process with code 1.
        Runs in a thread."""
        for line in self._incoming:
            if line.endswith(b"\n"):
                self._lines.put(line)
        os._exit(1)


def run_child(
    main: Callable[[ParentConnection], None],
    *,
    memory_limit: int | None = None,
    low_priority: bool = False,
) -> NoReturn:
    """Run the program of a child process, then end the process: with code 0; with 1 after a StemmapError or
    lack of memory, which the parent's `receive` raises as a ChildError; with 1 after another exception, whose
    traceback is printed; after SystemExit with its code, or with 1 if that is a message, which is printed;
    with 1 at once when the parent closes the connection or ends. It never returns.

    Standard input is empty for the program, and what it prints goes to standard error. Ctrl-C is ignored: the
    parent ends its children.

    Args:
        main: The program.
        memory_limit: Memory that the process may allocate [bytes]; more raises MemoryError. File mappings do
            not count. Not available on Windows.
        low_priority: Whether all other processes come first.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if low_priority and hasattr(os, "nice"):
        os.nice(10)
    if memory_limit is not None:
        _limit_memory(memory_limit)
    incoming, outgoing = private_streams()
    parent, code = ParentConnection(incoming, outgoing), 0
    try:
        main(parent)
    except StemmapError as error:
        code = parent.fail(error)
    except MemoryError:
        code = parent.fail(StemmapError("this needs more memory than this machine has"))
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
        if isinstance(error.code, str):
            sys.stderr.write(error.code + "\n")
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    os._exit(code)  # the thread that reads from the parent still waits


def private_streams() -> tuple[BinaryIO, BinaryIO]:
    """Return the pipes from and to the parent as streams of their own, so that no library can read or write
    them.

    Afterwards standard input is empty, and standard output is standard error.
    """
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.close(nowhere)
    os.dup2(2, 1)
    return incoming, outgoing


def _limit_memory(limit: int) -> None:
    """Limit the data segment of this process [bytes]; nothing happens where the system cannot limit it."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


def _encoded(message: object) -> bytes:
    """Return a message as a line of JSON; raises NotImplementedError for a value that cannot be sent."""
    return msgspec.json.encode(message, enc_hook=_number) + b"\n"


def _number(value: object) -> object:
    """Return a NumPy scalar, or another value with `__float__`, as a Python number; raises
    NotImplementedError for other values."""
    if isinstance(value, SupportsFloat):
        return value.item() if hasattr(value, "item") else float(value)
    raise NotImplementedError(f"{type(value).__name__} cannot be sent")


def _decoded(line: bytes, kind: type[T]) -> T | None:
    """Return the message in a line; None for a line without a newline at its end.

    Raises:
        ChildError: The line has the error that ended the child.
        ProtocolError: The line is not JSON of this type.
    """
    if not line.endswith(b"\n"):  # the sender ended, possibly in the middle of a line
        return None
    try:
        if line.startswith(_FAILURE):
            what, where, remedy = msgspec.json.decode(line[1:], type=tuple[str, str, str])
            raise ChildError(what, where=where, remedy=remedy)
        return msgspec.json.decode(line, type=kind)
    except msgspec.MsgspecError as error:
        raise ProtocolError(f"protocol error: {error}") from None


def _cannot_start(error: OSError) -> StemmapError:
    """Return the error for people of a process that the system cannot start."""
    return StemmapError(
        f"no process can be started: {error.strerror}", remedy="Close other programs and try again"
    )
