"""Alignment of the frames of GNSS fixes and of another SLAM with the map frame, in recordings and live.

The pose of such a frame is fitted once, to the odometry of the first stretch of the drive. From then on the
decoder of the records turns the readings into pose measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers.base import SourceDescription
from pipeline.io.readers.container import Container, Message
from pipeline.io.readers.measured_poses import FIX_STRETCH, POSE_STRETCH, align_fixes, align_poses
from pipeline.io.readers.message_time import Stamped
from pipeline.io.readers.ros_records import RecordDecoder
from pipeline.io.readers.topics import Topics
from pipeline.types.records import Odometry

#: A fit is accepted early when its rotation is known to this [rad].
NORTH_SIGMA = math.radians(2.0)
#: The next fit is tried when the distance from the start has grown by this factor.
_FARTHER = 1.2
#: Readings closer in time are skipped [ns].
_APART_NS = 100_000_000
_MOST_READINGS = 60_000
#: Number of unusable readings after which a source without any usable one is given up.
_HOPELESS = 200

TimesOf = Callable[[Message, dict[str, int]], Iterator[Stamped[Message | Odometry]]]


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of readings in another frame.

    Attributes:
        role: "gnss" or "pose".
        field: Field of `SourceDescription` that describes their use.
        title, plural, short, unknown: For messages: name, plural, short plural, and what a short drive does
            not determine.
        read: Decodes a message: the reading, None when there is none in it, and the name of its frame.
        align: Fits the frame: readings, times and poses of the odometry, lever -> frame, or None and the
            reason.
        shortest, longest: Distance from the start for the first fit, and for the last one [m].
        early: Whether a recording uses the first good fit, as a live run does, or the last one.
    """

    role: str
    field: str
    title: str
    plural: str
    short: str
    unknown: str
    read: Callable[[Message, int], tuple[Any, str]]
    align: Callable[[Sequence[Any], Sequence[int], Float, float], tuple[Any, str]]
    shortest: float
    longest: float
    early: bool


class FrameAlignment:
    """Collects odometry and readings of one kind until the pose of their frame is known.

    The result depends only on the readings and their order, so a recording gives the same as the live run.

    Args:
        decoder: Decoder of the messages.
        kind: Kind of the readings.
        readings, odometry: Numbers of the channels of the readings and of the odometry.
        start_ns: Time of the first scan, which is the origin of the map.
        early: Whether a fit before `kind.longest` is accepted.

    Attributes:
        refused: Why the readings are not used, "" while that is open.
    """

    def __init__(
        self,
        decoder: RecordDecoder,
        kind: _Kind,
        readings: frozenset[int],
        odometry: frozenset[int],
        start_ns: int,
        *,
        early: bool,
    ) -> None:
        self._decoder, self.kind, self.readings, self._odometry = decoder, kind, readings, odometry
        self._start_ns, self._early = start_ns, early
        self._found: list[Any] = []
        self._path: list[tuple[int, Pose3]] = []
        self._origin: tuple[int, Pose3] | None = None
        self._frame = ""
        self._try_at = kind.shortest if early else kind.longest
        self._unusable, self._fault = 0, ""
        self.refused = ""

    def add(self, stamped: Stamped[Message | Odometry]) -> Any:  # noqa: ANN401 - GnssFrame or OtherFrame
        """Process the next message or odometry. Return the frame once it is known, else None."""
        content = stamped.content
        if isinstance(content, Odometry):
            self._add_odometry(content)
        elif content.channel in self.readings:
            return self._add_reading(content, stamped.stamp_ns)
        elif content.channel in self._odometry:
            record = self._decoder.record(content, stamped.stamp_ns, {})
            if isinstance(record, Odometry):
                self._add_odometry(record)
        return None

    def finish(self) -> tuple[Any, str]:
        """Fit the frame to all readings; return it, or None and the reason why it is unknown."""
        if self._origin is None:
            return None, "no odometry can be read"
        found, why = self._fit(self._origin[1])
        if self._unusable:
            why += f" ({self._unusable:,} more cannot be used: {self._fault})"
        return found, why

    def _add_odometry(self, odometry: Odometry) -> None:
        off_ns = abs(odometry.stamp_ns - self._start_ns)
        if self._origin is None or off_ns < abs(self._origin[0] - self._start_ns):
            self._origin = (odometry.stamp_ns, odometry.T_odom_base)
        if not self._path or odometry.stamp_ns >= self._path[-1][0] + _APART_NS:
            self._path.append((odometry.stamp_ns, odometry.T_odom_base))

    def _add_reading(self, message: Message, stamp_ns: int) -> Any:  # noqa: ANN401
        try:
            with np.errstate(all="ignore"):
                reading, self._frame = self.kind.read(message, stamp_ns)
        except Exception as error:  # as in RecordDecoder.record, which counts it
            self._unusable, self._fault = self._unusable + 1, str(error)[:200]
            if self._unusable >= _HOPELESS and not self._found:
                self.refused = f"none of the first {self._unusable} can be used: {self._fault}"
            return None
        if reading is None or (self._found and reading.stamp_ns < self._found[-1].stamp_ns + _APART_NS):
            return None
        self._found.append(reading)
        if len(self._found) + len(self._path) > _MOST_READINGS:
            self.refused = f"the robot did not drive far enough to determine {self.kind.unknown}"
        return None if self._origin is None or self.refused else self._try_fit(self._origin[1])

    def _try_fit(self, origin: Pose3) -> Any:  # noqa: ANN401
        away = float(np.hypot(*(self._path[-1][1].t - self._path[0][1].t)[:2]))
        if away < self._try_at:
            return None
        self._try_at = _FARTHER * away
        found, why = self._fit(origin)
        if away >= self.kind.longest:
            self.refused = why
            return found
        return found if found is not None and found.yaw_sigma <= NORTH_SIGMA else None

    def _fit(self, T_odom_start: Pose3) -> tuple[Any, str]:
        start = T_odom_start.planar().inverse()
        path = np.array([(start @ pose.planar()).as_array() for _, pose in self._path])
        linked = self._decoder.place_of(self._frame)
        lever = 0.0 if linked is None else float(np.hypot(linked.t[0], linked.t[1]))
        return self.kind.align(self._found, [stamp_ns for stamp_ns, _ in self._path], path, lever)


