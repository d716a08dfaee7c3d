"""What the stages made of each scan of a run, kept in memory so that a change begins where it acts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.gathering import Judged, judged
from pipeline.geometry import Float, Pose2
from pipeline.mapper_records import Noted
from pipeline.parameters import field_specs
from pipeline.parameters.stages import Slam
from pipeline.records import Detections

MOST_BYTES = 512 << 20
# m; no tree is held to a landmark farther from it, whatever the parameters.
FARTHEST = max(float(s.maximum or 0.0) for s in field_specs() if s.name == "tracking.distance_max") + 0.01
_ROUND = 400  # bytes of an entry beside its arrays, about


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """All that the tracking asks of one scan; see `Tracker.process`, `anchor` and `judge`.

    Attributes:
        offset: The sensor in the base frame, shape (3,) [m].
        landmarks: Positions and covariances of those that a tree can be held to.
        columns: Where the scan was gathered, else None.
        is_usual: See `Noted`.
        nbytes: That it takes.
    """

    stamp_ns: int
    T_map_base: Pose2
    covariance: Float
    relative: Float | None
    detections: Detections
    heights: Float | None
    free: Float
    offset: Float
    landmarks: tuple[Float, Float]
    columns: Judged | None
    is_usual: bool
    nbytes: int


class Journal:
    """Of a run's scans from its first on, as long as there is room: a scan for which there is none is not
    noted, and none after it.

    Args:
        most: Bytes that it may take.
    """

    def __init__(self, most: int = MOST_BYTES) -> None:
        self._most = most
        self._entries: list[Entry] = []
        self.nbytes = 0

    def __len__(self) -> int:
        return len(self._entries)

    def note(self, noted: Noted, slam: Slam) -> None:
        """Take a scan, which is the next one or one that is there; later ones are forgotten."""
        self.cut(noted.index)
        if len(self) < noted.index:
            return  # one before it had no room
        entry = _entry(noted, slam.view_range + FARTHEST)
        if self.nbytes + entry.nbytes > self._most:
            return
        self.nbytes += entry.nbytes
        self._entries.append(entry)

    def cut(self, scans: int) -> None:
        """Keep the first ones alone."""
        if scans < len(self):
            self.nbytes -= sum(entry.nbytes for entry in self._entries[scans:])
            del self._entries[scans:]

    def first(self, scans: int) -> tuple[Entry, ...]:
        """Of the first scans, or as many as there are."""
        return tuple(self._entries[:scans])

    def take(self, entries: tuple[Entry, ...]) -> None:
        """Begin with these."""
        self._entries = list(entries)
        self.nbytes = sum(entry.nbytes for entry in entries)


def _entry(noted: Noted, reach: float) -> Entry:
    estimate, seen, found = noted.estimate, noted.seen, noted.seen.detections
    place, covariance = noted.landmarks
    pose = estimate.T_map_base
    near = np.hypot(place[:, 0] - pose.x, place[:, 1] - pose.y) < reach
    landmarks = place[near], covariance[near]
    free = seen.looked.free
    free = free if free.base is None else free.copy()  # what was read from disk is a part of a large block
    columns = None if noted.columns is None else judged(noted.columns)
    size = free.nbytes + landmarks[0].nbytes + landmarks[1].nbytes + 96 * len(found.cluster) + _ROUND
    return Entry(
        stamp_ns=noted.stamp_ns,
        T_map_base=pose,
        covariance=estimate.covariance,
        relative=estimate.relative,
        detections=found,
        heights=seen.heights,
        free=free,
        offset=seen.looked.sensor_offset,
        landmarks=landmarks,
        columns=columns,
        is_usual=noted.is_usual,
        nbytes=size + (columns.nbytes if columns is not None else 0),
    )
