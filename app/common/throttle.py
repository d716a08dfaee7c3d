"""Calls something costly not too often: the newest arguments win, and the last ones are never lost."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Generic, ParamSpec

P = ParamSpec("P")


class Throttle(Generic[P]):
    """Hands calls on at once when it can, and later when the last one was too short ago.

    Args:
        function: What is called, on the event loop.
        pause_s: At least so long from one call to the next.
        share: At most this part of the loop's time is spent in the calls.
    """

    def __init__(self, function: Callable[P, None], *, pause_s: float, share: float = 0.3) -> None:
        self._function = function
        self._pause_s = pause_s
        self._share = share
        self._free_at = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._call: Callable[[], None] | None = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Call now, or with the newest arguments as soon as it is time."""
        self._call = lambda: self._function(*args, **kwargs)
        loop = asyncio.get_running_loop()
        if self._timer is None and loop.time() >= self._free_at:
            self._run()
        elif self._timer is None:
            self._timer = loop.call_at(self._free_at, self._run)

    def cancel(self) -> None:
        """Forget the call that waits."""
        self._call = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _run(self) -> None:
        self._timer = None
        call, self._call = self._call, None
        if call is None:
            return
        loop = asyncio.get_running_loop()
        start = loop.time()
        try:
            call()
        finally:
            end = loop.time()
            self._free_at = max(start + self._pause_s, end + (end - start) * (1 / self._share - 1))
