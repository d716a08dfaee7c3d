"""What is kept of each tree: columns that grow, and what one more observation adds to them."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.geometry import Float
from pipeline.records import Int


@dataclass(slots=True, eq=False)
class TrackTable:
    """Columns of length T.

    Attributes:
        number: int64, in the order of first sight, never used twice.
        x: shape (T, 4): x, y [m], vx, vy [m/s]; P: its covariance, shape (T, 4, 4).
        shared: What of P the poses have done that the tree was seen from, shape (T, 2, 2) [m^2].
        stamp_ns: int64, of `x` and of the last observation; first_ns: of the first.
        hits: int64, observations; score: hits less misses.
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

    def take(self, rows: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> TrackTable:
        """The rows where the mask holds."""
        return TrackTable(*(getattr(self, f.name)[rows] for f in fields(self)))

    def with_score(self) -> TrackTable:
        """The rows that have any score left; itself where all have."""
        standing = self.score > 0.0
        return self if standing.all() else self.take(standing)

    def extended(self, more: TrackTable) -> TrackTable:
        """These rows and then the others."""
        return TrackTable(
            *(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self))
        )
