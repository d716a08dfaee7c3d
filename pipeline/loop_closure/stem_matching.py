"""Global matching of a constellation of stems with a map, without an initial pose: the pose with its
covariance, or the reason of a refusal.

Hypotheses of a pose align each pair of local stems with each pair of the map of equal length; the pairs of
the map are sorted by length. Each hypothesis is verified by the number of other stems that find a partner.
The search covers the whole map, so that the second best pose is known as well.

A wrong loop makes a map useless, whereas a missed loop has little effect. A pose is accepted only if (1)
enough stems agree, (2) so many would not agree by chance, by the number of false alarms of the a contrario
method (Desolneux, Moisan, Morel 2000), (3) no other pose explains nearly as many, as in the regular grid of a
plantation, and (4) the stems that agree determine the pose well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from pipeline.config.stages import Relocalisation
from pipeline.geometry.ordering import ascending_rows
from pipeline.geometry.poses import Float, Pose2
from pipeline.jit import compiled
from pipeline.slam.places import AGREEING, WINDOW
from pipeline.types.records import Bool, Int, Int32, Trees

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

KEPT = 48  # hypotheses that are refined
MOST_CELLS = 1_000_000
BINS = 256  # bins of the lengths of pairs, by which the longest are omitted if there are too many
DBH_SLACK = 0.05  # m; difference of diameters by another height, season or instrument
#: Number of local stems nearest to a base pair that are compared first, and how many of them must agree. With
#: the share AGREEING, fewer than 3 of 12 agree at a true pose in 8 % of the cases; other pairs find it then.
NEIGHBOURS, NEIGHBOURS_LEAST = 12, 3


@compiled
def pairs_within(position: Float, shortest: float, longest: float, most: int) -> tuple[Int32, Float]:
    """Return the pairs of stems with a distance in [shortest, longest), sorted by distance: rows, int32,
    shape (K, 2), and lengths, shape (K,) [m].

    Args:
        position: Stems, shape (N, 2) [m].
        shortest, longest: Bounds of the distance [m].
        most: Maximum number of pairs. Of more pairs the longest are omitted, in whole bins of length.
    """
    order = ascending_rows(position[:, 0].copy())
    bins = np.zeros(BINS, np.int64)
    nothing, no_length = np.empty((0, 2), np.int32), np.empty(0)
    _walk_pairs(position, order, shortest, longest, bins, BINS, nothing, no_length)
    total, taken = 0, 0
    while taken < BINS and total + bins[taken] <= most:
        total += bins[taken]
        taken += 1
    row, length = np.empty((total, 2), np.int32), np.empty(total)
    bins[:] = 0
    _walk_pairs(position, order, shortest, longest, bins, taken, row, length)
    by_length = ascending_rows(length)
    return row[by_length], length[by_length]


@compiled
def _walk_pairs(
    position: Float, order: Int, shortest: float, longest: float,
    bins: Int, taken: int, row: Int32, length: Float,
) -> None:  # fmt: skip
    """Count the pairs by bins of their length, and write those of the first `taken` bins as far as there is
    room.

    Args:
        position: Stems, shape (N, 2) [m].
        order: Rows of the stems by ascending x.
        shortest, longest: Bounds of the distance [m].
        bins: Number of pairs per bin, shape (BINS,); increased.
        taken: Number of bins whose pairs are written.
        row, length: Filled with rows, int32, shape (K, 2), and lengths, shape (K,) [m], in the order of
            `order`.
    """
    n = 0
    for a in range(order.shape[0]):
        i = order[a]
        for b in range(a + 1, order.shape[0]):
            j = order[b]
            dx, dy = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1]
            if dx > longest:
                break
            d = np.sqrt(dx * dx + dy * dy)
            if not shortest <= d < longest:
                continue
            at = min(int((d - shortest) / (longest - shortest) * BINS), BINS - 1)
            bins[at] += 1
            if at < taken and n < row.shape[0]:
                row[n, 0], row[n, 1], length[n] = i, j, d
                n += 1


def cells_of(position: Float, cell: float) -> tuple[Float, Int32, Int32]:
    """Return a grid over stems, shape (N, 2) [m], N > 0: low corner x, y and cell size, shape (3,) [m]; first
    stem of each cell, int32, shape (W, H); and next stem in the same cell of each stem, int32, shape (N,); -1
    if there is none. The cell is doubled from `cell` [m] until at most MOST_CELLS are needed."""
    low, extent = position.min(axis=0), np.ptp(position, axis=0)
    while np.prod(np.floor(extent / cell) + 1.0) > MOST_CELLS:
        cell *= 2.0
    width, height = (np.floor(extent / cell) + 1.0).astype(np.int64).tolist()
    column, row = ((position - low) / cell).astype(np.int64).T
    cells = column * height + row
    order = np.argsort(cells, kind="stable")
    is_first = np.append(True, np.diff(cells[order]) > 0)
    first, following = np.full(width * height, -1, np.int32), np.full(len(position), -1, np.int32)
    first[cells[order[is_first]]] = order[is_first]
    following[order[:-1]] = np.where(is_first[1:], -1, order[1:])
    return np.array([*low, cell]), first.reshape(width, height), following


@compiled
def nearest(
    x: float, y: float, reach: float, position: Float, grid: Float, first: Int32, following: Int32
) -> tuple[int, float]:
    """Return row and squared distance [m^2] of the nearest stem nearer than a reach; row -1 and an undefined
    distance if there is none.

    Args:
        x, y: Position [m].
        reach: Maximum distance [m], at most one cell.
        position: Stems, shape (N, 2) [m].
        grid, first, following: See `cells_of`.
    """
    best, best2 = -1, reach * reach
    fa, fb = np.floor((x - grid[0]) / grid[2]), np.floor((y - grid[1]) / grid[2])
    if not (-2.0 < fa < first.shape[0] + 1.0 and -2.0 < fb < first.shape[1] + 1.0):
        return -1, 0.0
    ia, ib = int(fa), int(fb)
    for a in range(max(ia - 1, 0), min(ia + 2, first.shape[0])):
        for b in range(max(ib - 1, 0), min(ib + 2, first.shape[1])):
            j = first[a, b]
            while j >= 0:
                dx, dy = position[j, 0] - x, position[j, 1] - y
                if dx * dx + dy * dy < best2:
                    best, best2 = int(j), dx * dx + dy * dy
                j = following[j]
    return best, best2


@compiled
def alike(dbh: float, sigma: float, other: float, other_sigma: float) -> bool:
    """Return whether two diameters [m] may be of the same stem: their difference is at most three sigma, with
    DBH_SLACK added. An unknown diameter (NaN or not positive) fits any other; an unknown sigma counts as 0.
    """
    if not (dbh > 0.0 and other > 0.0):
        return True
    slack = DBH_SLACK * DBH_SLACK + (sigma * sigma if sigma > 0.0 else 0.0)
    slack += other_sigma * other_sigma if other_sigma > 0.0 else 0.0
    return bool((dbh - other) ** 2 <= 9.0 * slack)


@compiled
def search(
    local: Float, local_sigma: Float, local_dbh: Float, local_dbh_sigma: Float, base: Int32,
    reference: Float, sigma: Float, dbh: Float, dbh_sigma: Float, pair: Int32, length: Float,
    grid: Float, first: Int32, following: Int32,
    slack: float, reach: float, least: int, most: int,
) -> tuple[Float, Int, int]:  # fmt: skip
    """Align each base pair with all pairs of the map of equal length, and count the stems that agree.

    The NEIGHBOURS stems nearest to the base pair are compared first. There, the error of the heading moves a
    stem little, so that few stems agree by chance. A hypothesis is dropped if fewer than NEIGHBOURS_LEAST of
    them agree. At the edge of the map this drops true poses of some pairs as well, but not of all.

    Args:
        local: Positions of the local stems relative to their mean, shape (L, 2) [m].
        local_sigma, local_dbh, local_dbh_sigma: Other columns of the local stems, shape (L,), see `MapStems`.
        base: Pairs of local rows, int32, shape (B, 2).
        reference: Positions of the stems of the map, shape (N, 2) [m], N > 0.
        sigma, dbh, dbh_sigma: Other columns of the stems of the map, shape (N,).
        pair, length: Pairs of the map, see `pairs_within`.
        slack: Standard deviation of the deformation of a map within a constellation [m].
        reach: Maximum distance of two stems that agree [m], at most one cell of the grid.
        least: Hypotheses with fewer stems in agreement are dropped.
        most: Number of hypotheses after which no further base pair is tried.
        grid, first, following: Grid of the map, see `cells_of`.

    Returns:
        The best distinct poses x, y [m], yaw [rad], shape (K, 3), at most KEPT, in no particular order; the
        number of stems that agree in each, int64, shape (K,); and the number of hypotheses.
    """
    pose = np.empty((KEPT, 3))
    agree = np.zeros(KEPT, np.int64)
    kept, looked, floor = 0, 0, least
    count = local.shape[0]
    for k in range(base.shape[0]):
        i, j = base[k, 0], base[k, 1]
        bx, by = local[j, 0] - local[i, 0], local[j, 1] - local[i, 1]
        span = np.sqrt(bx * bx + by * by)
        bearing = np.arctan2(by, bx)
        if looked >= most:
            break
        mx, my = 0.5 * (local[i, 0] + local[j, 0]), 0.5 * (local[i, 1] + local[j, 1])
        distance2 = (local[:, 0] - mx) ** 2 + (local[:, 1] - my) ** 2
        distance2[i] = distance2[j] = -1.0  # the pair comes first
        by_distance = ascending_rows(distance2)
        variance = local_sigma[i] ** 2 + local_sigma[j] ** 2 + 2.0 * slack * slack
        widest = 3.0 * np.sqrt(variance + 2.0 * sigma.max() ** 2)
        at = np.searchsorted(length, span - widest)
        while at < length.shape[0] and length[at] <= span + widest:
            a0, b0 = pair[at, 0], pair[at, 1]
            v = variance + sigma[a0] ** 2 + sigma[b0] ** 2
            off = length[at] - span
            at += 1
            if off * off > 9.0 * v:
                continue
            for turned in range(2):
                a, b = (b0, a0) if turned else (a0, b0)
                if not (
                    alike(local_dbh[i], local_dbh_sigma[i], dbh[a], dbh_sigma[a])
                    and alike(local_dbh[j], local_dbh_sigma[j], dbh[b], dbh_sigma[b])
                ):
                    continue
                looked += 1
                rx, ry = reference[b, 0] - reference[a, 0], reference[b, 1] - reference[a, 1]
                yaw = np.arctan2(ry, rx) - bearing
                c, s = np.cos(yaw), np.sin(yaw)
                x = 0.5 * (reference[a, 0] + reference[b, 0]) - c * mx + s * my
                y = 0.5 * (reference[a, 1] + reference[b, 1]) - s * mx - c * my
                found = 0
                for rank in range(count):
                    if found + count - rank < floor:
                        break
                    if rank == 2 + NEIGHBOURS and found < 2 + NEIGHBOURS_LEAST:
                        break
                    m = by_distance[rank]
                    ax, ay = local[m, 0] - mx, local[m, 1] - my
                    lever2 = (ax * ax + ay * ay) / (span * span)
                    tolerance = 2.0 * np.sqrt(local_sigma[m] ** 2 + slack * slack + v * (0.25 + lever2))
                    wx, wy = x + c * local[m, 0] - s * local[m, 1], y + s * local[m, 0] + c * local[m, 1]
                    n, _ = nearest(wx, wy, min(tolerance, reach), reference, grid, first, following)
                    if n >= 0 and alike(local_dbh[m], local_dbh_sigma[m], dbh[n], dbh_sigma[n]):
                        found += 1
                if found >= floor:
                    kept = keep_hypothesis(pose, agree, kept, x, y, yaw, found, reach)
                    # A hypothesis with fewer than half cannot make the best one ambiguous.
                    floor = max(floor, found // 2 + 1)
                    if kept == KEPT:
                        floor = max(floor, int(agree.min()) + 1)
    return pose[:kept], agree[:kept], looked


@compiled
def keep_hypothesis(
    pose: Float, agree: Int, kept: int, x: float, y: float, yaw: float, found: int, reach: float
) -> int:
    """Store a hypothesis; return the number of stored ones. A stored one with the same pose is replaced only
    if it has fewer stems. A new pose is appended; if KEPT are stored, it replaces the one with the fewest
    stems only if that has fewer.

    Args:
        pose, agree: Stored poses, shape (KEPT, 3), and their numbers of stems, shape (KEPT,); changed in
            place.
        kept: Number of stored hypotheses.
        x, y, yaw: Pose of the hypothesis [m, m, rad].
        found: Number of stems that agree.
        reach: Poses within half of it [m] and within 0.05 rad are the same.
    """
    worst = 0
    for k in range(kept):
        dx, dy = pose[k, 0] - x, pose[k, 1] - y
        turn = (pose[k, 2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        if dx * dx + dy * dy < 0.25 * reach * reach and abs(turn) < 0.05:
            if found > agree[k]:
                agree[k] = found
                pose[k, 0], pose[k, 1], pose[k, 2] = x, y, yaw
            return kept
        if agree[k] < agree[worst]:
            worst = k
    if kept < pose.shape[0]:
        worst = kept
        kept += 1
    elif agree[worst] >= found:
        return kept
    agree[worst] = found
    pose[worst, 0], pose[worst, 1], pose[worst, 2] = x, y, yaw
    return kept


@compiled
def partners(
    pose: Float,
    local: Float, local_sigma: Float, local_dbh: Float, local_dbh_sigma: Float,
    reference: Float, sigma: Float, dbh: Float, dbh_sigma: Float,
    grid: Float, first: Int32, following: Int32,
    slack: float, reach: float, of: Int,
) -> int:  # fmt: skip
    """Pair each local stem with the nearest stem of the map within three sigma, one to one; return the number
    of pairs. Of local stems with the same stem of the map, the nearest one gets it and the others none.

    Args:
        pose: x, y [m], yaw [rad] of the local frame in the map, shape (3,).
        local, local_sigma, local_dbh, local_dbh_sigma, reference, sigma, dbh, dbh_sigma: See `search`.
        grid, first, following: Grid of the map, see `cells_of`.
        slack: Standard deviation of the deformation of the map [m].
        reach: Maximum distance of the stems of a pair [m].
        of: Filled with the row of the map of each local stem, -1 for none, int64, shape (L,).
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    distance2 = np.full(local.shape[0], np.inf)
    owner = np.full(reference.shape[0], -1, np.int64)
    found = 0
    for m in range(local.shape[0]):
        of[m] = -1
        wx = pose[0] + c * local[m, 0] - s * local[m, 1]
        wy = pose[1] + s * local[m, 0] + c * local[m, 1]
        n, d2 = nearest(wx, wy, reach, reference, grid, first, following)
        if n < 0 or d2 > 9.0 * (local_sigma[m] ** 2 + sigma[n] ** 2 + slack * slack):
            continue
        if not alike(local_dbh[m], local_dbh_sigma[m], dbh[n], dbh_sigma[n]):
            continue
        rival = owner[n]
        if rival >= 0:
            if distance2[rival] <= d2:
                continue
            of[rival] = -1
            found -= 1
        of[m], owner[n], distance2[m] = n, m, d2
        found += 1
    return found


