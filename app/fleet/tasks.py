"""The end of a task: whatever became of it, the others are ended too."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

_log = logging.getLogger(__name__)


async def end(task: asyncio.Task[Any] | None) -> None:
    """Cancel it and wait; a fault that it ended with is written down and not raised again."""
    if task is None:
        return
    task.cancel()
    try:
        await task
    except asyncio.CancelledError:
        pass
    except Exception:
        _log.exception("%s had ended with a fault", task.get_name())
