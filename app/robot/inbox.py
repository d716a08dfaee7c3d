"""Messages that came from the network and were not mapped yet: bounded, and what falls out is counted."""

from __future__ import annotations

import threading
from collections import deque

from pipeline.sources.container import Message, count_loss

#: Two seconds of a usual LiDAR: what is older no picture needs any more.
MOST_SCANS = 20
MOST_BYTES = 128 << 20
#: Odometry and IMU are small, and wanted whole.
MOST_OTHERS = 20_000

DROPPED = "scans dropped because mapping was behind"
OTHERS_DROPPED = "other messages dropped because mapping was behind"


class Inbox:
    """Filled by the threads of a network library, emptied by the loop that maps.

    When there is no room the oldest scans go first: a live map wants the newest. The publisher is never
    held up, for it may be the robot's own driver.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._scans: deque[tuple[int, Message]] = deque()
        self._others: deque[tuple[int, Message]] = deque()
        self._bytes = 0
        self._serial = 0
        self.losses: dict[str, int] = {}

    @property
    def scans_waiting(self) -> int:
        """How many scans came and were not taken yet."""
        return len(self._scans)

    def put(self, message: Message, *, is_scan: bool) -> None:
        """Add a message; others fall out where there is no room."""
        with self._lock:
            self._serial += 1
            (self._scans if is_scan else self._others).append((self._serial, message))
            self._bytes += len(message.payload)
            while len(self._scans) > MOST_SCANS or (self._bytes > MOST_BYTES and self._scans):
                self._drop(self._scans, DROPPED)
            while len(self._others) > MOST_OTHERS or (self._bytes > MOST_BYTES and self._others):
                self._drop(self._others, OTHERS_DROPPED)

    def take(self) -> Message | None:
        """The message that came first of those that are there, None when there is none."""
        with self._lock:
            if not self._scans and not self._others:
                return None
            scans_first = bool(self._scans) and (not self._others or self._scans[0][0] < self._others[0][0])
            _, message = (self._scans if scans_first else self._others).popleft()
            self._bytes -= len(message.payload)
            return message

    def clear(self) -> None:
        """Forget all that waits, uncounted: nobody has begun to map."""
        with self._lock:
            self._scans.clear()
            self._others.clear()
            self._bytes = 0

    def _drop(self, messages: deque[tuple[int, Message]], reason: str) -> None:
        _, message = messages.popleft()
        self._bytes -= len(message.payload)
        count_loss(self.losses, reason)
