"""Messages of a recording, or of a live run, with their times; moving transforms as odometry."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import islice

import numpy as np

from pipeline.io.readers.base import count_loss
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.message_time import (
    OPENING_MESSAGES,
    Clock,
    Opening,
    Stamped,
    header_frame,
    header_stamp,
)
from pipeline.io.readers.point_times import PointTimes
from pipeline.io.readers.ros_odometry import OdometryChoice
from pipeline.io.readers.scan_frames import MovingLink
from pipeline.io.readers.topics import Topic
from pipeline.io.readers.transforms import MOVING_MESSAGES, Extrinsics, frame_name
from pipeline.types.records import Odometry
from pipeline.types.units import SECOND_NS

#: A message, or what a message of moving transforms contains.
Content = Message | Odometry | MovingLink

_IMPOSSIBLE = "messages with an impossible time stamp"


class TimedMessages:
    """Messages of a recording, or the first ones of a live run, with their times by one clock.

    Args:
        container: The messages.
        extrinsics: Their transforms.
        odometry: Topics and transforms that are read.
        times: How the times of the points of scans are read, None where they are not: a scan is complete
            after its last point.

    Attributes:
        container, odometry: As given.
        clock: Clock of the first messages, for times that are read apart from others; each reading from the
            start uses a clock of its own, `clock.again()`.

    Raises:
        SourceError: The recording cannot be read.
    """

    def __init__(
        self,
        container: Container,
        extrinsics: Extrinsics,
        odometry: OdometryChoice,
        times: Collection[PointTimes | None],
    ) -> None:
        """Compare the clocks of the topics by their first messages."""
        self.container, self._extrinsics, self.odometry = container, extrinsics, odometry
        self._channels = container.by_number
        self._scans = odometry.topics.numbers("scan")
        self._moving, self._world_links = odometry.decoded_transforms, odometry.world_links
        self.clock = Clock(list(self._openings([each.high_ns for each in times if each is not None])))

    def read(
        self,
        numbers: Collection[int],
        losses: dict[str, int],
        clock: Clock | None = None,
        most: int | None = None,
    ) -> Iterator[Stamped[Content]]:
        """Yield the contents of messages with their times, in the order of recording, see `times_of`.

        Args:
            numbers: Numbers of the channels that are read.
            losses: Dict from reasons to numbers of what cannot be used; increased in place.
            clock: Clock of this reading; None for a new one.
            most: Most messages that are read; None for all.

        Raises:
            SourceError: The recording cannot be read.
        """
        clock = self.clock.again() if clock is None else clock
        for message in islice(self.container.messages(numbers, None, losses), most):
            yield from self.times_of(clock, message, losses)

    def times_of(self, clock: Clock, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Content]]:
        """Return an iterator of a message with its time, with the rank 1 for a scan and 0 for others; of a
        message of moving transforms, of each odometry and each link of `OdometryChoice.world` in it. What has
        an impossible time, and transforms that cannot be read, are left out.

        Args:
            clock: Clock of the reading.
            message: The next message in the order of arrival.
            losses: Dict from reasons to numbers of what is left out; increased in place.
        """
        if message.channel in self._moving:
            return self._transforms(clock, message, losses)
        return self._stamped(clock, message, losses)

    def _stamped(self, clock: Clock, message: Message, losses: dict[str, int]) -> Iterator[Stamped[Message]]:
        """Yield a message with its time, see `times_of`."""
        time_ns = clock.time_of(self._stamp_of(message), message, self._raw_frame(message))
        if time_ns is None:
            count_loss(losses, _IMPOSSIBLE)
        else:
            yield Stamped(time_ns, int(message.channel in self._scans), message)

    def messages(self, numbers: Collection[int]) -> Iterator[Stamped[Message]]:
        """Yield the messages of some channels, none of them of transforms, with their times, in the order of
        recording; those with an impossible time are left out. SourceError if the recording cannot be read."""
        clock = self.clock.again()
        for message in self.container.messages(numbers, None, {}):
            yield from self._stamped(clock, message, {})

    def frame_of(self, message: Message) -> str:
        """Return the name of the frame in the header of a message."""
        return frame_name(self._raw_frame(message))

    def is_clock_set(self) -> bool:
        """Return whether no stamp of the last messages (`Container.last`) of scans or of odometry is of the
        clock of its first ones."""
        for role in ("scan", "odometry"):
            last = self.container.last(self.odometry.topics.numbers(role))
            stamps = [(stamp_ns, m) for m in last if (stamp_ns := self._stamp_of(m))]
            if stamps and not any(self.clock.fits(stamp_ns, m) for stamp_ns, m in stamps):
                return True
        return False

    def end_ns(self) -> int | None:
        """Return about the time of the last scan [ns]; None if there is none with a possible time."""
        last = self.container.last(self._scans)
        times = (self.clock.near(self._stamp_of(message), message) for message in last)
        return max((time_ns for time_ns in times if time_ns is not None), default=None)

    def _stamp_of(self, message: Message) -> int | None:
        """Return the stamp in the header of a message [ns], None if it is impossible."""
        return header_stamp(self._channels[message.channel], message.payload)

    def _raw_frame(self, message: Message) -> str:
        """Return the frame in the header of a message as it is written."""
        return header_frame(self._channels[message.channel], message.payload)

    def _transforms(
        self, clock: Clock, message: Message, losses: dict[str, int]
    ) -> Iterator[Stamped[Content]]:
        """Yield odometry and links in a message of moving transforms, see `times_of`; transforms between
        other frames are ignored."""
        odometry = self.odometry
        for stamp_ns, link, pose in self._extrinsics.decode(message, losses, odometry.link):
            is_odometry = link == odometry.link and bool(odometry.transforms)
            if not is_odometry and link not in self._world_links:
                continue
            time_ns = clock.time_of(stamp_ns, message, ">".join(link))
            if time_ns is None:
                count_loss(losses, _IMPOSSIBLE)
            elif is_odometry:
                yield Stamped(time_ns, 0, Odometry(time_ns, pose))
            else:
                yield Stamped(time_ns, 0, MovingLink(time_ns, *link, pose))

    def _openings(self, ends_ns: list[int]) -> Iterator[Opening]:
        """Yield the first messages of each topic that is read, and those of the transforms of the odometry.

        Args:
            ends_ns: Times of the last points of scans after their stamps [ns].
        """
        odometry = self.odometry
        for role in ("scan", "odometry", "imu", "gnss", "pose"):
            topic = odometry.topics.chosen.get(role)
            if topic is not None:
                yield self._opening(topic, ends_ns if role == "scan" else None)
        if odometry.transforms:
            found = [
                (message.log_ns, stamp_ns)
                for message in self.container.first(odometry.transforms, MOVING_MESSAGES)
                for stamp_ns, link, _ in self._extrinsics.decode(message, {})
                if link == odometry.link
            ]
            yield Opening("the transforms of the odometry", odometry.transforms, found)

    def _opening(self, topic: Topic, ends_ns: list[int] | None) -> Opening:
        """Return the first messages of a topic; `ends_ns` as in `_openings`, None for another topic than that
        of the scans. A scan is complete after its last point; where this time is unknown, in the middle
        between its stamp and the next one."""
        first = self.container.first(topic.numbers, OPENING_MESSAGES)
        messages = [(message.log_ns, self._stamp_of(message)) for message in first]
        steps = np.diff([log_ns for log_ns, _ in messages])
        if ends_ns is None:
            complete_ns = 0
        elif ends_ns:
            complete_ns = max(0, *ends_ns)
        else:
            complete_ns = min(int(np.median(steps)) // 2, SECOND_NS) if len(steps) else 0
        return Opening(topic.name, topic.numbers, messages, complete_ns)
