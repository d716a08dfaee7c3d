"""What the stages made of the scans of a run, laid together so that one compiled loop goes through many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pipeline.classification import Judged
from pipeline.geometry.poses import Float, Pose2
from pipeline.tracking.recorded import Recorded
from pipeline.types.records import Bool, Detections, Int


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """All that the tracking asks of one scan; see `Tracker.process`, `anchor` and `judge`.

    Attributes:
        offset: The sensor in the base frame, shape (3,) [m].
        landmarks: Positions and covariances of those that a tree can be held to.
        columns: Where the scan was gathered, else None.
        is_usual: See `Noted`.
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


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Scans that follow one another.

    Attributes:
        recorded: What the tracking asks of them.
        judged: The columns of all that were gathered, in the rows that `recorded.columns` tells.
        offset: The sensor in the base frame, shape (T, 3) [m].
        is_usual: See `Noted`, shape (T,).
    """

    recorded: Recorded
    judged: Judged
    offset: Float
    is_usual: Bool

    def __len__(self) -> int:
        return len(self.is_usual)

    @property
    def nbytes(self) -> int:
        """Of all columns."""
        told = sum(column.nbytes for column in self.recorded) + self.offset.nbytes + self.is_usual.nbytes
        return told + self.judged.otherwise.nbytes + self.judged.forced.nbytes  # the others are in `recorded`

    @classmethod
    def of(cls, entries: Sequence[Entry]) -> Stretch:
        """Laid together, at least one."""
        found = [e.detections for e in entries]
        known = [e.columns for e in entries if e.columns is not None]
        columns = Judged(*(np.concatenate([getattr(k, f.name) for k in known]) if known
                           else getattr(_NO_COLUMNS, f.name) for f in fields(Judged)))  # fmt: skip
        recorded = Recorded(
            stamp_ns=np.array([e.stamp_ns for e in entries], np.int64),
            pose=np.array([e.T_map_base.as_array() for e in entries]),
            covariance=np.array([e.covariance for e in entries]),
            relative=np.array([e.covariance if e.relative is None else e.relative for e in entries]),
            clear_range=np.array([e.free for e in entries]),
            detections=_starts([len(d.cluster) for d in found]),
            centre=np.concatenate([d.centre for d in found]),
            spread=np.concatenate([d.covariance for d in found]),
            eccentricity=np.concatenate([d.eccentricity for d in found]),
            radius=np.concatenate([d.radius for d in found]),
            radius_sigma=np.concatenate([d.radius_sigma for d in found]),
            arc=np.concatenate([d.arc for d in found]),
            height=np.concatenate([_heights(e) for e in entries]),
            landmarks=_starts([len(e.landmarks[0]) for e in entries]),
            place=np.concatenate([e.landmarks[0] for e in entries]),
            place_covariance=np.concatenate([e.landmarks[1] for e in entries]),
            gathered=np.array([e.columns is not None for e in entries]),
            columns=_starts([0 if e.columns is None else len(e.columns.forced) for e in entries]),
            axis=columns.place,
            votes=columns.votes,
        )
        usual = np.array([e.is_usual for e in entries])
        return cls(recorded, columns, np.array([e.offset for e in entries]), usual)

    def first(self, scans: int) -> Stretch:
        """So many scans; nothing is copied."""
        r = self.recorded
        detections, landmarks, columns = (int(s[scans]) for s in (r.detections, r.landmarks, r.columns))
        rows = {"place": landmarks, "place_covariance": landmarks, "axis": columns, "votes": columns}
        starts = ("detections", "landmarks", "columns")
        of_scans = {"stamp_ns", "pose", "covariance", "relative", "clear_range", "gathered"}
        cut = Recorded._make(
            column[
                : scans + 1 if name in starts else scans if name in of_scans else rows.get(name, detections)
            ]
            for name, column in r._asdict().items()
        )
        judged = Judged(*(getattr(self.judged, f.name)[:columns] for f in fields(Judged)))
        return Stretch(cut, judged, self.offset[:scans], self.is_usual[:scans])

    def newest_columns(self) -> Judged | None:
        """Of the last scan that was gathered."""
        gathered = np.flatnonzero(self.recorded.gathered)
        if not len(gathered):
            return None
        rows = slice(*self.recorded.columns[gathered[-1] : gathered[-1] + 2].tolist())
        return Judged(*(getattr(self.judged, f.name)[rows] for f in fields(Judged)))


@dataclass(frozen=True, slots=True, eq=False)
class Notes:
    """Of the scans of a run from its first on."""

    stretches: tuple[Stretch, ...] = ()

    def __len__(self) -> int:
        return sum(map(len, self.stretches))

    @property
    def nbytes(self) -> int:
        """Of all columns."""
        return sum(stretch.nbytes for stretch in self.stretches)

    @property
    def offset(self) -> Float:
        """The sensor in the base frame, shape (N, 3) [m]."""
        return np.concatenate([np.zeros((0, 3)), *(stretch.offset for stretch in self.stretches)])

    @property
    def is_usual(self) -> Bool:
        """See `Noted`, shape (N,)."""
        return np.concatenate([np.zeros(0, np.bool_), *(stretch.is_usual for stretch in self.stretches)])

    def with_more(self, stretch: Stretch) -> Notes:
        """With the scans that follow."""
        return Notes((*self.stretches, stretch))

    def first(self, scans: int) -> Notes:
        """Of the first scans, or as many as there are; nothing is copied."""
        kept: list[Stretch] = []
        left = scans
        for stretch in self.stretches:
            if left <= 0:
                break
            kept.append(stretch if left >= len(stretch) else stretch.first(left))
            left -= len(stretch)
        return Notes(tuple(kept))

    def newest_columns(self) -> Judged | None:
        """Of the last scan that was gathered; None where none was."""
        known = (stretch.newest_columns() for stretch in reversed(self.stretches))
        return next((columns for columns in known if columns is not None), None)


_NO_ROWS = np.zeros(0, np.int32)
_NO_COLUMNS = Judged(np.zeros((0, 2)), np.zeros((0, 6)), _NO_ROWS, _NO_ROWS)


def _starts(rows: Sequence[int]) -> Int:
    starts = np.zeros(len(rows) + 1, np.int64)
    np.cumsum(rows, out=starts[1:])
    return starts


def _heights(entry: Entry) -> Float:
    return np.full(len(entry.detections.cluster), np.nan) if entry.heights is None else entry.heights