def crowding(pose: Float, local: Float, reference: Float | cKDTree, window: float) -> tuple[float, int]:
    """Return the density of map stems within `window` of an aligned local stem, mean over all local stems
    [1/m^2], and the number of local stems with at least one map stem within `window`.

    Args:
        pose: x, y [m], yaw [rad] of the local frame in the map, shape (3,).
        local: Local stems, shape (L, 2) [m], L > 0.
        reference: Stems of the map, shape (N, 2) [m], or their tree.
        window: Radius [m].
    """
    from scipy.spatial import cKDTree

    c, s = np.cos(pose[2]), np.sin(pose[2])
    place = local @ np.array([[c, s], [-s, c]]) + pose[:2]
    tree = cKDTree(reference) if isinstance(reference, np.ndarray) else reference
    near = tree.query_ball_point(place, window, return_length=True)
    return float(near.sum() / (len(local) * np.pi * window * window)), int(np.count_nonzero(near))


@dataclass(frozen=True, slots=True, eq=False)
class MapStems:
    """Columns of N stems in the frame of one map.

    Attributes:
        position: Positions x, y, shape (N, 2) [m].
        sigma: Standard deviation of a position in its worst direction, shape (N,) [m].
        dbh: Diameter at breast height, shape (N,) [m]; NaN if unknown.
        dbh_sigma: Standard deviation of the diameter, shape (N,) [m]; NaN if unknown.
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
    """Return the standard deviation in the worst direction, shape (N,) [m], of covariances xx, xy, yy, shape
    (N, 3) [m^2]."""
    xx, xy, yy = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    largest: Float = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(largest, 0.0))


def aligned(local: Float, reference: Float, weight: Float) -> Float:
    """Return the pose T, x, y [m], yaw [rad], shape (3,), that minimises the weighted sum of |reference - T
    local|^2 (Horn 1987, in the plane).

    tan yaw = sum w (l x r) / sum w (l . r) of the points about their weighted means. One pair, or coincident
    points, give the yaw 0.

    Args:
        local, reference: Pairs, shape (M, 2) [m], M > 0.
        weight: Weights of the pairs, shape (M,) [1/m^2].
    """
    total = weight.sum()
    l, r = weight @ local / total, weight @ reference / total  # noqa: E741
    a, b = (local - l) * weight[:, None], reference - r
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([r[0] - c * l[0] + s * l[1], r[1] - s * l[0] - c * l[1], yaw])


def alignment_covariance(pose: Pose2, local: Float, reference: Float, variance: Float) -> Float:
    """Return the covariance of an aligned pose x, y [m], yaw [rad], shape (3, 3): (sum J^T J / variance)^-1
    at the solution.

    It is multiplied by chi^2 per degree of freedom of the residuals if that is above 1.

    Args:
        pose: T_reference_local.
        local, reference: Pairs, shape (M, 2) [m], M >= 2, not all at one position.
        variance: Variance per axis of each difference, shape (M,) [m^2].

    Raises:
        LinAlgError: The pairs do not determine the pose.
    """
    arm = local @ pose.rotation().T
    J = np.zeros((len(arm), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
    information = np.einsum("nki,nkj,n->ij", J, J, 1.0 / variance)
    residual = reference - pose.apply(local)
    chi2 = float(np.sum(residual**2 / variance[:, None]))
    freedom = max(2 * len(arm) - 3, 1)
    covariance: Float = np.linalg.inv(information) * max(chi2 / freedom, 1.0)
    return 0.5 * (covariance + covariance.T)


Refusal = Literal[
    "too few stems", "no agreement", "could be chance", "ambiguous", "most stems disagree", "weakly fixed"
]
# m; distance of pairs of stems: shorter pairs determine the heading poorly, longer ones suffer from drift.
SHORTEST, LONGEST = 2.0, 20.0
MOST_PAIRS = 2_000_000  # pairs of the map
BASE_PAIRS = 150  # pairs of the constellation
GOLDEN = 0.6180339887498949  # golden ratio; its multiples modulo 1 are a low-discrepancy sequence
LEAST = 4  # stems in agreement; hypotheses with fewer are dropped
REACH = 1.0  # m; largest distance of two stems that agree
ROUNDS = 8  # iterations of pairing and alignment
WIDE, WIDE_ROUNDS = 3.0, 2  # factor of the slack in the first iterations, which start from a single pair
FALSE_ALARMS = 1e-4  # expected number of equally good agreements by chance
# The same where the drift bounds the displacement: the trees of a place that is seen again are there, so
# that an agreement is expected, and one of a hundred such decisions may be wrong.
FALSE_ALARMS_NEAR = 1e-2
SECOND_BEST = 0.7  # largest ratio of the agreements of the second best pose and the best one
LEAD = 3  # least difference of their numbers
SIGMA_XY, SIGMA_YAW = 0.5, 0.05  # m, rad; largest standard deviations of the pose


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Result of a search.

    Attributes:
        pose: T_reference_local; None if it was refused or not found.
        covariance: Covariance of x, y [m], yaw [rad], shape (3, 3); zeros if refused.
        reason: Reason of the refusal, or None.
        local, reference: Rows of the stems that agree in the best pose, int64, shape (K,).
        second: Number of stems that agree in the second best pose; 0 if there is none.
        false_alarms: Decimal logarithm of the expected number of equally good agreements by chance; 0 if no
            pose was found.
    """

    pose: Pose2 | None
    covariance: Float
    reason: Refusal | None
    local: Int
    reference: Int
    second: int
    false_alarms: float


