"""The camera of a live run: pictures of the last seconds, in bounded memory, and how it stands.

Nothing of it goes into the map, so that a replay gives the same map with pictures or without.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from pipeline.io.readers.camera import SAME_TIME_NS, Camera, Picture, find_camera, picture_of
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.extrinsics import Mounting
from pipeline.io.readers.live_reader import Heard
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.pictures import time_beside
from pipeline.io.readers.rostypes import CAMERA_INFO, MessageDecoder
from pipeline.io.readers.topics import Topic

#: So many pictures are held, and no more bytes of them: a paused run can still show its scan.
MOST_PICTURES, MOST_BYTES = 60, 64 << 20
_MOST_FIXED, _LARGEST_TOLD = 200, 64 << 10


class LiveCamera:
    """Takes the messages of a camera one by one, see `app.robot.source`.

    Args:
        channels: Of the pictures first, then of their CameraInfo, if there is one.
        fixed: Of fixed transforms.
    """

    def __init__(self, channels: Sequence[Channel], fixed: Sequence[Channel]) -> None:
        self._pictures_of, self._infos = channels[0], [c for c in channels if c.msgtype == CAMERA_INFO]
        self._channels = {channel.number: channel for channel in (*channels, *fixed)}
        self._numbers = {channel.number for channel in channels}
        self._decoder = MessageDecoder(self._channels.values())
        self._held: deque[tuple[int | None, Message]] = deque()
        self._bytes = 0
        self._fixed: list[Message] = []
        self._info: Message | None = None
        self._found: tuple[str, Camera | None, str] | None = None

    def add(self, message: Message) -> bool:
        """Take a message, whatever it is of; whether it is of the camera alone."""
        number = message.channel
        if number not in self._numbers:
            if number in self._channels and len(self._fixed) < _MOST_FIXED:
                self._keep_fixed(message)
            return False
        if number == self._pictures_of.number:
            self._held.append((header_stamp(self._pictures_of, message.payload), message))
            self._bytes += len(message.payload)
            while len(self._held) > MOST_PICTURES or self._bytes > MOST_BYTES:
                self._bytes -= len(self._held.popleft()[1].payload)
        elif len(message.payload) <= _LARGEST_TOLD and (self._info is None or self._is_other(message)):
            self._info, self._found = message, None
        return True

    def camera(self, base: str) -> tuple[Camera | None, str]:
        """How it stands on the robot; None and why where nobody tells.

        Args:
            base: The name of the base frame.
        """
        if self._found is None or self._found[0] != base:
            told = [*self._fixed, *([] if self._info is None else [self._info])]
            heard = Heard("", list(self._channels.values()), told)
            self._found = (base, *placed(heard, self._decoder, self._pictures_of.number, base))
        return self._found[1:]

    def near(self, stamp_ns: int, offset_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The held picture that was taken nearest to a time, None where that is farther from it.

        Args:
            stamp_ns: The time.
            offset_ns: Stamp minus arrival of the run's first scan.
            within_ns: So far from it at most.
        """
        times = [(time_beside(stamp, m.log_ns, offset_ns), k) for k, (stamp, m) in enumerate(self._held)]
        taken_ns, k = min(times, key=lambda each: abs(each[0] - stamp_ns), default=(0, -1))
        if k < 0 or abs(taken_ns - stamp_ns) > within_ns:
            return None
        return picture_of(self._held[k][1], self._channels, self._decoder, taken_ns)

    def _is_other(self, info: Message) -> bool:
        """Whether it tells another thing than the one that is known, but for its time."""
        head = 12  # of CDR: what the bytes mean, and the stamp
        return self._info is None or info.payload[head:] != self._info.payload[head:]

    def _keep_fixed(self, message: Message) -> None:
        known = {each.payload for each in self._fixed}
        if len(message.payload) <= _LARGEST_TOLD and message.payload not in known:
            self._fixed.append(message)
            self._found = None


def placed(
    container: Container, decoder: MessageDecoder, pictures: int, base: str
) -> tuple[Camera | None, str]:
    """How the camera of a channel stands, from the fixed transforms and CameraInfo beside it; None and why.

    Args:
        pictures: The channel's number.
    """
    mounting = Mounting(container, decoder)
    fixed = [c for c in container.channels if c.topic.endswith("tf_static")]
    mounting.read([Topic(c.topic, c.msgtype, frozenset((c.number,)), c.count) for c in fixed], ())
    return find_camera(container, decoder, mounting.tree, base, frozenset((pictures,)))
