"""The process that owns the source and the mapper: `python -m app.worker.process`.

Commands arrive on stdin and messages are written to stdout, both
encoded by `app.worker.protocol`. The process ends when stdin ends, so it never outlives the web process.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
from functools import cache
from typing import BinaryIO

from app.common.child_process import private_streams
from app.common.memory import return_freed_memory
from app.common.text import COMPILING
from app.robot.source import LiveSource
from app.worker.loop import WorkerLoop
from app.worker.outbox import Outbox, RecentScans
from app.worker.protocol import ToWorker, WireError, to_worker
from app.worker.session import OpenSource, Session
from pipeline.config import Parameters
from pipeline.io.readers import path_of
from pipeline.io.readers.base import Source, SourceOptions
from pipeline.jit import on_compiling

# A scan that is being mapped, or a large file that is being opened, may take a moment to notice. A robot is
# left in 2 to 5 s.
_GRACE_S, _LIVE_GRACE_S = 1.0, 9.0


def open_any_or_one_step(uri: str, options: SourceOptions) -> Source | LiveSource:
    """Open a source by its URI: one that is mapped in one step, else as `open_any`.

    Raises:
        SourceError: The source does not exist, has an unknown format, or is damaged, or its extension is
            switched off.
    """
    from app.robot.source import open_any
    from app.sources.one_step import open_one_step

    return open_one_step(path_of(uri), options) or open_any(uri, options)


def new_session(open_source: OpenSource = open_any_or_one_step) -> Session:
    """Return a session that uses the real pipeline, for the worker and for commands that map in this
    process.

    Args:
        open_source: Opens a source by its URI and options.
    """
    from app.common.settings import from_environment
    from app.store.forests import mapper_of
    from app.worker.numba_warmup import compiling, warm_up

    return Session(
        open_source=open_source,
        budget=from_environment().run_budget,
        make_mapper=mapper_of,
        parameters=Parameters(),
        compiling=compiling,
        warm_up=warm_up,
    )


def work(session: Session, incoming: BinaryIO, outgoing: BinaryIO) -> None:
    """Execute the commands of a stream with a session until the stream ends or has a damaged message, and
    send the waiting messages. The process ends if the loop does not end soon after the stream, see `_read`.

    Args:
        session: The session; it is closed.
        incoming: Stream of encoded commands.
        outgoing: Stream for encoded messages.
    """
    from app.worker.numba_warmup import compiled_kernels

    commands: queue.Queue[ToWorker | None] = queue.Queue()
    finished = threading.Event()
    reader = threading.Thread(target=_read, args=(incoming, commands, finished, session), daemon=True)
    reader.start()
    recent = RecentScans()
    mailbox = Outbox(outgoing, recent)
    driver = WorkerLoop(session, commands, mailbox.put, recent=recent, kernels=compiled_kernels)
    with on_compiling(_notify_compilation), on_compiling(driver.compiling):
        driver.run()
    mailbox.close()
    finished.set()


@cache
def _notify_compilation() -> None:
    """Print once that a kernel is compiled."""
    print(f"stemmap: {COMPILING}", file=sys.stderr, flush=True)  # noqa: T201


def _read(
    incoming: BinaryIO, commands: queue.Queue[ToWorker | None], finished: threading.Event, session: Session
) -> None:
    """Read commands into the queue until the stream ends or has a damaged message, which is printed; then
    queue None, finish a recording, and end the process if the loop does not end within the grace period. Runs
    in a thread.

    Args:
        incoming: Stream of encoded commands.
        commands: The queue.
        finished: Set when the loop has ended.
        session: The session, whose recording is finished.
    """
    channel = to_worker()
    try:
        while (command := channel.read(incoming)) is not None:
            commands.put(command)
    except WireError as error:
        print(f"stemmap worker: {error}", file=sys.stderr)  # noqa: T201
    commands.put(None)
    is_live = session.end_recording()  # first, and from here: the loop may be compiling
    if not finished.wait(_LIVE_GRACE_S if is_live else _GRACE_S):
        os._exit(0)


def run_as_worker(session: Session) -> None:
    """Run this process as the worker of the web process that started it, until stdin ends; does not return.
    SIGINT is ignored."""
    return_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the web process, which then ends us
    incoming, outgoing = private_streams()
    work(session, incoming, outgoing)
    sys.stderr.flush()
    os._exit(0)  # nothing is left to be saved, and waiting for the threads of libraries takes seconds


if __name__ == "__main__":
    run_as_worker(new_session())
