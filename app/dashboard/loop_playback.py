"""A part of the run that is played again and again."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from app.dashboard.broadcast import Live
from app.worker.internal_protocol import ToWorker
from app.worker.protocol import Play, Seek, Status

Span = tuple[float, float]


class Loop:
    """From where to where, and when to turn.

    Args:
        live: Where the browsers are told.
        send: Sends a command to the worker.

    Attributes:
        span: First and last time [s since the first scan], None for no loop.
    """

    def __init__(self, live: Live, send: Callable[[ToWorker], Awaitable[None]]) -> None:
        self.span: Span | None = None
        self._live, self._send = live, send
        self._turning = False

    def choose(self, span: Span | None) -> None:
        """Play this part; None plays on at its end."""
        self.span, self._turning = span, False
        self._live.tell("loop", None if span is None else {"from_s": span[0], "to_s": span[1]})

    async def shown(self, time_s: float, status: Status) -> None:
        """At the end of the part go to its beginning, while the run plays."""
        if self.span is None:
            return
        if time_s < self.span[1]:
            self._turning = False
        elif not self._turning and status.state in ("playing", "finished"):
            self._turning = True  # pictures that are under way must not turn it once more
            await self._send(Seek(self.span[0]))
            if status.state == "finished":
                await self._send(Play())
