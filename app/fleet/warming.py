"""Compiles before the workers of a fleet start, so that they do not all compile the same at once."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Sequence

from app.common.compile_ahead import PATIENCE_S

WARMING = (sys.executable, "-P", "-c", "from app.worker.numba_warmup import warm_up; warm_up()")
COMPILING = "Getting ready; on a new machine this compiles for some minutes, and only the first time"


async def warmed(command: Sequence[str] = WARMING) -> None:
    """Wait until a process of its own has compiled what every worker needs; it may fail, they then do it."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C in the terminal is for the server
    )
    try:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), PATIENCE_S)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
