"""Base of the connections to a robot: a thread that connects, tries again and fills the inbox."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from app.robot.inbox import ArrivalTimes, Inbox
from app.robot.topics import MAX_ENDPOINTS, PICTURE_TYPES, SCAN_TYPES, Publisher
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message

#: Largest message that is assembled; a cloud of 2 million points is smaller.
MESSAGE_LIMIT = 64 << 20
TOO_LARGE = "messages larger than 64 MB"
LOST_SCANS = "scans lost on the network"
TOO_MANY = f"topics beyond the first {MAX_ENDPOINTS:,}"
_RETRY_S = 1.0
_CLOSE_S = 5.0


class Link(ABC):
    """A connection to a robot, in a thread that connects again after an error until `close`.

    A subclass starts `thread` at the end of its constructor.

    Args:
        inbox: Receives the messages.
        name: Name of the thread.

    Attributes:
        problem: Reason why there is no connection, "" while there is one.
        losses: Number of messages lost before the inbox, by reason.
        scans: Number of scans that arrived.
        version: Number of changes among the publishers so far.
        session: Session on which results can be published, None if there is none.
    """

    session: Any = None

    def __init__(self, inbox: Inbox, name: str) -> None:
        self.problem = "not connected yet"
        self.losses: dict[str, int] = {}
        self.scans = self.version = 0
        self.inbox, self.times = inbox, ArrivalTimes()
        self.lock, self.closing = threading.Lock(), threading.Event()
        self.heard_s: float | None = None
        self.thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    @abstractmethod
    def place(self) -> str:
        """Description of the connection for the user."""

    @property
    @abstractmethod
    def nothing(self) -> str:
        """Reason why no scan topic is chosen, as text for the user."""

    @abstractmethod
    def publishers(self) -> list[Publisher]:
        """Return all topics that are published now, each once."""

    @abstractmethod
    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Receive the messages of these channels from now on."""

    @abstractmethod
    def receive(self) -> None:
        """Connect and receive messages until `close`. After an exception, `problem` has its text and the
        method is called again."""

    @abstractmethod
    def failure(self, error: Exception) -> str:
        """Return the text of `problem` for an exception."""

    @property
    def silence_s(self) -> float | None:
        """Seconds since the last scan arrived, None before the first."""
        return None if self.heard_s is None else time.monotonic() - self.heard_s

    def robots(self) -> list[str]:
        """The namespaces from which scans are published, sorted."""
        return sorted({p.robot for p in self.publishers() if p.msgtype in SCAN_TYPES})

    def close(self) -> None:
        """Disconnect."""
        self.closing.set()
        self.thread.join(timeout=_CLOSE_S)

    def take(self, channel: Channel, payload: Any, size: int) -> None:  # noqa: ANN401 - bytes of a library
        """Count a message and put it into the inbox; bytes are copied only if the inbox accepts them.

        Args:
            channel: Channel of the message.
            payload: Bytes, or an object of a library that holds them.
            size: Number of bytes.
        """
        is_scan = channel.msgtype in SCAN_TYPES
        with self.lock:
            if is_scan:
                self.heard_s = time.monotonic()
                self.scans += 1
            if size > MESSAGE_LIMIT:
                count_loss(self.losses, TOO_LARGE)
                return
            arrival_ns = self.times.next_ns()
            if channel.msgtype not in PICTURE_TYPES:
                self.inbox.put(Message(channel.number, arrival_ns, bytes(payload)), is_scan=is_scan)
            elif self.inbox.wants_picture(arrival_ns, size):
                self.inbox.put_picture(Message(channel.number, arrival_ns, bytes(payload)))

    def _run(self) -> None:
        while not self.closing.is_set():
            try:
                self.receive()
            except Exception as error:  # a thread that ends silently would look like waiting
                self.problem = self.failure(error)
                self.closing.wait(_RETRY_S)


def first_line(error: Exception) -> str:
    """Return the first line of the text of an exception, without positions in source code."""
    first = str(error).partition("\n")[0].partition(" at ")[0].rstrip("!; ")
    return first[:200] or type(error).__name__
