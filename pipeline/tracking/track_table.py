"""The table of tracks: one row per tree."""

from __future__ import annotations

from dataclasses import dataclass, fields
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Int, Verdict

NO_LANDMARK = -1


class ScanPose(NamedTuple):
    """Pose of the robot at a scan.

    Attributes:
        stamp_ns: Time of the scan [ns].
        pose: x, y [m], yaw [rad] in the frame of the map, shape (3,).
        covariance: Covariance of the pose in the frame of the map, shape (3, 3).
        relative: Covariance of the pose relative to the landmarks around the robot, frame of the map, shape
            (3, 3).
    """

    stamp_ns: int
    pose: Float
    covariance: Float
    relative: Float


@dataclass(slots=True, eq=False)
class TrackTable:
    """Tracks, one row per tree; all columns have the length T.

    Attributes:
        number: Number of the tree, int64, ascending; a number is never reused.
        landmark: Birth number of the landmark of the tree, int64; -1 for a tree that only a voxel column
            supports.
        x: State x, y [m], vx, vy [m/s] in the map, shape (T, 4).
        P: Covariance of the state, shape (T, 4, 4).
        shared: Part of P that comes from the poses of the robot, shape (T, 2, 2) [m^2].
        stamp_ns: Time of the last observation [ns], int64.
        first_ns: Time of the first observation [ns], int64.
        hits: Number of observations, int64, see `Trees`.
        score: Score of the landmark: hits minus misses, see `Landmarks`.
        eccentricity: Sum of the finite eccentricities of the observations.
        eccentricities: Number of finite eccentricities, int64.
        radius: Sum of weights times radii [1/m^3].
        radius_weight: Sum of weights (see `add_observations`) [1/m^4].
        radius_reach: Sum of weights times distances of the sensor [1/m^3].
        radius_spacing: Sum of weights times distances between neighbouring returns [1/m^3].
        radius_above: Sum of weights times distances from breast height [1/m^3].
        radii: Number of summed radii, int64.
        sides: Observed sectors, int64; bit k is set when sector k around the trunk was observed.
        verdict: Class of the voxel column of the tree, see `Verdict`, int64; -1 for unknown.
    """

    number: Int
    landmark: Int
    x: Float
    P: Float
    shared: Float
    stamp_ns: Int
    first_ns: Int
    hits: Int
    score: Float
    eccentricity: Float
    eccentricities: Int
    radius: Float
    radius_weight: Float
    radius_reach: Float
    radius_spacing: Float
    radius_above: Float
    radii: Int
    sides: Int
    verdict: Int

    @classmethod
    def empty(cls, rows: int = 0) -> TrackTable:
        """Return rows of zeros, with the score 1 and without landmark and class (-1)."""
        floats, ints = np.zeros(rows), np.zeros(rows, np.int64)
        return cls(
            number=ints.copy(),
            landmark=np.full(rows, NO_LANDMARK),
            x=np.zeros((rows, 4)),
            P=np.zeros((rows, 4, 4)),
            shared=np.zeros((rows, 2, 2)),
            stamp_ns=ints.copy(),
            first_ns=ints.copy(),
            hits=ints.copy(),
            score=np.ones(rows),
            eccentricity=floats.copy(),
            eccentricities=ints.copy(),
            radius=floats.copy(),
            radius_weight=floats.copy(),
            radius_reach=floats.copy(),
            radius_spacing=floats.copy(),
            radius_above=floats.copy(),
            radii=ints.copy(),
            sides=ints.copy(),
            verdict=np.full(rows, -1, np.int64),
        )

    @classmethod
    def begun(
        cls,
        number: int,
        stamp_ns: int,
        position: Float,
        own: Float,
        shared: Float,
        velocity_sigma: float,
    ) -> TrackTable:
        """Return K new tracks without observations (hits 0), landmark and class, with the score 1 and
        consecutive numbers.

        Args:
            number: Number of the first track.
            stamp_ns: Time of the scan [ns].
            position: Positions in the map, shape (K, 2) [m].
            own: Covariances of the measurements, shape (K, 2, 2) [m^2].
            shared: Covariances that the pose adds, shape (K, 2, 2) [m^2].
            velocity_sigma: Standard deviation of the velocities [m/s].
        """
        t = cls.empty(len(position))
        t.number[:] = number + np.arange(len(t))
        t.x[:, :2] = position
        t.P[:, :2, :2] = own + shared
        t.P[:, 2, 2] = t.P[:, 3, 3] = velocity_sigma**2
        t.shared[:] = shared
        t.stamp_ns[:] = t.first_ns[:] = stamp_ns
        return t

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.number)

    def copy(self) -> TrackTable:
        """Return an independent copy."""
        return TrackTable(*(column.copy() for column in _columns(self)))

    def take(self, rows: Bool) -> TrackTable:
        """Return copies of the rows where the mask, shape (T,), is true."""
        return TrackTable(*(column[rows] for column in _columns(self)))

    def extended(self, more: TrackTable) -> TrackTable:
        """Return the rows of this table followed by those of `more`, as copies. The caller keeps the numbers
        ascending."""
        pairs = zip(_columns(self), _columns(more), strict=True)
        return TrackTable(*map(np.concatenate, pairs))

    def as_rows(self) -> Rows:
        """Return the same arrays for compiled code, without copies: kernels change this table in place."""
        return Rows(*_columns(self))


