"""Messages that came from the network and were not mapped yet: bounded, and what falls out is counted."""

from __future__ import annotations

import threading
from collections import deque

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Message

#: Two seconds of a usual LiDAR: what is older no picture needs any more.
MOST_SCANS = 20
MOST_BYTES = 128 << 20
#: Odometry and IMU are small, and wanted whole.
MOST_OTHERS = 20_000

#: A scan is shown with the picture of its time: one every 0.15 s is near enough, and more fill the disk.
PICTURE_PAUSE_NS = 150_000_000
MOST_PICTURES, MOST_PICTURE_BYTES, LARGEST_PICTURE = 10, 64 << 20, 32 << 20

DROPPED = "scans dropped because mapping was behind"
OTHERS_DROPPED = "other messages dropped because mapping was behind"
PICTURES_DROPPED = "pictures dropped because mapping was behind"
PICTURES_TOO_LARGE = f"pictures larger than {LARGEST_PICTURE >> 20} MB"

_Lane = deque[tuple[int, Message]]


class Inbox:
    """Filled by the threads of a network library, emptied by the loop that maps.

    When there is no room the oldest scans go first: a live map wants the newest. The publisher is never
    held up, for it may be the robot's own driver. Pictures have a room of their own.

    Attributes:
        losses: What fell out, by reason.
        pictures_come, pictures_taken: How many came, and how many of them were wanted.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._scans: _Lane = deque()
        self._others: _Lane = deque()
        self._pictures: _Lane = deque()
        self._bytes = self._picture_bytes = 0
        self._serial = 0
        self._picture_ns: int | None = None
        self.losses: dict[str, int] = {}
        self.pictures_come = self.pictures_taken = 0

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
                self._bytes -= self._drop(self._scans, DROPPED)
            while len(self._others) > MOST_OTHERS or (self._bytes > MOST_BYTES and self._others):
                self._bytes -= self._drop(self._others, OTHERS_DROPPED)

    def wants_picture(self, arrival_ns: int, size: int) -> bool:
        """Count a picture that came; whether it is to be put, which is asked before its bytes are copied."""
        with self._lock:
            self.pictures_come += 1
            if size > LARGEST_PICTURE:
                count_loss(self.losses, PICTURES_TOO_LARGE)
                return False
            if self._picture_ns is not None and arrival_ns < self._picture_ns + PICTURE_PAUSE_NS:
                return False
            self._picture_ns = arrival_ns
            self.pictures_taken += 1
            return True

    def put_picture(self, message: Message) -> None:
        """Add a picture that is wanted; older ones fall out where there is no room."""
        with self._lock:
            self._serial += 1
            self._pictures.append((self._serial, message))
            self._picture_bytes += len(message.payload)
            while len(self._pictures) > MOST_PICTURES or self._picture_bytes > MOST_PICTURE_BYTES:
                self._picture_bytes -= self._drop(self._pictures, PICTURES_DROPPED)

    def take(self) -> Message | None:
        """The message that came first of those that are there, None when there is none."""
        with self._lock:
            lanes = [lane for lane in (self._scans, self._others, self._pictures) if lane]
            if not lanes:
                return None
            first = min(lanes, key=lambda lane: lane[0][0])
            _, message = first.popleft()
            if first is self._pictures:
                self._picture_bytes -= len(message.payload)
            else:
                self._bytes -= len(message.payload)
            return message

    def clear(self) -> None:
        """Forget all that waits, uncounted: nobody has begun to map."""
        with self._lock:
            for lane in (self._scans, self._others, self._pictures):
                lane.clear()
            self._bytes = self._picture_bytes = 0

    def _drop(self, lane: _Lane, reason: str) -> int:
        """Let the oldest of a lane go; its size."""
        _, dropped = lane.popleft()
        count_loss(self.losses, reason)
        return len(dropped.payload)
