"""Base of the connections to a robot: a thread that connects and tries again, and the inbox that it fills.

Messages are recorded when they arrive, then queued in bounded memory for the mapping.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from app.robot.recorder import Recorder
from app.robot.topics import MAX_ENDPOINTS, PICTURE_TYPES, SCAN_TYPES, Publisher
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Channel, Message

#: Two seconds of a usual LiDAR: an older scan shows nothing of the present.
MAX_SCANS = 20
MAX_BYTES = 128 << 20
#: Odometry and IMU messages are small, and all of them are needed.
MAX_OTHERS = 20_000
#: Fixed transforms are sent once and must outlast a long wait, e.g. for the compiler.
MAX_FIXED = 1000
#: They are kept for a recording that begins later, up to this size.
MAX_FIXED_BYTES = 8 << 20

#: A picture every 0.15 s is close enough to every scan; more of them fill the disk.
PICTURE_PAUSE_NS = 150_000_000
MAX_PICTURES, MAX_PICTURE_BYTES, LARGEST_PICTURE = 10, 64 << 20, 32 << 20

SKIPPED = "scans skipped because mapping was behind"
OTHERS_SKIPPED = "other messages skipped because mapping was behind"
PICTURES_SKIPPED = "pictures skipped because mapping was behind"
PICTURES_TOO_LARGE = f"pictures larger than {LARGEST_PICTURE >> 20} MB"

_Lane = deque[tuple[int, Message]]


class ArrivalTimes:
    """Times of arrival that always increase, even if the system clock is set back."""

    def __init__(self) -> None:
        self._wall_ns, self._start_ns = time.time_ns(), time.monotonic_ns()
        self._last_ns = 0

    def now_ns(self) -> int:
        """Return the present time [ns since 1970]; never less than an earlier result of this method."""
        return self._wall_ns + time.monotonic_ns() - self._start_ns

    def next_ns(self) -> int:
        """Return the present time [ns since 1970], greater than every earlier result of this method."""
        self._last_ns = max(self.now_ns(), self._last_ns + 1)
        return self._last_ns


class Inbox:
    """Queue between the threads of a network library, which fill it, and the mapping loop, which empties it.

    Each message goes to the recorder first. When the queue is full, the oldest scans are skipped, because a
    live map needs the newest; the recorder stores which were skipped. The publisher is never delayed, since
    it may be the robot's own driver. Pictures have a queue of their own.

    Attributes:
        losses: Dict from reasons to numbers of skipped messages.
        early_scans: Number of scans that were skipped before the first call of `take`.
        pictures_arrived, pictures_accepted: Number of pictures that arrived, and that the rate limit
            accepted.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._recorder: Recorder | None = None
        self._scans: _Lane = deque()
        self._others: _Lane = deque()
        self._fixed: _Lane = deque()
        self._fixed_channels: frozenset[int] = frozenset()
        self._arrived_fixed: list[Message] = []
        self._arrived_fixed_bytes = 0
        self._pictures: _Lane = deque()
        self._bytes = self._picture_bytes = 0
        self._serial = 0
        self._picture_ns: int | None = None
        self._mapping = False
        self.losses: dict[str, int] = {}
        self.early_scans = 0
        self.pictures_arrived = self.pictures_accepted = 0

    @property
    def scans_waiting(self) -> int:
        """Number of queued scans."""
        return len(self._scans)

    def begin(self, recorder: Recorder | None, fixed: Iterable[int]) -> None:
        """Set the recorder and the channels of fixed transforms, for all messages from now on.

        Args:
            recorder: None records nothing.
            fixed: Numbers of the channels of fixed transforms. Up to MAX_FIXED of their messages have a queue
                of their own and are never skipped.
        """
        self._recorder, self._fixed_channels = recorder, frozenset(fixed)

    def record(self, recorder: Recorder, now_ns: int) -> None:
        """Set the recorder of a recording that begins while messages arrive. It first gets the fixed
        transforms that arrived so far, as a late subscriber does, then the queued messages, so that the file
        begins with the next scan that is mapped.

        Args:
            recorder: The recorder, which has a beginning.
            now_ns: Present time of arrival [ns].
        """
        with self._lock:
            lanes = (self._scans, self._others, self._pictures)
            queued = [message for _, message in sorted(pair for lane in lanes for pair in lane)]
            start_ns = min([now_ns, *(message.log_ns for message in queued)])
            for message in self._arrived_fixed:
                recorder.add(replace(message, log_ns=start_ns))
            for message in queued:
                recorder.add(message)
            self._recorder = recorder

    def put(self, message: Message, *, is_scan: bool) -> None:
        """Record and queue a message; never wait. The oldest scans are skipped beyond MAX_SCANS, the oldest
        other messages beyond MAX_OTHERS. Beyond MAX_BYTES in all, the oldest scans are skipped first, then
        the oldest other messages. Fixed transforms are not skipped, see `begin`.

        Args:
            message: The message.
            is_scan: Whether the message is a scan.
        """
        with self._lock:
            if self._recorder is not None:
                self._recorder.add(message)
            self._serial += 1
            is_fixed = message.channel in self._fixed_channels
            if is_fixed:
                self._keep_fixed(message)
            is_fixed = is_fixed and len(self._fixed) < MAX_FIXED
            lane = self._scans if is_scan else self._fixed if is_fixed else self._others
            lane.append((self._serial, message))
            self._bytes += len(message.payload)
            while len(self._scans) > MAX_SCANS or (self._bytes > MAX_BYTES and self._scans):
                self._bytes -= self._skip(self._scans, SKIPPED)
            while len(self._others) > MAX_OTHERS or (self._bytes > MAX_BYTES and self._others):
                self._bytes -= self._skip(self._others, OTHERS_SKIPPED)

    def wants_picture(self, arrival_ns: int, size: int) -> bool:
        """Count a picture; return whether the rate limit accepts it. Called before its bytes are copied. A
        picture larger than LARGEST_PICTURE is counted in `losses` and refused.

        Args:
            arrival_ns: Time of arrival [ns].
            size: Number of bytes.
        """
        with self._lock:
            self.pictures_arrived += 1
            if size > LARGEST_PICTURE:
                count_loss(self.losses, PICTURES_TOO_LARGE)
                return False
            if self._picture_ns is not None and arrival_ns < self._picture_ns + PICTURE_PAUSE_NS:
                return False
            self._picture_ns = arrival_ns
            self.pictures_accepted += 1
            return True

    def put_picture(self, message: Message) -> None:
        """Record and queue an accepted picture. Beyond MAX_PICTURES or MAX_PICTURE_BYTES, the oldest pictures
        are removed and counted in `losses`, but not recorded as skipped."""
        with self._lock:
            if self._recorder is not None:
                self._recorder.add(message)
            self._serial += 1
            self._pictures.append((self._serial, message))
            self._picture_bytes += len(message.payload)
            while len(self._pictures) > MAX_PICTURES or self._picture_bytes > MAX_PICTURE_BYTES:
                _, oldest = self._pictures.popleft()
                self._picture_bytes -= len(oldest.payload)
                count_loss(self.losses, PICTURES_SKIPPED)

    def take(self) -> Message | None:
        """Remove and return the message that arrived first, pictures included; None when the queue is empty.
        After the first call, scans do not count as early any more."""
        with self._lock:
            self._mapping = True
            lanes = [lane for lane in (self._scans, self._others, self._fixed, self._pictures) if lane]
            if not lanes:
                return None
            first = min(lanes, key=lambda lane: lane[0][0])
            _, message = first.popleft()
            if first is self._pictures:
                self._picture_bytes -= len(message.payload)
            else:
                self._bytes -= len(message.payload)
            return message

    def end(self) -> None:
        """Stop recording. Messages that are still queued are recorded as skipped, except pictures; they stay
        in the queue."""
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is not None:
                for lane in (self._scans, self._others, self._fixed):
                    for _, message in lane:
                        recorder.skip(message)

    def _keep_fixed(self, message: Message) -> None:
        """Keep a fixed transform for `record`; nothing beyond MAX_FIXED and MAX_FIXED_BYTES."""
        size = self._arrived_fixed_bytes + len(message.payload)
        if len(self._arrived_fixed) < MAX_FIXED and size <= MAX_FIXED_BYTES:
            self._arrived_fixed.append(message)
            self._arrived_fixed_bytes = size

    def _skip(self, lane: _Lane, reason: str) -> int:
        """Remove the oldest message of a queue, record that it was skipped, and return its size [bytes].

        It is counted in `losses` under the reason. Before the first call of `take`, scans are counted in
        `early_scans` instead, and other messages are not counted.
        """
        _, skipped = lane.popleft()
        if self._recorder is not None:
            self._recorder.skip(skipped)
        if self._mapping:
            count_loss(self.losses, reason)
        else:
            self.early_scans += lane is self._scans
        return len(skipped.payload)


