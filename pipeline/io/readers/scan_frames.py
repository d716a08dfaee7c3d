"""Frames of scans: each scan gets the extrinsics of the LiDAR in its header, and a cloud in the frame of a
map is moved back by the odometry at its time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import count_loss
from pipeline.io.readers.pose_files import between
from pipeline.io.readers.transforms import TransformTree
from pipeline.types.records import Odometry, Record, Scan

#: Poses of the odometry that are kept [ns], and the longest time for which a scan waits for the next one.
KEPT_NS, WAIT_NS = 3_000_000_000, 500_000_000
#: A pose that is farther in time from a scan does not place it [ns].
_NEAR_NS = 250_000_000


@dataclass(frozen=True, slots=True)
class FramedScan:
    """A scan in the frame of its header."""

    frame: str
    scan: Scan


@dataclass(frozen=True, slots=True)
class MovingLink:
    """Pose T_parent_child of a moving transform at a time [ns]."""

    stamp_ns: int
    parent: str
    child: str
    pose: Pose3


def moved(scan: Scan, T_lidar_frame: Pose3) -> Scan:
    """Return a scan with its points in the frame of the LiDAR."""
    points = scan.points.astype(np.float64) @ T_lidar_frame.R.T + T_lidar_frame.t
    return replace(scan, points=np.ascontiguousarray(points, dtype=np.float32))


class ScanFrames:
    """Gives each scan the extrinsics of its frame, and moves those in the frame of a map to that of the
    LiDAR.

    Args:
        tree: Fixed transforms.
        lidar: Frame of the LiDAR.
        T_base_lidar: Extrinsics of the LiDAR.
        world: Chain of frames from a map frame, in which clouds are, to the frame of the odometry; () if
            there is none. Its links are fixed transforms, or moving ones that are passed to `add`.
    """

    def __init__(
        self,
        tree: TransformTree,
        lidar: str,
        T_base_lidar: Pose3,
        world: Sequence[str] = (),
    ) -> None:
        """Begin without records."""
        self._tree, self._lidar, self._world = tree, lidar, tuple(world)
        self._T_base_lidar, self._T_lidar_base = T_base_lidar, T_base_lidar.inverse()
        self._placed: dict[str, Pose3 | None] = {lidar: Pose3.identity()}
        self._waiting: deque[Scan] = deque()
        self._odometry: deque[Odometry] = deque()
        self._links: dict[tuple[str, str], Pose3] = {}

    def add(self, record: Record | FramedScan | MovingLink, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the records that are complete with the next one, in the order of time. A scan in a map frame
        waits for the odometry at or after its time; other records pass.

        Args:
            record: The record; scans are `FramedScan`.
            losses: Dict from reasons to numbers of scans that cannot be placed; increased in place.
        """
        if isinstance(record, MovingLink):
            self._links[record.parent, record.child] = record.pose
        elif not isinstance(record, FramedScan):
            if isinstance(record, Odometry) and self._world:
                self._odometry.append(record)
                while self._odometry[0].stamp_ns < record.stamp_ns - KEPT_NS:
                    self._odometry.popleft()
            yield record
        elif self._world and record.frame == self._world[0]:
            # Its points were moved to their places already, so their times are not needed.
            self._waiting.append(replace(record.scan, offset_ns=None))
        else:
            place = self._place_of(record.frame)
            if place is not None:
                own = None if record.frame == self._lidar else self._T_base_lidar @ place
                yield replace(record.scan, T_base_lidar=own)
            else:
                count_loss(losses, f"scans in the other frame {record.frame}, without a fixed transform")
        yield from self._placed_scans(losses)

    def end(self, losses: dict[str, int]) -> Iterator[Record]:
        """Yield the scans that still wait; `losses` as in `add`."""
        yield from self._placed_scans(losses, end=True)

    def _place_of(self, frame: str) -> Pose3 | None:
        """Return T_lidar_frame of a frame by the fixed transforms; None if there are none."""
        if frame not in self._placed:
            self._placed[frame] = self._tree.find(self._lidar, frame) if frame else None
        return self._placed[frame]

    def _placed_scans(self, losses: dict[str, int], *, end: bool = False) -> Iterator[Scan]:
        """Yield the waiting scans whose odometry has arrived, or which have waited for WAIT_NS; with `end`,
        all. Scans without a pose at their time are counted in `losses`."""
        while self._waiting:
            scan, newest = self._waiting[0], self._odometry[-1].stamp_ns if self._odometry else None
            waited = self._waiting[-1].stamp_ns - scan.stamp_ns
            if not (end or (newest is not None and newest >= scan.stamp_ns) or waited > WAIT_NS):
                return
            self._waiting.popleft()
            T_world_odom, T_odom_base = self._odometry_in_world(), self._pose_at(scan.stamp_ns)
            if T_world_odom is None or T_odom_base is None:
                count_loss(losses, f"scans in the frame {self._world[0]} without odometry at their time")
            else:
                yield moved(scan, self._T_lidar_base @ (T_world_odom @ T_odom_base).inverse())

    def _odometry_in_world(self) -> Pose3 | None:
        """Return the pose of the frame of the odometry in the map frame; None if a link is unknown."""
        T = Pose3.identity()
        for parent, child in zip(self._world[:-1], self._world[1:], strict=True):
            link = self._tree.find(parent, child) or self._links.get((parent, child))
            if link is None:
                return None
            T = T @ link
        return T

    def _pose_at(self, stamp_ns: int) -> Pose3 | None:
        """Return T_odom_base at a time [ns], interpolated; that of the nearest reading outside of them, None
        if it is farther than _NEAR_NS."""
        readings = self._odometry
        after = next((k for k, reading in enumerate(readings) if reading.stamp_ns >= stamp_ns), len(readings))
        if 0 < after < len(readings):
            a, b = readings[after - 1], readings[after]
            share = (stamp_ns - a.stamp_ns) / max(b.stamp_ns - a.stamp_ns, 1)
            return between(a.T_odom_base, b.T_odom_base, share)
        nearest = readings[min(after, len(readings) - 1)] if readings else None
        if nearest is None or abs(nearest.stamp_ns - stamp_ns) > _NEAR_NS:
            return None
        return nearest.T_odom_base