def find_constellation(
    local: MapStems, reference: MapStems, parameters: Relocalisation, *, hypotheses: int = 300_000
) -> Match:
    """Return the pose of local stems in a reference map, without an initial pose, or the reason of a refusal.
    Stems whose position or sigma is not finite are ignored; either side may be empty. The rows of the result
    refer to the tables as given; they are filled for a refused pose as well, and empty if no pose is found.

    Args:
        local: Stems in their own frame, for example of the map since the robot was lost.
        reference: Stems in the frame of the map.
        parameters: Parameters of this stage.
        hypotheses: Number of hypotheses after which no further pair of local stems is tried.
    """
    return _matched(local, reference, parameters, hypotheses, None)


def find_displacement(
    local: MapStems, reference: MapStems, parameters: Relocalisation, reach: float
) -> Match:
    """Return the pose of local stems in a reference map from which drift has displaced them by at most a
    distance, or the reason of a refusal; see `find_constellation`.

    A hypothesis moves one local stem to one stem of the map without a rotation. They are few, so that LEAST
    stems suffice.

    Args:
        local: Stems in the frame of the map with the drift.
        reference: Stems in the frame of the map.
        parameters: Parameters of this stage; `stems_min` is not used.
        reach: Largest displacement of a stem [m]; above half the distance between trees it is ambiguous.
    """
    return _matched(local, reference, parameters, 0, reach)