#: Returns all columns of a TrackTable; `fields` at each call takes longer than the kernels.
_columns = attrgetter(*(f.name for f in fields(TrackTable)))


class Rows(NamedTuple):
    """The columns of a `TrackTable` for compiled code."""

    number: Int
    landmark: Int
    x: Float
    P: Float
    shared: Float
    stamp_ns: Int
    first_ns: Int
    hits: Int
    score: Float
    eccentricity: Float
    eccentricities: Int
    radius: Float
    radius_weight: Float
    radius_reach: Float
    radius_spacing: Float
    radius_above: Float
    radii: Int
    sides: Int
    verdict: Int


_SUMS = (
    "hits", "eccentricity", "eccentricities", "radius", "radius_weight", "radius_reach", "radius_spacing",
    "radius_above", "radii",
)  # fmt: skip


def join(tracks: TrackTable, old: int, young: int) -> None:
    """Join the track of row `young` to that of row `old`, in place.

    The track whose landmark has the larger score (`old` for equal scores) gives landmark, state, covariance
    and time of the last observation. A track without a landmark gives them only if neither has one and it is
    `old`. The larger score and the earlier first observation are kept. Counts and sums are added; in `hits`,
    a last scan that observed both counts once. The class is tree if one is a tree, else that of `old`, or
    that of `young` if `old` has none. The row `old` keeps its number. The row `young` stays unchanged; the
    caller removes it.
    """
    # Two parts of one trunk in the last scan count once; earlier scans with both parts count twice.
    if tracks.stamp_ns[old] == tracks.stamp_ns[young] and min(tracks.hits[old], tracks.hits[young]) > 0:
        tracks.hits[old] -= 1
    tracks.first_ns[old] = min(tracks.first_ns[old], tracks.first_ns[young])
    tracks.sides[old] |= tracks.sides[young]
    # A track without class does not change the class of the other one.
    if tracks.verdict[young] == Verdict.TREE or tracks.verdict[old] < 0:
        tracks.verdict[old] = tracks.verdict[young]
    if tracks.landmark[young] != NO_LANDMARK and (
        tracks.landmark[old] == NO_LANDMARK or tracks.score[young] > tracks.score[old]
    ):
        for name in ("landmark", "x", "P", "shared", "stamp_ns"):
            getattr(tracks, name)[old] = getattr(tracks, name)[young]
    tracks.score[old] = max(tracks.score[old], tracks.score[young])
    for name in _SUMS:
        getattr(tracks, name)[old] += getattr(tracks, name)[young]
