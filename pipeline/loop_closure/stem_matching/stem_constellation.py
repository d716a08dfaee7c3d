"""Stems as the matching of constellations uses them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Int, Trees


@dataclass(frozen=True, slots=True, eq=False)
class MapStems:
    """Columns of N stems in the frame of one map.

    Attributes:
        position: shape (N, 2) [m].
        sigma: Standard deviation of a position in its worst direction, shape (N,) [m].
        dbh: Diameter at breast height, shape (N,) [m]; NaN if unknown.
        dbh_sigma: Its standard deviation, shape (N,) [m]; NaN if unknown.
    """

    position: Float
    sigma: Float
    dbh: Float
    dbh_sigma: Float

    def __len__(self) -> int:
        """Return the number of stems."""
        return len(self.position)

    @classmethod
    def at(cls, position: Float, sigma: float = 0.05) -> MapStems:
        """Return stems of unknown diameter at positions of shape (N, 2) [m], all with the same sigma [m]."""
        n = len(position)
        unknown = np.full(n, np.nan)
        return cls(np.asarray(position, np.float64).reshape(n, 2), np.full(n, sigma), unknown, unknown)

    @classmethod
    def of_trees(cls, trees: Trees) -> MapStems:
        """Return the confirmed trees of a map. Their order is kept."""
        kept = trees.confirmed
        unknown = np.isnan(trees.dbh[kept])
        return cls(
            trees.position[kept],
            worst_sigma(trees.covariance[kept][:, [0, 0, 1], [0, 1, 1]]),
            trees.dbh[kept],
            np.where(unknown, np.nan, trees.dbh_sigma[kept]),
        )

    def usable(self) -> Bool:
        """Return which stems have a finite position and a finite sigma that is not negative, shape (N,)."""
        finite: Bool = np.isfinite(self.position).all(axis=1) & np.isfinite(self.sigma) & (self.sigma >= 0.0)
        return finite

    def take(self, rows: Int | Bool) -> MapStems:
        """Return the stems of some rows, by row numbers or by a mask of shape (N,)."""
        return MapStems(self.position[rows], self.sigma[rows], self.dbh[rows], self.dbh_sigma[rows])


def worst_sigma(covariance: Float) -> Float:
    """Return the larger standard deviation of covariances xx, xy, yy, shape (N, 3) -> (N,) [m]."""
    xx, xy, yy = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    largest: Float = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(largest, 0.0))
