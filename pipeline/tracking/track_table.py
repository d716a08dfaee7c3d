"""What is kept of each tree: columns that grow, and what one more observation adds to them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.jit import compiled_borrowing
from pipeline.types.records import Bool, Int


@dataclass(slots=True, eq=False)
class TrackTable:
    """Columns of length T.

    Attributes:
        number: int64, in the order of first sight, never used twice.
        x: shape (T, 4): x, y [m], vx, vy [m/s]; P: its covariance, shape (T, 4, 4).
        shared: What of P the poses have done that the tree was seen from, shape (T, 2, 2) [m^2].
        stamp_ns: int64, of `x` and of the last observation; first_ns: of the first.
        hits: int64, observations, see `Trees`; score: hits less misses.
        eccentricity: Sum over the observations with a finite one; eccentricities: their number.
        radius: Sum of weights times radii; radius_weight: sum of weights (see `add_observations`) [1/m^4];
            radius_reach: sum of weights times distances; radius_above: of weights times how far
            above or below breast height [m]; radii: number of them.
        sides: int64: bit k is set when the sector k around the trunk was seen.
        verdict: int64: what was gathered says of it, see Verdict; -1 for nothing.
    """

    number: Int
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
    radius_above: Float
    radii: Int
    sides: Int
    verdict: Int

    @classmethod
    def empty(cls, rows: int = 0) -> TrackTable:
        """Rows of zeros."""
        floats, ints = np.zeros(rows), np.zeros(rows, np.int64)
        return cls(
            number=ints.copy(),
            x=np.zeros((rows, 4)),
            P=np.zeros((rows, 4, 4)),
            shared=np.zeros((rows, 2, 2)),
            stamp_ns=ints.copy(),
            first_ns=ints.copy(),
            hits=ints.copy(),
            score=floats.copy(),
            eccentricity=floats.copy(),
            eccentricities=ints.copy(),
            radius=floats.copy(),
            radius_weight=floats.copy(),
            radius_reach=floats.copy(),
            radius_above=floats.copy(),
            radii=ints.copy(),
            sides=ints.copy(),
            verdict=np.full(rows, -1, np.int64),
        )

    def __len__(self) -> int:
        return len(self.number)

    def copy(self) -> TrackTable:
        """An independent copy."""
        return TrackTable(*(getattr(self, f.name).copy() for f in fields(self)))

    def take(self, rows: Bool) -> TrackTable:
        """The rows where the mask holds."""
        return TrackTable(*(getattr(self, f.name)[rows] for f in fields(self)))

    def extended(self, more: TrackTable) -> TrackTable:
        """These rows and then the others."""
        return TrackTable(
            *(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self))
        )

    def as_rows(self) -> Rows:
        """The same columns."""
        return Rows(*(getattr(self, f.name) for f in fields(self)))

    def with_room(self, room: int) -> Rows:
        """A copy with room for so many rows, at least as many as there are."""
        rows = self.as_rows()
        wide = Rows(*(np.empty((room, *column.shape[1:]), column.dtype) for column in rows))
        for into, column in zip(wide, rows, strict=True):
            into[: len(self)] = column
        return wide


class Rows(NamedTuple):
    """The columns of a `TrackTable`, of which the first rows are trees and the others room for more."""

    number: Int
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
    radius_above: Float
    radii: Int
    sides: Int
    verdict: Int

    def first(self, count: int) -> TrackTable:
        """So many rows, which are not copied."""
        return TrackTable(**{name: column[:count] for name, column in self._asdict().items()})


@compiled_borrowing
def begin(
    rows: Rows,
    count: int,
    number: int,
    stamp_ns: int,
    z: Float,
    R: Float,
    B: Float,
    velocity_sigma: float,
) -> None:
    """New trees behind the first rows, for which there is room, none of them seen yet.

    Args:
        number: Of the first one.
        z: Places, shape (K, 2) [m]; R: their own covariances, shape (K, 2, 2); B: what the pose adds.
    """
    for k in range(z.shape[0]):
        t = count + k
        rows.number[t] = number + k
        rows.x[t, 0], rows.x[t, 1], rows.x[t, 2], rows.x[t, 3] = z[k, 0], z[k, 1], 0.0, 0.0
        for a in range(4):
            for b in range(4):
                rows.P[t, a, b] = 0.0
        for a in range(2):
            for b in range(2):
                rows.P[t, a, b] = R[k, a, b] + B[k, a, b]
                rows.shared[t, a, b] = B[k, a, b]
        rows.P[t, 2, 2] = rows.P[t, 3, 3] = velocity_sigma**2
        rows.stamp_ns[t] = rows.first_ns[t] = stamp_ns
        rows.hits[t], rows.score[t] = 0, 1.0
        rows.eccentricity[t], rows.eccentricities[t] = 0.0, 0
        rows.radius[t], rows.radius_weight[t], rows.radius_reach[t] = 0.0, 0.0, 0.0
        rows.radius_above[t], rows.radii[t] = 0.0, 0
        rows.sides[t], rows.verdict[t] = 0, -1


@compiled_borrowing
def keep(rows: Rows, kept: Bool) -> int:
    """Let the kept ones of the first rows, shape (T,), move together in their order; returns their number."""
    n = 0
    for t in range(kept.shape[0]):
        if not kept[t]:
            continue
        if n < t:
            rows.number[n] = rows.number[t]
            for a in range(4):
                rows.x[n, a] = rows.x[t, a]
                for b in range(4):
                    rows.P[n, a, b] = rows.P[t, a, b]
            for a in range(2):
                for b in range(2):
                    rows.shared[n, a, b] = rows.shared[t, a, b]
            rows.stamp_ns[n], rows.first_ns[n] = rows.stamp_ns[t], rows.first_ns[t]
            rows.hits[n], rows.score[n] = rows.hits[t], rows.score[t]
            rows.eccentricity[n], rows.eccentricities[n] = rows.eccentricity[t], rows.eccentricities[t]
            rows.radius[n], rows.radius_weight[n] = rows.radius[t], rows.radius_weight[t]
            rows.radius_reach[n], rows.radius_above[n] = rows.radius_reach[t], rows.radius_above[t]
            rows.radii[n], rows.sides[n] = rows.radii[t], rows.sides[t]
            rows.verdict[n] = rows.verdict[t]
        n += 1
    return n
