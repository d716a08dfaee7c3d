"""How often the topics of a robot come, before one of them is chosen: nothing is kept, so nothing is lost."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from app.robot.inbox import Inbox
from app.robot.ros_graph import Publisher
from pipeline.io.readers.container import Channel, Message
from pipeline.io.readers.ros_messages import READ_TYPES


@dataclass(slots=True)
class Heard:
    """Of one topic: how many messages came, and when the first and the last one [ns]."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def rate_hz(self) -> float | None:
        """From the first to the last message; None where that is not known."""
        seconds = 1e-9 * (self.last_ns - self.first_ns)
        return round((self.messages - 1) / seconds, 1) if self.messages > 1 and seconds > 0.0 else None


class CountingInbox(Inbox):
    """Counts what comes by the number of its channel, and keeps none of it."""

    def __init__(self) -> None:
        super().__init__()
        self._guard = threading.Lock()
        self._heard: dict[int, Heard] = {}

    def heard(self, number: int) -> Heard:
        """Of a channel so far."""
        with self._guard:
            known = self._heard.get(number, Heard())
            return Heard(known.messages, known.first_ns, known.last_ns)

    def wants_picture(self, arrival_ns: int, size: int) -> bool:
        """All count."""
        del arrival_ns, size
        return True

    def put_picture(self, message: Message) -> None:
        """Count it."""
        self.put(message, is_scan=False)

    def put(self, message: Message, *, is_scan: bool) -> None:
        """Count it."""
        del is_scan
        with self._guard:
            known = self._heard.setdefault(message.channel, Heard(0, message.log_ns))
            known.messages += 1
            known.last_ns = message.log_ns


def countable(publishers: Sequence[Publisher], most: int) -> list[Channel]:
    """A channel for each topic that something can be made of, by the number of its publisher. The others may
    be of any size, and are not listened to."""
    return [
        Channel(k, each.topic, each.msgtype, "cdr", "", "", 0)
        for k, each in enumerate(publishers[:most])
        if each.msgtype in READ_TYPES
    ]
