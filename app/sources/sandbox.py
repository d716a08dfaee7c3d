"""Runs `app.sources.inspect_process` in a child process with limits on time and output."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

from pipeline.errors import SourceError, StemmapError

# -P: a file `app.py` in the working directory must not replace this package.
EXAMINE = (sys.executable, "-P", "-m", "app.sources.inspect_process")
PATIENCE_S = 120.0
LARGEST_ANSWER = 64 << 20

_MOST_AT_ONCE = 2
# A semaphore belongs to the event loop of its first use.
_rooms: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = WeakKeyDictionary()


class TookTooLongError(StemmapError):
    """The child process was ended because it took too long."""


async def ask(
    question: dict[str, Any], *, patience_s: float = PATIENCE_S, command: Sequence[str] = EXAMINE
) -> dict[str, Any]:
    """Return the answer to a question of `app.sources.inspect_process.QUESTIONS`.

    Raises:
        SourceError: The source cannot be read; the error gives the reason.
        TookTooLongError: There was no answer in time.
    """
    async with _room():
        process = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C in the terminal is for the server
        )
        try:
            said = await asyncio.wait_for(_talk(process, json.dumps(question).encode()), patience_s)
        except TimeoutError:
            raise TookTooLongError("it takes too long to be read", where=question.get("path", "")) from None
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    return _told(said, question)


def _room() -> asyncio.Semaphore:
    """Return the semaphore of the running event loop."""
    return _rooms.setdefault(asyncio.get_running_loop(), asyncio.Semaphore(_MOST_AT_ONCE))


async def _talk(process: asyncio.subprocess.Process, question: bytes) -> bytes:
    assert process.stdin is not None  # noqa: S101 - it was asked for
    assert process.stdout is not None  # noqa: S101
    with contextlib.suppress(ConnectionError):
        process.stdin.write(question)
        await process.stdin.drain()
    process.stdin.close()
    parts, size = [], 0
    while part := await process.stdout.read(1 << 16):
        parts.append(part)
        size += len(part)
        if size > LARGEST_ANSWER:
            return b""
    return b"".join(parts)


def _told(said: bytes, question: dict[str, Any]) -> dict[str, Any]:
    try:
        told = json.loads(said)
        error = told.get("error")
        if error is None:
            answer: dict[str, Any] = told["answer"]
            return answer
    except (ValueError, KeyError, AttributeError):
        raise SourceError(
            "it could not be read: the reader ended without an answer",
            where=question.get("path", ""),
            remedy="The file is damaged, or this is a fault in stemmap; the terminal may show more",
        ) from None
    raise SourceError(error["what"], where=error.get("where", ""), remedy=error.get("remedy", ""))
