"""The time stamps of a robot that is heard live, whose clock may be set while it drives."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.io.readers.container import Message
from pipeline.io.readers.message_time import SECOND_NS, STAMP_LIMIT_NS, Clock

#: A stamp that leaves its place by more than this was made by a clock that was set meanwhile.
STEP_NS = 2 * SECOND_NS
#: Two topics saw the same step when they disagree by less about its size.
SAME_STEP_NS = SECOND_NS


@dataclass(slots=True)
class _Topic:
    """What is known of one channel's stamps: the largest stamp minus arrival since the last step, the
    newest stamp, what is added to the stamps, and how many steps are in it."""

    offset_ns: int
    newest_ns: int
    shift_ns: int
    steps: int


class SteppingClock(Clock):
    """As Clock, but times go on evenly where the robot's clock was set (NTP, GNSS, a reboot into 1970).

    Messages that come late lower stamp minus arrival and are nothing odd; so a step forward is a stamp
    further ahead of its arrival than any before, and a step back is one that is earlier than the
    newest. The first topic that shows a step measures it, the others take over its size.

    Args:
        offsets_ns: As of Clock.

    Attributes:
        notices: What happened, in words; whoever tells people of them empties the list.
    """

    def __init__(self, offsets_ns: list[int | None]) -> None:
        super().__init__(offsets_ns)
        self.notices: list[str] = []
        self._topics: dict[int, _Topic] = {}
        self._steps: list[int] = []

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """The time of a message [ns], None when its stamp cannot be true."""
        if not self.by_stamp:
            return message.log_ns
        topic = self._topics.get(message.channel)
        if not stamp_ns:  # zeros where there were stamps before: the time of arrival stands for it
            return None if topic is None else message.log_ns + topic.offset_ns + topic.shift_ns
        offset_ns = stamp_ns - message.log_ns
        if topic is None:
            topic = self._first_of(offset_ns, stamp_ns)
            if topic is None:
                return None
            self._topics[message.channel] = topic
        elif offset_ns > topic.offset_ns + STEP_NS or stamp_ns < topic.newest_ns - STEP_NS:
            self._step(topic, offset_ns)
            topic.offset_ns = offset_ns
            topic.newest_ns = stamp_ns
        topic.offset_ns = max(topic.offset_ns, offset_ns)
        topic.newest_ns = max(topic.newest_ns, stamp_ns)
        return stamp_ns + topic.shift_ns

    def _first_of(self, offset_ns: int, stamp_ns: int) -> _Topic | None:
        """A topic that was not heard before shares the shift of those whose clock it has."""
        if not self._topics:
            return _Topic(offset_ns, stamp_ns, 0, 0)
        nearest = min(self._topics.values(), key=lambda known: abs(known.offset_ns - offset_ns))
        if abs(nearest.offset_ns - offset_ns) > STAMP_LIMIT_NS:
            return None
        return _Topic(offset_ns, stamp_ns, nearest.shift_ns, nearest.steps)

    def _step(self, topic: _Topic, offset_ns: int) -> None:
        size_ns = offset_ns - topic.offset_ns
        if topic.steps < len(self._steps) and abs(self._steps[topic.steps] - size_ns) < SAME_STEP_NS:
            size_ns = self._steps[topic.steps]
        else:
            self._steps.append(size_ns)
            topic.steps = len(self._steps) - 1
            seconds = f"{size_ns / SECOND_NS:+,.1f} s"
            self.notices.append(f"the robot's clock was set by {seconds}: the run's time goes on evenly")
        topic.steps += 1
        topic.shift_ns -= size_ns
