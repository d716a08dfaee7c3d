"""Questions about files and robots from outside, which a child process with limits on time, memory and output
answers.

`ask` starts `app.sources.inspection_process`. A damaged or hostile file can affect only that process and not
the server, and the server does not import what only that process needs.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import msgspec

from app.common.child_process import ChildError, ChildProcess, ProtocolError, python_module
from app.sources.opening import check_address, check_cloud
from app.sources.request import SourceRequest
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers import check_existence, is_cloud

COMMAND = python_module("app.sources.inspection_process")
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
    OPENING_LIMIT_S. Of a whole cloud, it reads the header and the first points; on systems other than Linux,
    only the existence of the file is checked. Of simulated runs and live robots, only the address is checked.

    Raises:
        StemmapError: The source cannot be opened or takes too long; the error gives the reason.
    """
    if not check_address(request.uri):
        return
    if await asyncio.to_thread(is_cloud, request.uri):
        await asyncio.to_thread(check_cloud, request.uri)  # a copy of this process, which starts at once
    else:
        question = {"ask": "first_scan", "path": request.uri, "request": msgspec.to_builtins(request)}
        await ask(question, patience_s=OPENING_LIMIT_S)
