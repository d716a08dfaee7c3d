"""Broadcasts states to the browsers. Of each kind of message only the newest counts: a slow browser skips the
messages in between and does not delay the others."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.columns import first_difference

_encode = msgspec.json.encode

# A little less than a tenth of a second, so that a sensor of 10 Hz never waits for the next round.
MAP_PAUSE_S = 0.09
_ROWS = 4096  # of a path that are encoded at once
_EMPTY_MAP: dict[str, Any] = {"type": "map", "index": -1, "trees": []}


class Broadcast:
    """The newest message of each kind, and the connected browsers."""

    def __init__(self) -> None:
        self._messages: dict[str, tuple[int, bytes]] = {}
        self._map: tuple[int, bytes, NDArray[np.float64]] | None = None
        self._path_json: tuple[int, int, bytes] = (-1, 0, b"")
        self._count = 0
        self._listeners: set[Listener] = set()

    def publish(self, kind: str, content: object) -> None:
        """Replace the message of a kind and wake the listeners; nothing happens if it equals the one before.

        Args:
            kind: Kind of the message; it becomes its field `type`.
            content: A dict or record, whose fields become those of the message; other values, also None,
                become the field `value`. NaN becomes null.
        """
        plain = msgspec.to_builtins(content) if content is not None else None
        # Without content, the page shows the empty state.
        message = {"type": kind, **plain} if isinstance(plain, dict) else {"type": kind, "value": plain}
        encoded = _encode(message)
        if kind in self._messages and self._messages[kind][1] == encoded:
            return
        self._messages[kind] = (self._next(), encoded)
        self._wake()

    def show(self, payload: dict[str, Any], path: NDArray[np.float64]) -> None:
        """Replace the map and wake the listeners, also if it is the same.

        Args:
            payload: Message "map" without its path; not empty.
            path: Positions x, y of the path, and of the odometry if it is known, shape (N, 2) or (N, 4)
                [m]; it must not be modified afterwards.
        """
        self._map = (self._next(), _encode(payload), path)  # once for all listeners
        self._wake()

    def forget_map(self) -> None:
        """Replace the map with an empty one (index -1, no trees, no path), because another run begins;
        nothing if no map was ever shown."""
        if self._map is not None:
            self.show(_EMPTY_MAP, np.zeros((0, 2)))

    @contextmanager
    def listener(self) -> Iterator[Listener]:
        """Register a listener inside the context; its first messages are the newest ones of each kind."""
        listener = Listener(self)
        self._listeners.add(listener)
        try:
            yield listener
        finally:
            self._listeners.discard(listener)

    def messages_after(self, count: int) -> list[tuple[int, bytes]]:
        """Return the messages, as JSON, that are newer than message number `count`, with their numbers,
        ascending."""
        return sorted(m for m in self._messages.values() if m[0] > count)

    def map_after(self, count: int) -> tuple[int, bytes, NDArray[np.float64]] | None:
        """Return number, JSON and path, as in `show`, of the map if its number is larger than `count`,
        else None. The path is not a copy."""
        return self._map if self._map is not None and self._map[0] > count else None

    def path_json(self, count: int, path: NDArray[np.float64], start: int) -> bytes:
        """Return the rows of a path from `start` on as JSON: an object with `start` and `points`, a list of
        rows [m] rounded to 1 mm. The result of the last call is reused if `count` and `start` are the same.

        Args:
            count: Number of the message with the map.
            path: Path of this map, as in `show`.
            start: First row of the result.
        """
        if self._path_json[:2] != (count, start):
            # In parts, because the lists of a long path take ten times its memory.
            parts = (np.round(path[k : k + _ROWS], 3).tolist() for k in range(start, len(path), _ROWS))
            points = b",".join(_encode(part)[1:-1] for part in parts)
            self._path_json = (count, start, b'{"start":%d,"points":[%s]}' % (start, points))
        return self._path_json[2]

    def _next(self) -> int:
        """Return the number of a new message, from 1 on."""
        self._count += 1
        return self._count

    def _wake(self) -> None:
        """Notify all listeners that there are new messages."""
        for listener in self._listeners:
            listener.news.set()


class Listener:
    """The messages that one browser has not received yet.

    Args:
        live: The broadcast.

    Attributes:
        news: Set when there are new messages.
    """

    def __init__(self, live: Broadcast) -> None:
        self.news = asyncio.Event()
        self.news.set()
        self._live = live
        self._seen = 0
        self._map_seen = 0
        self._map_at = -MAP_PAUSE_S
        self._path: NDArray[np.float64] | None = None

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield messages as JSON without end: of each kind the newest, as soon as it changes; maps at
        intervals of at least `MAP_PAUSE_S`, with only the rows of the path that were not sent before."""
        while True:
            await self._wait()
            self.news.clear()
            for count, message in self._live.messages_after(self._seen):
                self._seen = max(self._seen, count)
                yield message
            shown = self._live.map_after(self._map_seen)
            if shown is not None and self._map_wait() <= 0.0:
                yield self._map_message(*shown)

    async def _wait(self) -> None:
        """Wait for news, or until a map that waits may be sent."""
        waiting = self._live.map_after(self._map_seen) is not None
        timeout = max(0.0, self._map_wait()) if waiting else None
        try:
            await asyncio.wait_for(self.news.wait(), timeout)
        except TimeoutError:
            return

    def _map_wait(self) -> float:
        """Return the time until the next map may be sent [s]; negative if it may be sent now."""
        return self._map_at + MAP_PAUSE_S - time.monotonic()

    def _map_message(self, count: int, payload: bytes, path: NDArray[np.float64]) -> bytes:
        """Return a map with the rows of its path that this browser does not have, as JSON, and count it as
        sent now.

        Args:
            count: Number of the message.
            payload: JSON of the map without its path.
            path: The path, as in `show`.
        """
        # The odometry of a scan, which may be NaN, never changes.
        positions = path[:, :2]
        start = first_difference(self._path, positions)
        self._map_seen, self._map_at, self._path = count, time.monotonic(), positions
        return b'%s,"path":%s}' % (payload[:-1], self._live.path_json(count, path, start))
