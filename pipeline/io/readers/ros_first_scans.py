"""First scans of a recording: how the times of their points are read, and the first scan with points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SourceError
from pipeline.io.readers.container import Container
from pipeline.io.readers.firing_order import FIRING_ORDER
from pipeline.io.readers.point_times import PointTimes, TimedScan, decide_point_times
from pipeline.io.readers.ros_messages import TimedMessages
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.sensor_families import CUSTOM_TYPES
from pipeline.io.readers.topics import POINT_CLOUD, Topic
from pipeline.types.records import Scan, Sensor
from pipeline.types.units import SECOND_NS

#: Types of messages whose points may have times in a field or by their order.
TIMED_TYPES = (POINT_CLOUD, *CUSTOM_TYPES)
#: Number of scans by which the times of points are decided.
_TIMED_SCANS = 10
#: Most scans among which one of a LiDAR with a known frame is looked for.
_MOST_SCANS = 400
_NO_FIELD = "there is no field with times"


class EmptyScansError(SourceError):
    """The last scan that could be read has no points: of a live run, later ones may have some."""


@dataclass(frozen=True, slots=True)
class TopicTimes:
    """How the times of the points of a topic are read.

    Attributes:
        times: Dict from frames to how their times are read, None where they are not.
        reasons: Dict from frames to the reasons why times that there are cannot be used.
    """

    times: Mapping[str, PointTimes | None]
    reasons: Mapping[str, str]

    @property
    def words(self) -> str:
        """How the times are read, or why they are not, as text; each frame by itself if they differ."""
        words = {
            frame: f"not used: {self.reasons.get(frame, _NO_FIELD)}" if found is None else found.words
            for frame, found in self.times.items()
        }
        if len(set(words.values())) > 1:
            return "; ".join(f"{frame}: {text}" for frame, text in words.items())
        return next(iter(words.values()), f"not used: {_NO_FIELD}")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Messages for the user about times that cannot be used, and about a clock that is assumed."""
        found = []
        for frame, times in self.times.items():
            if frame in self.reasons:
                found.append(
                    "the times of points cannot be used, so scans are not de-skewed: " + self.reasons[frame]
                )
            elif times is not None and (times.origin in ("first", "last") or times.field == FIRING_ORDER):
                found.append(f"times of points: {times.words}")
        return tuple(found)


def times_of_topic(container: Container, decoder: RecordDecoder, topic: Topic) -> TopicTimes:
    """Decide how the times of the points of a topic are read, for each frame among its first _TIMED_SCANS
    clouds with points. Messages that cannot be read are left out, not counted; other types have no times.

    Args:
        container: The recording.
        decoder: Decoder of its messages.
        topic: The topic.

    Raises:
        SourceError: The recording cannot be read.
    """
    scans: dict[str, list[TimedScan]] = {}
    delays_ns = list[int]()
    for message in container.messages(topic.numbers, None, {}) if topic.msgtype in TIMED_TYPES else ():
        try:
            with np.errstate(all="ignore"):
                timed = decoder.timed(message)
        except Exception:  # noqa: S112 - as in RecordDecoder.record, which counts it
            continue
        if timed is not None:
            scans.setdefault(timed[0], []).append(timed[1])
            delays_ns.append(message.log_ns - timed[1].stamp_ns)
        if len(delays_ns) == _TIMED_SCANS:
            break
    delay_ns = int(np.median(delays_ns)) if delays_ns else 0
    delay_ns = delay_ns if delay_ns < SECOND_NS else 0  # longer: by another clock
    decided = {frame: decide_point_times(timed, delay_ns=delay_ns) for frame, timed in scans.items()}
    return TopicTimes(
        {frame: times for frame, (times, _) in decided.items()},
        {frame: why for frame, (_, why) in decided.items() if why},
    )


@dataclass(frozen=True, slots=True, eq=False)
class FirstScan:
    """The first scan, the frame of its header, and the sensor except for its range sigma (None if it is
    unknown)."""

    scan: Scan
    frame: str
    sensor: Sensor | None


def find_first_scan(messages: TimedMessages, decoder: RecordDecoder, lidar: str, where: str) -> FirstScan:
    """Return the first scan with points. Of several LiDARs on the topic it is that of the frame `lidar`, if
    this has points among the first _MOST_SCANS.

    Args:
        messages: The messages.
        decoder: Their decoder.
        lidar: Frame of the LiDAR.
        where: Name of the recording and its topic in errors.

    Raises:
        SourceError: No message has points that can be read, or its packets cannot be decoded.
    """
    reason, kind = "the topic has no messages that can be read", SourceError
    other: FirstScan | None = None
    for number, arrival in enumerate(messages.messages(messages.odometry.topics.numbers("scan"))):
        try:
            with np.errstate(all="ignore"):
                found = FirstScan(*decoder.scan(arrival.content, arrival.stamp_ns, {}))
        except SourceError as error:
            raise SourceError(error.what, where=where, remedy=error.remedy) from None
        except Exception as error:  # as in RecordDecoder.record
            reason = f"its scans cannot be read: {str(error)[:200] or type(error).__name__}"
            kind = SourceError
            continue
        if not len(found.scan.points):
            reason, kind = "its scans have no points", EmptyScansError
            continue
        if found.frame == lidar:
            return found
        other = other or found
        if number >= _MOST_SCANS:
            return other
    if other is not None:
        return other
    raise kind(reason, where=where, remedy="Name another with --topic scan=NAME.")
