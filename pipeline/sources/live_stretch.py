"""GNSS fixes of a live run: laid over the way while it is driven, until north is known well enough."""

from __future__ import annotations

import math

import numpy as np

from pipeline.geometry import Pose3
from pipeline.records import Odometry
from pipeline.sources.container import Message
from pipeline.sources.first_stretch import lever_of
from pipeline.sources.gnss import LONGEST, SHORTEST, Alignment, Fix, align
from pipeline.sources.ordering import Stamped
from pipeline.sources.ros_records import RecordDecoder

#: North is held from when it is known to this [rad]; after `LONGEST` metres it must do as it is.
NORTH_SIGMA = math.radians(2.0)
#: It is tried again when the robot is farther away by this factor.
_FARTHER = 1.2
#: Readings closer in time tell nothing new of where the way went [ns]; and so many are kept.
_APART_NS = 100_000_000
_MOST = 60_000


class LiveStretch:
    """Gathers odometry and fixes as they come; what comes of it hangs on them alone, as in a replay.

    Args:
        decoder: Of the messages.
        fixes: Numbers of the channels of fixes.
        start_ns: Time of the first scan, where the map begins.
    """

    def __init__(self, decoder: RecordDecoder, fixes: frozenset[int], start_ns: int) -> None:
        self._decoder, self._fixes, self._start_ns = decoder, fixes, start_ns
        self._seen: list[Fix] = []
        self._way: list[tuple[int, Pose3]] = []
        self._origin: tuple[int, Pose3] | None = None
        self._frame = ""
        self._try_at = SHORTEST
        #: Why fixes will not be used, "" while that is open.
        self.refused = ""

    def add(self, stamped: Stamped[Message | Odometry]) -> Alignment | None:
        """Take what came next; the alignment, once it is known."""
        told = stamped.content
        try:
            with np.errstate(all="ignore"):
                if isinstance(told, Message) and told.channel in self._fixes:
                    fix, self._frame = self._decoder.fix(told, stamped.stamp_ns)
                    return None if fix is None else self._add_fix(fix)
                record = (
                    self._decoder.record(told, stamped.stamp_ns, {}) if isinstance(told, Message) else told
                )
        except Exception:  # as in RecordDecoder.record; it is counted when it is read
            return None
        if isinstance(record, Odometry):
            self._add_pose(record)
        return None

    def _add_pose(self, odometry: Odometry) -> None:
        off_ns = abs(odometry.stamp_ns - self._start_ns)
        if self._origin is None or off_ns < abs(self._origin[0] - self._start_ns):
            self._origin = (odometry.stamp_ns, odometry.T_odom_base)
        if not self._way or odometry.stamp_ns >= self._way[-1][0] + _APART_NS:
            self._way.append((odometry.stamp_ns, odometry.T_odom_base))

    def _add_fix(self, fix: Fix) -> Alignment | None:
        if self._seen and fix.stamp_ns < self._seen[-1].stamp_ns + _APART_NS:
            return None
        self._seen.append(fix)
        if len(self._seen) + len(self._way) > _MOST:
            self.refused = "the robot did not drive far enough to tell the direction of north"
        if self._origin is None or self.refused:
            return None
        away = float(np.hypot(*(self._way[-1][1].t - self._way[0][1].t)[:2]))
        if away < self._try_at:
            return None
        self._try_at = _FARTHER * away
        start = self._origin[1].planar()
        there = np.array([(start.inverse() @ pose.planar()).as_array()[:2] for _, pose in self._way])
        lever = lever_of(self._decoder, self._frame)
        found, why = align(self._seen, [stamp_ns for stamp_ns, _ in self._way], there, lever)
        if away >= LONGEST:
            self.refused = why
            return found
        return found if found is not None and found.yaw_sigma <= NORTH_SIGMA else None
