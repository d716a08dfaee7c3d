"""Readings in another frame, such as GNSS fixes, as pose measurements in the map frame.

The pose of the other frame in our map is fitted once to the odometry of the first stretch of the drive, by
least squares in the plane (Arun, Huang, Blostein 1987).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.geometry.poses import Float, Pose2, Pose3
from pipeline.io.readers import added
from pipeline.io.readers.base import SourceDescription
from pipeline.io.readers.container import Message
from pipeline.io.readers.message_formats import MeasuredFrame, ReadingFormat
from pipeline.io.readers.message_time import Stamped
from pipeline.io.readers.scan_frames import MovingLink
from pipeline.types.records import Int, Odometry

if TYPE_CHECKING:
    from pipeline.io.readers.ros_messages import TimedMessages
    from pipeline.io.readers.ros_records import RecordDecoder
    from pipeline.io.readers.topics import Topics

FEWEST = 8  # positions
#: A larger RMS residual, in sigmas of a position, means that the positions belong to another path.
WORST = 4.0
#: Variance of a heading that is not measured [rad^2].
NO_HEADING = 1e4


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """Pose of another frame in the map frame.

    Attributes:
        T_map_other: The rigid motion.
        centre: Centre of the fitted part of the path in the map, shape (2,) [m].
        sigma: Standard deviation of the shift [m].
        yaw_sigma: Standard deviation of the rotation [rad].
        residual: RMS distance of the positions from the path [m].
        length: Extent of the fitted part of the path [m].
        rate_hz: Rate of the positions [Hz]; the positions of one second count as one.
    """

    T_map_other: Pose2
    centre: Float
    sigma: float
    yaw_sigma: float
    residual: float
    length: float
    rate_hz: float

    def shared(self, x: float, y: float, sigma: float, yaw_sigma: float, heading_sigma: float = 0.0) -> Float:
        """Return the factor L of the covariance L L^T of (x, y, yaw) that all positions share, shape (3, 4);
        see PoseMeasurement. Its columns are the shift along x and y, the rotation about `centre`, and the
        heading.

        Args:
            x, y: Position in the map [m].
            sigma: Standard deviation of the shift of the frame [m].
            yaw_sigma: Standard deviation of the rotation of the frame about `centre` [rad].
            heading_sigma: Standard deviation of the difference of the headings [rad].
        """
        dx, dy = x - self.centre[0], y - self.centre[1]
        return np.array(
            [
                [sigma, 0.0, -dy * yaw_sigma, 0.0],
                [0.0, sigma, dx * yaw_sigma, 0.0],
                [0.0, 0.0, 0.0, heading_sigma],
            ]
        )


def interpolated(at_ns: Int, stamp_ns: Sequence[int], path: Float) -> Float:
    """Return the columns of a path, linearly interpolated at other times, shape (K, C). Outside of the path
    its end values apply.

    Args:
        at_ns: Times of the result, shape (K,) [ns].
        stamp_ns: Times of the path, ascending [ns], length N > 0.
        path: Columns of the path, shape (N, C).
    """
    times = (np.asarray(stamp_ns, dtype=np.int64) - int(stamp_ns[0])).astype(np.float64)
    at = (at_ns - int(stamp_ns[0])).astype(np.float64)
    columns: Float = np.stack([np.interp(at, times, column) for column in path.T], axis=1)
    return columns


def fit_rigid(
    at_ns: Int,
    positions: Float,
    sigma: Float,
    stamp_ns: Sequence[int],
    path: Float,
    *,
    shortest: float,
    what: str,
    unknown: str,
) -> tuple[RigidFit | None, str]:
    """Fit the pose of another frame in the map.

    Args:
        at_ns: Times of the positions, ascending, shape (K,) [ns].
        positions: Positions in the other frame, shape (K, 2) [m].
        sigma: Standard deviation of each position, shape (K,) [m].
        stamp_ns: Times of the odometry, ascending, shape (N,) [ns].
        path: Positions of the base by odometry in the map frame, shape (N, 2) [m].
        shortest: Shortest extent of the path for a fit [m].
        what, unknown: For messages: name of the positions, and what a short path does not determine.

    Returns:
        The fit and "", or None and the reason why there is none: fewer than two times of the odometry, fewer
        than FEWEST positions within its time, a path shorter than `shortest` or than three sigmas, or an RMS
        residual above WORST times the larger of the median sigma and 2 % of the path. Positions that are not
        finite are ignored.
    """
    if len(positions) < FEWEST or len(stamp_ns) < 2:
        return None, f"{len(positions)} {what} are too few"
    by_odometry = interpolated(at_ns, stamp_ns, path)
    inside = (at_ns >= stamp_ns[0]) & (at_ns <= stamp_ns[-1]) & np.isfinite(positions).all(axis=1)
    positions, by_odometry, sigma = positions[inside], by_odometry[inside], sigma[inside]
    if len(positions) < FEWEST:
        return None, f"{what} and odometry are not from the same time"
    length = float(np.hypot(*np.ptp(by_odometry, axis=0)))
    if length < max(shortest, 3.0 * float(np.median(sigma))):
        return None, f"the robot drove {length:.0f} m, too little to determine {unknown}"
    w = 1.0 / np.square(sigma)
    w /= w.sum()
    centre_other, centre = w @ positions, w @ by_odometry
    a, b = positions - centre_other, by_odometry - centre
    yaw = math.atan2(float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(w @ (a * b).sum(axis=1)))
    c, s = math.cos(yaw), math.sin(yaw)
    rotated = a @ np.array([[c, s], [-s, c]])
    residual = float(np.sqrt(w @ np.square(rotated - b).sum(axis=1)))
    typical = float(np.median(sigma))
    if residual > WORST * max(typical, 0.02 * length):
        return None, f"their distance from the path by odometry is {residual:.1f} m (RMS)"
    # Errors that change slowly do not average out: only one position in ten counts.
    known = max(typical, residual) / math.sqrt(max(len(positions) / 10.0, 1.0))
    spread = float(np.sqrt(w @ np.square(b).sum(axis=1)))
    shift = centre - np.array([[c, -s], [s, c]]) @ centre_other
    span_s = int(at_ns[-1] - at_ns[0]) * 1e-9
    rate = (len(at_ns) - 1) / span_s if span_s > 0.0 else 1.0
    T_map_other = Pose2(float(shift[0]), float(shift[1]), yaw)
    return RigidFit(T_map_other, centre, known, known / spread, residual, length, rate), ""


def readings_of(topics: Topics) -> dict[int, ReadingFormat]:
    """Return a dict from the numbers of channels to the kind of the readings in them."""
    kinds = [kind for kind in added(ReadingFormat) if kind.role in topics.chosen]
    return {number: kind for kind in kinds for number in sorted(topics.numbers(kind.role))}


# --- alignment in recordings and live ---------------------------------------------------------------

#: A fit is accepted early when its rotation is known to this [rad].
NORTH_SIGMA = math.radians(2.0)
#: The next fit is tried when the distance from the start has grown by this factor.
_FARTHER = 1.2
#: Readings closer in time are skipped [ns].
_APART_NS = 100_000_000
_MOST_READINGS = 60_000
#: Number of unusable readings after which a source without any usable one is given up.
_HOPELESS = 200


class FrameAlignment:
    """Collects odometry and readings of one kind until the pose of their frame is known.

    The result depends only on the readings and their order, so a recording gives the same as the live run.

    Args:
        decoder: Decoder of the messages.
        kind: Kind of the readings.
        readings, odometry: Numbers of the channels of the readings and of the odometry.
        start_ns: Time of the first scan [ns]; the pose at this time is the origin of the map.
        early: Whether a fit before the end of `kind.stretch` is accepted.

    Attributes:
        refused: Reason why the readings are not used; "" while this is not decided.
    """

    def __init__(
        self,
        decoder: RecordDecoder,
        kind: ReadingFormat,
        readings: frozenset[int],
        odometry: frozenset[int],
        start_ns: int,
        *,
        early: bool,
    ) -> None:
        """Begin without readings."""
        self._decoder, self.kind, self.readings, self._odometry = decoder, kind, readings, odometry
        self._start_ns, self._early = start_ns, early
        self._found: list[Any] = []
        self._path: list[tuple[int, Pose3]] = []
        self._origin: tuple[int, Pose3] | None = None
        self._frame = ""
        self._try_at = kind.stretch[0] if early else kind.stretch[1]
        self._unusable, self._fault = 0, ""
        self.refused = ""

    def add(self, stamped: Stamped[Message | Odometry | MovingLink]) -> MeasuredFrame | None:
        """Process the next message or odometry. Return the frame once it is known,
        else None; if it can never be known, `refused` is set. Messages of other channels are ignored."""
        content = stamped.content
        if isinstance(content, Odometry):
            self._add_odometry(content)
        elif isinstance(content, MovingLink):
            return None
        elif content.channel in self.readings:
            return self._add_reading(content, stamped.stamp_ns)
        elif content.channel in self._odometry:
            record = self._decoder.record(content, stamped.stamp_ns, {})
            if isinstance(record, Odometry):
                self._add_odometry(record)
        return None

    def finish(self) -> tuple[MeasuredFrame | None, str]:
        """Fit the frame to all readings; return it and "", or None and the reason why it is unknown. In both
        cases the number of damaged readings is added to the text, if there are any."""
        if self._origin is None:
            return None, "no odometry can be read"
        found, why = self._fit(self._origin[1])
        if self._unusable:
            why += f" ({self._unusable:,} more cannot be used: {self._fault})"
        return found, why

    def _add_odometry(self, odometry: Odometry) -> None:
        """Add a pose to the path, unless it is less than _APART_NS after the last one. The pose nearest in
        time to the first scan becomes the origin of the map."""
        off_ns = abs(odometry.stamp_ns - self._start_ns)
        if self._origin is None or off_ns < abs(self._origin[0] - self._start_ns):
            self._origin = (odometry.stamp_ns, odometry.T_odom_base)
        if not self._path or odometry.stamp_ns >= self._path[-1][0] + _APART_NS:
            self._path.append((odometry.stamp_ns, odometry.T_odom_base))

    def _add_reading(self, message: Message, stamp_ns: int) -> MeasuredFrame | None:
        """Decode and store a reading; return the frame if it is known now, else None. Damaged readings, those
        without a position and those less than _APART_NS after the last one are left out. `refused` is set
        after _HOPELESS damaged readings without a usable one, and with more than _MOST_READINGS readings and
        poses of the odometry together."""
        try:
            with np.errstate(all="ignore"):
                reading, self._frame = self.kind.read(self._decoder, message, stamp_ns)
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

    def _try_fit(self, origin: Pose3) -> MeasuredFrame | None:
        """Try to fit the frame; return it if the fit is good, else None.

        Nothing is tried until the robot is far enough from its start for the next trial. The last trial is
        made at the end of `kind.stretch`: its frame is returned even if the fit is not good; without a frame,
        `refused` is set to the reason. `origin` is T_odom_start at the first scan.
        """
        away = float(np.hypot(*(self._path[-1][1].t - self._path[0][1].t)[:2]))
        if away < self._try_at:
            return None
        self._try_at = _FARTHER * away
        found, why = self._fit(origin)
        if away >= self.kind.stretch[1]:
            self.refused = why
            return found
        return found if found is not None and found.yaw_sigma <= NORTH_SIGMA else None

    def _fit(self, T_odom_start: Pose3) -> tuple[MeasuredFrame | None, str]:
        """Fit the frame to all readings so far with `kind.align`. Return the frame
        and "", or None and the reason why it is unknown. The map frame is the planar pose `T_odom_start` of
        the base at the first scan. The horizontal distance of the sensor from the base is 0 if the transforms
        do not contain it."""
        start = T_odom_start.planar().inverse()
        path = np.array([(start @ pose.planar()).as_array() for _, pose in self._path])
        linked = self._decoder.place_of(self._frame)
        lever = 0.0 if linked is None else float(np.hypot(linked.t[0], linked.t[1]))
        return self.kind.align(self._found, [stamp_ns for stamp_ns, _ in self._path], path, lever)


class FrameAlignments:
    """Aligns the frames of readings, and gives the frames to the decoder.

    Args:
        decoder: Decoder of the messages; the frames are stored in its `frames`.
        messages: The messages that are known when the source is opened, with their times.

    Attributes:
        numbers: Channels whose messages are used, or may be used later.
        notices: New messages for the user; whoever shows them clears the list.
    """

    def __init__(self, decoder: RecordDecoder, messages: TimedMessages) -> None:
        """Choose the readings by the topics that are read; nothing is aligned."""
        self._decoder, self._messages, self._odometry = decoder, messages, messages.odometry.numbers
        topics = messages.odometry.topics
        kinds = dict.fromkeys(readings_of(topics).values())
        self._kinds = [(kind, topics.numbers(kind.role)) for kind in kinds]
        self._open: list[FrameAlignment] = []
        self.numbers = frozenset[int]().union(*(numbers for _, numbers in self._kinds))
        self.notices: list[str] = []

    def begin(self, description: SourceDescription, *, live: bool) -> SourceDescription:
        """Align the frames of a recording, or prepare the alignment for a live run. Frames that are found are
        stored in `frames` of the decoder by role. Return the description with how the readings are used, or
        with a warning why they are not.

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
            if kind.refusal:
                why = kind.refusal
            elif not (description.has_odometry if live else self._odometry):
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

    def add(self, stamped: Stamped[Message | Odometry | MovingLink]) -> None:
        """Process the next message or odometry of a live run, before it is decoded to a record. A frame that
        becomes known is passed to the decoder; this, or the reason why readings are not used, is added to
        `notices`."""
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

    def _align_recording(self, alignment: FrameAlignment) -> tuple[MeasuredFrame | None, str]:
        """Return the frame by the first _MOST_READINGS messages of a recording and a text to be ignored, or
        None and the reason why the frame is unknown. Reading ends when the frame is known or refused."""
        for stamped in self._messages.read(alignment.readings | self._odometry, {}, most=_MOST_READINGS):
            found = alignment.add(stamped)
            if found is not None or alignment.refused:
                return found, alignment.refused
        return alignment.finish()
