"""Comparison of two maps of one stand: alignment by their stems, growth, new, missing and moved trees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pipeline.evaluation import fit_rigid, match
from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import Bool, Int

FALSE_DISCOVERIES = 0.05  # expected share of trees with false growth among those with significant growth
MOVED_SIGMAS, MOVED_MIN = 4.0, 0.15  # robust standard deviations, m
_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class VisitTrees:
    """The trees of a visit; columns of length T.

    Attributes:
        number: Number of the tree in the map of this visit, int64.
        position: Positions x, y in the frame of this visit, shape (T, 2) [m].
        sigma: Standard deviation of a coordinate of the position, shape (T,) [m].
        dbh, dbh_sigma: Diameters at breast height and their standard deviations, shape (T,) [m]; NaN if
            unknown.
    """

    number: Int
    position: Float
    sigma: Float
    dbh: Float
    dbh_sigma: Float


@dataclass(frozen=True, slots=True, eq=False)
class VisitComparison:
    """Two maps of one stand, a the earlier one.

    Attributes:
        T_a_b: Pose of the frame of b in that of a.
        b_of: Row of b of each tree of a, -1 for none, int64.
        reach: Maximum distance of a pair [m].
        stems: Number of stems that agreed in the alignment; 0 if the frames were taken as equal.
        shift: Distance of the two positions of each pair, in the order of a, shape (P,) [m].
        growth, growth_sigma: Diameter in b minus that in a, and its standard deviation, shape (P,) [m]; NaN
            if unknown.
        significant: Whether the growth of a pair is significant: at most the share FALSE_DISCOVERIES of these
            pairs is expected to be false (Benjamini and Hochberg 1995), shape (P,). False where growth or
            sigma is unknown, or sigma is 0.
        moved: Whether the positions of a pair differ by more than MOVED_SIGMAS standard deviations and
            MOVED_MIN, shape (P,).
    """

    T_a_b: Pose2
    b_of: Int
    reach: float
    stems: int
    shift: Float
    growth: Float
    growth_sigma: Float
    significant: Bool
    moved: Bool


def compare_visits(
    a: VisitTrees, b: VisitTrees, T_a_b: Pose2, *, reach: float, refine: bool, stems: int = 0
) -> VisitComparison:
    """Pair the trees of two maps one to one (`match`) and compare them. Trees without a finite position
    have no partner.

    Args:
        a, b: The visits.
        T_a_b: Pose of the frame of b in that of a.
        reach: Maximum distance of the two positions of a pair [m].
        refine: Whether the pose is fitted again to the pairs, without outliers; with fewer than three pairs
            it is unchanged.
        stems: Number of stems that agreed in the alignment, for the result.
    """
    for _ in range(_ROUNDS if refine else 0):
        rows_a, rows_b = _pairs(match(a.position, T_a_b.apply(b.position), reach))
        if len(rows_a) < 3:
            break
        off = np.hypot(*(a.position[rows_a] - T_a_b.apply(b.position[rows_b])).T)
        near = off <= max(2.5 * float(np.median(off)), 0.02)
        T_a_b = fit_rigid(b.position[rows_b[near]], a.position[rows_a[near]])
    b_of = match(a.position, T_a_b.apply(b.position), reach)
    rows_a, rows_b = _pairs(b_of)
    difference = T_a_b.apply(b.position[rows_b]) - a.position[rows_a]
    shift = np.hypot(*difference.T)
    growth = b.dbh[rows_b] - a.dbh[rows_a]
    sigma = np.hypot(b.dbh_sigma[rows_b], a.dbh_sigma[rows_a])
    # 1.177 sigma is the median of the length of a vector with two normal coordinates.
    typical = float(np.median(shift)) / 1.177 if len(shift) else 0.0
    own = np.hypot(a.sigma[rows_a], b.sigma[rows_b])
    limit = np.maximum(MOVED_SIGMAS * np.maximum(typical, own), MOVED_MIN)
    significant = _significant(growth, sigma)
    return VisitComparison(T_a_b, b_of, reach, stems, shift, growth, sigma, significant, shift > limit)


def _pairs(b_of: Int) -> tuple[Int, Int]:
    rows = np.flatnonzero(b_of >= 0)
    return rows, b_of[rows]


def _significant(growth: Float, sigma: Float) -> Bool:
    from scipy.special import erfc
    from scipy.stats import false_discovery_control

    known = np.isfinite(growth) & (sigma > 0.0)
    result = np.zeros(len(growth), np.bool_)
    if known.any():
        p = erfc(np.abs(growth[known] / sigma[known]) / math.sqrt(2.0))
        result[known] = false_discovery_control(p) <= FALSE_DISCOVERIES
    return result


def with_known_sigma(visit: VisitTrees, dbh_sigma: float) -> VisitTrees:
    """Return a visit in which a diameter without a standard deviation has `dbh_sigma` [m]."""
    unknown = np.isfinite(visit.dbh) & ~np.isfinite(visit.dbh_sigma)
    return replace(visit, dbh_sigma=np.where(unknown, dbh_sigma, visit.dbh_sigma))
