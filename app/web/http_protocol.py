"""HTTP connections whose request must arrive in time."""

from __future__ import annotations

import asyncio

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

#: Longest time from the connection, or from the end of the response before, to the end of the header [s].
HEADER_S = 10.0
#: Most connections of one address that have not sent a request yet. Browsers open some in advance.
MOST_WAITING = 64


class HttpProtocol(H11Protocol):
    """Connection that is closed when the header of a request takes longer than HEADER_S, or when its address
    has MOST_WAITING connections without a request."""

    _header_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit, or abort the connection if its address has MOST_WAITING others without a
        request."""
        super().connection_made(transport)
        waiting = (c for c in self.connections if isinstance(c, HttpProtocol) and c._header_timer is not None)
        host = self.client[0] if self.client else ""
        if sum(other.client[0] == host for other in waiting if other.client) >= MOST_WAITING:
            transport.abort()
        else:
            self._limit_header()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the time limit."""
        self._unlimit_header()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Handle what has arrived; the time limit runs while the next request is not complete."""
        super().handle_events()
        if self.conn.their_state is not h11.IDLE or self.transport.is_closing():
            self._unlimit_header()
        elif self._header_timer is None:
            self._limit_header()

    def _limit_header(self) -> None:
        """Close the connection after HEADER_S, unless `_unlimit_header` is called before."""
        self._header_timer = self.loop.call_later(HEADER_S, self.transport.close)

    def _unlimit_header(self) -> None:
        """End the time limit, if it runs."""
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None
