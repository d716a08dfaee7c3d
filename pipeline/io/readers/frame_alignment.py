"""The first stretch of a recorded drive: enough of odometry and fixes to lay them over one another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.gnss import LONGEST, Alignment, Fix, align
from pipeline.io.readers.message_time import Stamped
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.types.records import Odometry

#: Small messages, but a recording may be of hours.
MOST_MESSAGES = 60_000
TimesOf = Callable[[Message, dict[str, int]], Iterator[Stamped[Message | Odometry]]]


def align_fixes(
    container: Container,
    decoder: RecordDecoder,
    times_of: TimesOf,
    fixes: frozenset[int],
    odometry: frozenset[int],
    start_ns: int,
) -> tuple[Alignment | None, str]:
    """How GNSS fixes lie in the frame of the map, or None and why that is not known.

    Args:
        container: The recording.
        decoder: Of its messages.
        times_of: Gives a message its time.
        fixes, odometry: Numbers of their channels.
        start_ns: Time of the first scan, where the map begins.
    """
    if not odometry:
        return None, "without odometry nobody tells the direction of north"
    seen: list[Fix] = []
    way: list[tuple[int, Pose3]] = []
    frame = ""
    for message in islice(container.messages(fixes | odometry, None, {}), MOST_MESSAGES):
        for arrival in times_of(message, {}):
            try:
                if message.channel in fixes and isinstance(arrival.content, Message):
                    fix, frame = decoder.fix(arrival.content, arrival.stamp_ns)
                    seen += [] if fix is None else [fix]
                    continue
                told = arrival.content
                record = decoder.record(told, arrival.stamp_ns, {}) if isinstance(told, Message) else told
            except Exception:  # noqa: S112 - as in RecordDecoder.record; it is counted when it is read
                continue
            if isinstance(record, Odometry) and (not way or record.stamp_ns > way[-1][0]):
                way.append((record.stamp_ns, record.T_odom_base))
        if way and message.channel in fixes and np.hypot(*(way[-1][1].t - way[0][1].t)[:2]) > LONGEST:
            break
    if not way:
        return None, "no odometry can be read"
    nearest = min(way, key=lambda entry: abs(entry[0] - start_ns))[1].planar()
    there = np.array([(nearest.inverse() @ pose.planar()).as_array()[:2] for _, pose in way])
    seen.sort(key=lambda fix: fix.stamp_ns)
    return align(seen, [stamp_ns for stamp_ns, _ in way], there, lever_of(decoder, frame))


def lever_of(decoder: RecordDecoder, frame: str) -> float:
    """How far an antenna's frame stands from the base [m], 0 when nobody tells."""
    linked = decoder.place_of(frame)
    return 0.0 if linked is None else float(np.hypot(linked.t[0], linked.t[1]))