def _matched(
    local: MapStems, reference: MapStems, parameters: Relocalisation, most: int, reach: float | None
) -> Match:
    """Return the result of a search; see `_Search` for `most` and `reach`."""
    rows, map_rows = np.flatnonzero(local.usable()), np.flatnonzero(reference.usable())
    search_ = _Search(local.take(rows), reference.take(map_rows), parameters, most, reach)
    best, second = search_.best_two()
    if best is None:
        none = np.zeros(0, np.int64)
        return Match(None, np.zeros((3, 3)), search_.reason, none, none, 0, 0.0)
    pose, covariance, chance, reason = search_.checked(best, 0 if second is None else second.found)
    at = np.flatnonzero(best.of >= 0)
    return Match(
        pose=pose if reason is None else None,
        covariance=covariance if reason is None else np.zeros((3, 3)),
        reason=reason,
        local=rows[at],
        reference=map_rows[best.of[at]],
        second=0 if second is None else second.found,
        false_alarms=chance,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A refined pose x, y [m], yaw [rad] of the centred local stems in the map, shape (3,); the row of the
    map of each local stem, -1 for none, int64, shape (L,); the number of pairs."""

    pose: Float
    of: Int
    found: int

    def is_same(self, other: _Candidate) -> bool:
        """Return whether more than half of the pairs of this candidate are pairs of `other` too. Both have
        the same local stems."""
        return 2 * int(np.count_nonzero((self.of >= 0) & (self.of == other.of))) > self.found


class _Search:
    """One search. The local stems are centred at their mean, which decouples rotation and translation."""

    def __init__(
        self,
        local: MapStems,
        reference: MapStems,
        parameters: Relocalisation,
        most: int,
        reach: float | None,
    ) -> None:
        """Prepare a search.

        Args:
            local, reference: Usable stems of the constellation and of the map.
            parameters: Parameters of the stage.
            most: Number of hypotheses after which no further pair of local stems is tried.
            reach: Largest displacement of a local stem [m], see `find_displacement`; None for any pose.
        """
        self.reason: Refusal = "too few stems"
        self._p = parameters
        self._mean: Float = local.position.mean(axis=0) if len(local) else np.zeros(2)
        self._local = MapStems(local.position - self._mean, local.sigma, local.dbh, local.dbh_sigma)
        self._reference = reference
        self._most, self._looked = most, 0
        self._reach = reach
        self._least = parameters.stems_min if reach is None else LEAST

    def best_two(self) -> tuple[_Candidate | None, _Candidate | None]:
        """Return the pose in which most stems agree, and the best pose with other pairs (`is_same`), both of
        the local stems about their mean. None for each that does not exist; without the first one, `reason`
        is "too few stems" or "no agreement"."""
        if min(len(self._local), len(self._reference)) < self._least:
            return None, None
        self.reason = "no agreement"
        rough = self._of_pairs() if self._reach is None else self._displaced(self._reach)
        refined = sorted((self._refined(pose) for pose in rough), key=lambda c: -c.found)
        if not refined or refined[0].found < LEAST:
            return None, None
        best = refined[0]
        return best, next((c for c in refined[1:] if not c.is_same(best)), None)

    def _displaced(self, reach: float) -> Float:
        """Return the hypotheses of `find_displacement`, x, y [m], yaw [rad] of the local stems about their
        mean, shape (H, 3)."""
        away = self._reference.position[None] - (self._local.position + self._mean)[:, None]
        away = away[np.hypot(away[..., 0], away[..., 1]) <= reach]
        self._looked = len(away)
        self._grid = cells_of(self._reference.position, REACH)
        return np.column_stack([self._mean + away, np.zeros(len(away))])

    def _of_pairs(self) -> Float:
        """Return the best hypotheses of `find_constellation`, as `_displaced`."""
        local, reference, p = self._local, self._reference, self._p
        base, _ = pairs_within(local.position, SHORTEST, LONGEST, MOST_PAIRS)
        pair, length = pairs_within(reference.position, SHORTEST - 1.0, LONGEST + 1.0, MOST_PAIRS)
        if not len(base) or not len(pair):
            return np.zeros((0, 3))
        self._grid = cells_of(reference.position, REACH)
        rough: Float
        rough, _, self._looked = search(
            *self._columns(local), evenly_ordered(base), *self._columns(reference), pair, length, *self._grid,
            p.slack, REACH, LEAST, self._most,
        )  # fmt: skip
        return rough

    def checked(self, best: _Candidate, second: int) -> tuple[Pose2, Float, float, Refusal | None]:
        """Return the pose T_reference_local, its covariance, shape (3, 3), the decimal logarithm of the false
        alarms, and the reason of a refusal (None for none). `second` is the number of pairs of the second
        best pose, 0 if there is none.

        Raises:
            LinAlgError: The pairs do not determine the pose.
        """
        local, reference = self._local, self._reference
        at = np.flatnonzero(best.of >= 0)
        about_mean = Pose2(*(float(v) for v in best.pose))
        pose = about_mean @ Pose2(-float(self._mean[0]), -float(self._mean[1]))
        to = best.of[at]
        variance = local.sigma[at] ** 2 + reference.sigma[to] ** 2 + self._p.slack**2
        own = local.position[at] + self._mean
        covariance = alignment_covariance(pose, own, reference.position[to], variance)
        density, inside = crowding(best.pose, local.position, reference.position, WINDOW)
        reach2 = 9.0 * (float(np.mean(local.sigma**2) + np.mean(reference.sigma**2)) + self._p.slack**2)
        p = float(1.0 - np.exp(-density * np.pi * min(reach2, REACH**2)))
        chance = _log10_false_alarms(self._looked, len(local) - 2, best.found - 2, p)
        at_mean = alignment_covariance(about_mean, local.position[at], reference.position[to], variance)
        return pose, covariance, chance, self._refusal(best.found, second, chance, inside, at_mean)

    def _refusal(
        self, found: int, second: int, chance: float, inside: int, covariance: Float
    ) -> Refusal | None:
        """Return the reason of a refusal; None if the pose is accepted. The first condition that fails
        decides.

        Args:
            found: Number of pairs of the best pose.
            second: Number of pairs of the second best pose.
            chance: Decimal logarithm of the false alarms.
            inside: Number of local stems with a stem of the map within WINDOW.
            covariance: Covariance of the pose at the mean of the local stems, shape (3, 3).
        """
        if found < self._least:
            return "too few stems"
        if chance > np.log10(FALSE_ALARMS if self._reach is None else FALSE_ALARMS_NEAR):
            return "could be chance"
        if second > SECOND_BEST * found or second > found - LEAD:
            return "ambiguous"
        if found < AGREEING * inside:
            return "most stems disagree"
        sigma = np.sqrt(np.diag(covariance))
        if max(sigma[:2]) > SIGMA_XY or sigma[2] > SIGMA_YAW:
            return "weakly fixed"
        return None

    def _refined(self, pose: Float) -> _Candidate:
        """Return a pose x, y [m], yaw [rad], shape (3,), after pairing and alignment in turns until the pairs
        do not change, there are fewer than two, or ROUNDS are over. The argument is unchanged."""
        local, reference = self._local, self._reference
        of, before = np.full(len(local), -1, np.int64), np.full(len(local), -2, np.int64)
        found = 0
        for k in range(ROUNDS):
            slack = self._p.slack * (WIDE if k < WIDE_ROUNDS else 1.0)
            found = partners(
                pose, *self._columns(local), *self._columns(reference), *self._grid, slack, REACH, of
            )
            if found < 2 or (k > WIDE_ROUNDS and np.array_equal(of, before)):
                break
            at = np.flatnonzero(of >= 0)
            to = of[at]
            weight = 1.0 / (local.sigma[at] ** 2 + reference.sigma[to] ** 2 + self._p.slack**2)
            pose = aligned(local.position[at], reference.position[to], weight)
            before = of.copy()
        return _Candidate(pose, of, found)

    @staticmethod
    def _columns(stems: MapStems) -> tuple[Float, Float, Float, Float]:
        """Return positions, sigmas, diameters and their sigmas of stems, in the order in which the kernels
        expect them."""
        return stems.position, stems.sigma, stems.dbh, stems.dbh_sigma


def evenly_ordered(base: Int32) -> Int32:
    """Return at most BASE_PAIRS of the pairs, which are sorted by length, int32, shape (B, 2), in an order in
    which each first part covers all lengths evenly."""
    rows = np.linspace(0, len(base) - 1, min(len(base), BASE_PAIRS)).astype(np.int64)
    return base[rows[np.argsort(np.arange(len(rows)) * GOLDEN % 1.0, kind="stable")]]


def _log10_false_alarms(tests: int, trials: int, hits: int, p: float) -> float:
    """Return log10 of tests * P(Binomial(trials, p) >= hits), where the probability is at least 1e-300;
    `tests` and `trials` count as at least 1."""
    from scipy.stats import binom

    tail = float(binom.logsf(hits - 1, max(trials, 1), p)) / np.log(10.0)
    return float(np.log10(max(tests, 1)) + max(tail, -300.0))


__all__ = [
    "MapStems",
    "Match",
    "Refusal",
    "evenly_ordered",
    "find_constellation",
    "find_displacement",
    "keep_hypothesis",
]