@dataclass(slots=True)
class Heard:
    """Number of messages of a topic, and times of the first and the last one [ns]."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate_hz(self) -> float | None:
        """Mean rate from the first to the last message [Hz], one decimal; None with fewer than two messages
        or without time between them."""
        seconds = 1e-9 * (self.last_ns - self.first_ns)
        return round((self.messages - 1) / seconds, 1) if self.messages > 1 and seconds > 0.0 else None


class CountingInbox(Inbox):
    """Counts messages by channel and keeps none of them."""

    def __init__(self) -> None:
        super().__init__()
        self._guard = threading.Lock()
        self._heard: dict[int, Heard] = {}

    def heard(self, number: int) -> Heard:
        """Return a copy of the count of the channel with this number; 0 messages for an unknown channel."""
        with self._guard:
            known = self._heard.get(number, Heard())
            return Heard(known.messages, known.first_ns, known.last_ns)

    def wants_picture(self, arrival_ns: int, size: int) -> bool:
        """Return True; the arguments are not used."""
        del arrival_ns, size
        return True

    def put_picture(self, message: Message) -> None:
        """Count the message, as `put`."""
        self.put(message, is_scan=False)

    def put(self, message: Message, *, is_scan: bool) -> None:
        """Count the message.

        Args:
            message: The message.
            is_scan: Not used.
        """
        del is_scan
        with self._guard:
            known = self._heard.setdefault(message.channel, Heard(0, message.log_ns))
            known.messages += 1
            known.last_ns = message.log_ns


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
        inbox: Inbox to which the messages are added.
        name: Name of the thread.

    Attributes:
        problem: Reason why there is no connection, "" while there is one.
        alive: Dict from the identifier of each present writer to the topic that it publishes; guarded by
            `lock`.
        losses: Dict from reasons to numbers of messages lost before the inbox.
        scans: Number of scans that arrived.
        version: Number of changes of `alive` so far.
        session: Session on which results can be published, None if there is none.
    """

    session: Any = None

    def __init__(self, inbox: Inbox, name: str) -> None:
        self.problem = "not connected yet"
        self.losses: dict[str, int] = {}
        self.alive: dict[str, Publisher] = {}
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
    def subscribe(self, channels: Sequence[Channel]) -> None:
        """Receive the messages of these channels from now on, also after each new connection. It is called
        once."""

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

    def announce(self, key: str, publisher: Publisher | None) -> None:
        """Add or update a writer that was announced. Beyond MAX_ENDPOINTS writers it is counted in `losses`
        and ignored.

        Args:
            key: Identifier of the writer.
            publisher: What it publishes; None, for another entity than a writer of ROS, is ignored.
        """
        with self.lock:
            if publisher is None or self.alive.get(key) == publisher:
                return
            if key not in self.alive and len(self.alive) >= MAX_ENDPOINTS:
                count_loss(self.losses, TOO_MANY)
                return
            self.alive[key] = publisher
            self.version += 1

    def withdraw(self, key: str) -> None:
        """Remove a writer that ended; nothing happens for an unknown one."""
        with self.lock:
            self.version += self.alive.pop(key, None) is not None

    def publishers(self) -> list[Publisher]:
        """Return all topics that are published now, each once, sorted by robot, topic and type."""
        with self.lock:
            found = {(each.robot, each.topic, each.msgtype) for each in self.alive.values()}
        return [Publisher(*each) for each in sorted(found)]

    def robots(self) -> list[str]:
        """Return the namespaces from which scans are published now, sorted; "" for topics without one."""
        return sorted({p.robot for p in self.publishers() if p.msgtype in SCAN_TYPES})

    def close(self) -> None:
        """End the thread, which disconnects; waits at most 5 s for it."""
        self.closing.set()
        self.thread.join(timeout=_CLOSE_S)

    def take(self, channel: Channel, payload: Any, size: int) -> None:  # noqa: ANN401 - bytes of a library
        """Put a message into the inbox with its time of arrival; a full inbox skips its oldest scan, and
        pictures are copied only if it accepts them. A message larger than MESSAGE_LIMIT is dropped and
        counted in `losses`. Scans, also dropped ones, are counted in `scans`.

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
        """Call `receive` until `close`, again after 1 s if it raises. Runs in `thread`."""
        while not self.closing.is_set():
            try:
                self.receive()
            except Exception as error:  # a thread that ends silently would look like waiting
                self.problem = self.failure(error)
                self.closing.wait(_RETRY_S)


def first_line(error: Exception) -> str:
    """Return the first line of the text of an exception, without positions in source code, at most 200
    characters; the name of its class without a text."""
    first = str(error).partition("\n")[0].partition(" at ")[0].rstrip("!; ")
    return first[:200] or type(error).__name__