class FrameAlignments:
    """Aligns the frames of GNSS fixes and of another SLAM, and gives the frames to the decoder.

    Args:
        container: The messages that are known when the source is opened.
        decoder: Decoder of the messages; it gets the frames.
        topics: Topics that are read.
        odometry: Numbers of the channels of odometry.
        times_of: Yields what a message contains with its times.

    Attributes:
        numbers: Channels whose messages are used, or may be used later.
        notices: New messages for the user; whoever shows them clears the list.
    """

    def __init__(
        self,
        container: Container,
        decoder: RecordDecoder,
        topics: Topics,
        odometry: frozenset[int],
        times_of: TimesOf,
    ) -> None:
        self._container, self._decoder, self._odometry = container, decoder, odometry
        self._times_of = times_of
        kinds = (
            _Kind("gnss", "gnss", "GNSS", "GNSS fixes", "fixes", "the direction of north", decoder.fix,
                  align_fixes, *FIX_STRETCH, early=False),
            _Kind("pose", "other_slam", "other SLAM", "Poses of another SLAM", "poses",
                  "the pose of their frame", decoder.other_pose,
                  lambda poses, stamps, path, _lever: align_poses(poses, stamps, path),
                  *POSE_STRETCH, early=True),
        )  # fmt: skip
        self._kinds = [(kind, topics.numbers(kind.role)) for kind in kinds if kind.role in topics.chosen]
        self._open: list[FrameAlignment] = []
        self.numbers = frozenset[int]().union(*(numbers for _, numbers in self._kinds))
        self.notices: list[str] = []

    def begin(self, description: SourceDescription, *, live: bool) -> SourceDescription:
        """Align the frames of a recording, or prepare the alignment for a live run. Return the description
        with how the readings are used.

        Args:
            description: Description of the source.
            live: Whether the run is live.
        """
        for kind, numbers in self._kinds:
            found, why, text = None, "", ""
            alignment = FrameAlignment(
                self._decoder,
                kind,
                numbers,
                self._odometry,
                description.start_ns or 0,
                early=live or kind.early,
            )
            if not (description.has_odometry if live else self._odometry):
                why = f"without odometry {kind.unknown} is unknown"
            elif live:
                self._open.append(alignment)
                text = f"{kind.short} count when the robot has driven far enough to determine {kind.unknown}"
            else:
                found, why = self._align_recording(alignment)
                if found is not None:
                    self._decoder.frames[kind.role] = found
                    text = found.summary
            if text:
                changes: dict[str, Any] = {kind.field: text}
                description = replace(description, **changes)
            else:
                self.numbers -= numbers
                warnings = (*description.warnings, f"{kind.plural} are not used: {why}")
                description = replace(description, warnings=warnings)
        return description

    def add(self, stamped: Stamped[Message | Odometry]) -> None:
        """Process the next message or odometry of a live run, before it is decoded to a record."""
        for alignment in tuple(self._open):
            kind, found = alignment.kind, alignment.add(stamped)
            if found is not None:
                self._decoder.frames[kind.role] = found
                self.notices.append(f"{kind.title}: {found.summary}")
            elif alignment.refused:
                self.numbers -= alignment.readings
                self.notices.append(f"{kind.plural} are not used: {alignment.refused}")
            else:
                continue
            self._open.remove(alignment)

    def _align_recording(self, alignment: FrameAlignment) -> tuple[Any, str]:
        messages = self._container.messages(alignment.readings | self._odometry, None, {})
        for message in islice(messages, _MOST_READINGS):
            for stamped in self._times_of(message, {}):
                found = alignment.add(stamped)
                if found is not None or alignment.refused:
                    return found, alignment.refused
        return alignment.finish()
