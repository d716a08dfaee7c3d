"""The time stamp of a message without decoding it, and how it relates to when it was written."""

from __future__ import annotations

import struct

from pipeline.io.readers.container import Channel, Message

#: Stamps farther than this from the time of writing, once the clocks are compared, are damaged.
STAMP_LIMIT_NS = 60_000_000_000
SECOND_NS = 1_000_000_000


def header_stamp(channel: Channel, payload: bytes) -> int | None:
    """The stamp [ns] of a message that begins with a std_msgs/Header, None when there is none."""
    if len(payload) < 12:
        return None
    if channel.encoding == "ros1":
        seconds, nanoseconds = struct.unpack_from("<II", payload, 4)
    else:
        seconds, nanoseconds = struct.unpack_from("<iI" if payload[1] & 1 else ">iI", payload, 4)
    return seconds * SECOND_NS + nanoseconds if seconds >= 0 and nanoseconds < SECOND_NS else None


class Clock:
    """Chooses between the stamps in the messages and the times at which they were written.

    A sensor may stamp with its own clock, which is fine as long as all topics share it. When one
    topic stamps with zeros, or two topics stamp with different clocks, the times of writing are used.

    Args:
        offsets_ns: Stamp minus time of writing of the first message of each topic, None without stamp.
    """

    def __init__(self, offsets_ns: list[int | None]) -> None:
        self.offsets_ns = offsets_ns
        known = [offset for offset in offsets_ns if offset is not None]
        self.by_stamp = (
            bool(known) and len(known) == len(offsets_ns) and max(known) - min(known) <= STAMP_LIMIT_NS // 6
        )
        self.offset_ns = known[0] if self.by_stamp else 0

    def time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """The time of a message [ns], None when its stamp cannot be true."""
        if not self.by_stamp:
            return message.log_ns if message.log_ns < 2**63 else None
        if stamp_ns is None or abs(stamp_ns - message.log_ns - self.offset_ns) > STAMP_LIMIT_NS:
            return None
        return stamp_ns
