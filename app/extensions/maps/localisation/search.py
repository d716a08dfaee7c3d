"""Global search of a local constellation of stems in a stored map: the best pose and its chance of being
false.

A pair of local stems is aligned with each pair of the map of equal length. Each pair of the map has a mask of
the stems around it, in its own frame, of 576 bits; the number of local stems that agree is that of the common
bits, and most wrong alignments are dropped by it in a nanosecond. The others are compared with an occupancy
raster of the stems of the map, first near the pair, and dropped by a sequential test (Wald 1945) as soon as
their stems agree so rarely that they are not the right one. The best alignments are refined with exact
positions (`stem_matching.partners`), as in `find_constellation`.

The fix is accepted if its agreement is not chance: the number M of alignments that were tried, times the
probability that as many stems of a wrong pose agree, M P(Binomial(n, p) >= k), is at most the level (number
of false alarms of the a contrario method, Desolneux, Moisan, Morel 2000). p is the chance that a stem agrees,
from the density of the map; or, if it is larger, the chance that explains the second best pose as the best of
M wrong ones, M P(Binomial(n, p) >= k2) = 1. The second best pose is therefore an estimate of the chance in
this stand: it is high where stems stand in rows, and it includes the fitting of the pose. The best pose must
exceed the second best pose by the same test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betaincinv
from scipy.stats import binom

from app.extensions.maps.localisation.stored_map import StoredMap
from pipeline.geometry.poses import Float, Pose2, wrap_angle
from pipeline.jit import compiled
from pipeline.loop_closure.stem_matching import (
    LEAST,
    REACH,
    ROUNDS,
    WIDE,
    WIDE_ROUNDS,
    MapStems,
    aligned,
    alignment_covariance,
    alike,
    cells_of,
    crowding,
    evenly_ordered,
    keep_hypothesis,
    pairs_within,
    partners,
)
from pipeline.slam.frame_uncertainty import transported_covariance
from pipeline.slam.places import AGREEING, WINDOW
from pipeline.types.records import Int, Int32

Blocks = NDArray[np.uint64]

# Length of the pairs, in mean distances of the stems of the map. The heading of a shorter one is off by more
# than the gate at its neighbours; a longer one has more partners of equal length in the map.
SHORTEST, LONGEST = 1.0, 2.5
SPACING = 2.0, 8.0  # m; bounds of the mean distance of stems
# With 0.4 of the stems seen again, a pair finds the pose with 0.07 (both are seen again, and its neighbours
# pass the sequential test), and all of 24 pairs fail with 0.18, with 0.5 of the stems with 0.02. The next
# search has other stems.
BASE_PAIRS = 24
FURTHER_PAIRS = 6  # base pairs after the first that finds a pose beyond chance; they find its rivals too
MOST_PAIRS = 2_000_000  # pairs of the map
# Cells of a mask along each axis, and their side in mean distances of the stems: it has about 23 stems. Cells
# within MASK_NEAR [m] of a stem are set, 2 sigma of two maps: with more, half of the wrong alignments pass.
MASK, MASK_CELL, MASK_NEAR = 24, 0.2, 0.2
RASTER = 0.25  # m; cell of the occupancy raster
NEAR = 0.4  # m; a stem agrees with an alignment of a pair within it: 3 sigma of two maps
MOST_CELLS = 1 << 28  # of the raster, one bit each; larger maps get larger cells
COUNTED = 24  # local stems nearest to the pair that are compared with the raster
SEEN_AGAIN = 0.6  # share of the neighbours of a pair that agree, for the sequential test
DROP = math.log(0.2)  # log of the likelihood ratio at which an alignment is dropped
REFINED = 12  # alignments that are refined
KEPT = 48
SAME_XY, SAME_YAW = 1.0, 0.1  # m, rad; refined poses within both are one place
#: m; largest standard deviation of a stem relative to its neighbours. That of its position in the map has the
#: drift of the map, which neighbours share.
SIGMA = 0.1
SIGMA_XY, SIGMA_YAW = 0.5, 0.05  # m, rad; largest standard deviations of a fix


@dataclass(frozen=True, slots=True, eq=False)
class MapIndex:
    """A stored map prepared for searches.

    Attributes:
        stems, tree: The stems, and the tree of their positions.
        pair, length: Pairs of stems by length, see `pairs_within`.
        mask, mask_cell, mask_chance: Mask of each pair, uint64, shape (K, MASK^2 / 64), see `mask_pairs`;
            side of its cells [m]; share of the bits that are set.
        grid: Grid of the stems, see `cells_of`.
        low, cell, near: Low corner [m], cell [m] and blocks of 8 x 8 cells of the raster, uint64, shape (W,
            H): bit 8 i + j is set if cell i, j of the block is within NEAR of a stem.
        reach: Shortest and longest pair [m].
        chance: Share of the raster that is occupied around the stems: the chance that a stem agrees.
    """

    stems: MapStems
    tree: cKDTree
    pair: Int32
    length: Float
    mask: Blocks
    mask_cell: float
    mask_chance: float
    grid: tuple[Float, Int32, Int32]
    low: Float
    cell: float
    near: Blocks
    reach: tuple[float, float]
    chance: float

    @classmethod
    def of(cls, stored: StoredMap, slack: float) -> MapIndex:
        """Return the index of a map with at least one stem.

        Args:
            stored: The map.
            slack: Standard deviation of the distortion of a map within a constellation [m].
        """
        stems = relative(stored.stems)
        position = stems.position
        tree = cKDTree(position)
        density, _ = crowding(np.zeros(3), position, tree, WINDOW)
        spacing = min(max(1.0 / math.sqrt(density), SPACING[0]), SPACING[1])
        reach = SHORTEST * spacing, LONGEST * spacing
        margin = 2.0 * math.sqrt(4.0 * SIGMA**2 + 2.0 * slack**2)
        pair, length = pairs_within(position, max(reach[0] - margin, 0.1), reach[1] + margin, MOST_PAIRS)
        low = position.min(axis=0) - 2.0 * NEAR
        extent = np.ptp(position, axis=0) + 4.0 * NEAR
        cell = max(RASTER, math.sqrt(float(np.prod(extent)) / MOST_CELLS))
        width, height = (np.floor(extent / (8.0 * cell)) + 1.0).astype(np.int64).tolist()
        near = np.zeros((width, height), np.uint64)
        occupy(near, position, low, cell, NEAR)
        chance = min(1.0 - math.exp(-density * math.pi * NEAR**2), 0.5 * SEEN_AGAIN)
        side = MASK_CELL * spacing
        mask = np.zeros((len(pair), MASK * MASK // 64), np.uint64)
        bits = mask_pairs(position, *cells_of(position, (MASK + 1) * side), pair, side, MASK_NEAR, mask)
        mask_chance = min(max(bits / max(mask.size * 64, 1), 1e-3), 0.5 * SEEN_AGAIN)
        return cls(
            stems, tree, pair, length, mask, side, mask_chance, cells_of(position, REACH), low, cell, near,
            reach, chance,
        )  # fmt: skip


def relative(stems: MapStems) -> MapStems:
    """Return stems with standard deviations of at most SIGMA, those relative to their neighbours."""
    return MapStems(stems.position, np.minimum(stems.sigma, SIGMA), stems.dbh, stems.dbh_sigma)


@compiled
def occupy(near: Blocks, position: Float, low: Float, cell: float, reach: float) -> None:
    """Set the cells of a raster whose centres are within `reach` [m] of a stem to 1.

    Args:
        near: Blocks of the raster, uint64, shape (W, H), changed in place; see `MapIndex`.
        position: Stems, shape (N, 2) [m], at least `reach` inside of the raster.
        low, cell: Low corner and cell of the raster [m].
    """
    wide = int(np.ceil(reach / cell))
    for k in range(position.shape[0]):
        x, y = (position[k, 0] - low[0]) / cell, (position[k, 1] - low[1]) / cell
        for i in range(max(int(x) - wide, 0), min(int(x) + wide + 1, 8 * near.shape[0])):
            for j in range(max(int(y) - wide, 0), min(int(y) + wide + 1, 8 * near.shape[1])):
                if (i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2 <= (reach / cell) ** 2:
                    near[i >> 3, j >> 3] |= np.uint64(1) << np.uint64(((i & 7) << 3) | (j & 7))


@compiled
def mask_pairs(
    position: Float, grid: Float, first: Int32, following: Int32, pair: Int32, side: float, reach: float,
    mask: Blocks,
) -> int:  # fmt: skip
    """Fill the masks of the pairs of a map; return the number of bits that are set.

    The frame of a pair has its origin in the middle, and its x axis points from the first stem to the second.
    Bit MASK i + j of the mask is set if another stem is within `reach` of the cell from (i - MASK / 2) to
    (i + 1 - MASK / 2) sides along x, and the same with j along y.

    Args:
        position: Stems, shape (N, 2) [m].
        grid, first, following: Their grid, see `cells_of`, with cells of at least MASK / sqrt(2) sides.
        pair: Rows of the pairs, int32, shape (K, 2).
        side: Side of a cell [m].
        reach: Uncertainty of a position [m].
        mask: Filled, uint64, shape (K, MASK^2 / 64).
    """
    bits = 0
    margin = reach / side
    for k in range(pair.shape[0]):
        a, b = pair[k, 0], pair[k, 1]
        dx, dy = position[b, 0] - position[a, 0], position[b, 1] - position[a, 1]
        scale = 1.0 / (np.sqrt(dx * dx + dy * dy) * side)
        c, s = dx * scale, dy * scale
        mx, my = 0.5 * (position[a, 0] + position[b, 0]), 0.5 * (position[a, 1] + position[b, 1])
        ia, ib = int((mx - grid[0]) / grid[2]), int((my - grid[1]) / grid[2])
        for ca in range(max(ia - 1, 0), min(ia + 2, first.shape[0])):
            for cb in range(max(ib - 1, 0), min(ib + 2, first.shape[1])):
                m = first[ca, cb]
                while m >= 0:
                    x, y = position[m, 0] - mx, position[m, 1] - my
                    u, v = c * x + s * y + 0.5 * MASK, c * y - s * x + 0.5 * MASK
                    if m != a and m != b and -margin < u < MASK + margin and -margin < v < MASK + margin:
                        for i in range(max(int(u - margin), 0), min(int(u + margin) + 1, MASK)):
                            ex = max(i - u, u - i - 1.0, 0.0)
                            for j in range(max(int(v - margin), 0), min(int(v + margin) + 1, MASK)):
                                ey = max(j - v, v - j - 1.0, 0.0)
                                if ex * ex + ey * ey <= margin * margin:
                                    at = MASK * i + j
                                    mask[k, at >> 6] |= np.uint64(1) << np.uint64(at & 63)
                    m = following[m]
        for word in range(mask.shape[1]):
            bits += ones(mask[k, word])
    return bits


@compiled
def ones(word: np.uint64) -> int:
    """Return the number of bits of a word that are set (Knuth 2009, 7.1.3, by sums of neighbours); compilers
    know the form and use the instruction of the processor."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@compiled
def align_pairs(
    local: Float, local_sigma: Float, local_dbh: Float, local_dbh_sigma: Float, base: Int32,
    reference: Float, sigma: Float, dbh: Float, dbh_sigma: Float, pair: Int32, length: Float,
    mask: Blocks, mask_cell: float, mask_chance: float, low: Float, cell: float, near: Blocks, chance: float,
    slack: float, seen_again: float, enough: int,
) -> tuple[Float, Int, int]:  # fmt: skip
    """Align each base pair with all pairs of the map of equal length, and count the stems that agree.

    Args:
        local, local_sigma, local_dbh, local_dbh_sigma: Columns of the local stems, see `MapStems`.
        base: Pairs of local rows, int32, shape (B, 2).
        reference, sigma, dbh, dbh_sigma: Columns of the stems of the map.
        pair, length, mask, mask_cell, mask_chance, low, cell, near, chance: See `MapIndex`.
        slack: See `MapIndex.of`.
        seen_again: Share of the stems that agree with the right alignment.
        enough: Number of stems of the first alignment after which FURTHER_PAIRS base pairs follow.

    Returns:
        The best distinct poses x, y [m], yaw [rad], shape (K, 3), at most KEPT, in no particular order; the
        number of counted stems that agree in each, int64, shape (K,); and the number of alignments.
    """
    pose, agree = np.empty((KEPT, 3)), np.zeros(KEPT, np.int64)
    kept, looked, floor = 0, 0, 2
    # Changes of the log likelihood ratio by a stem that agrees, and by one that does not.
    hit, miss = np.log(seen_again / chance), np.log((1.0 - chance) / (1.0 - seen_again))
    masked = np.log(seen_again / mask_chance), np.log((1.0 - mask_chance) / (1.0 - seen_again))
    ahead, back = np.empty(mask.shape[1], np.uint64), np.empty(mask.shape[1], np.uint64)
    count = min(local.shape[0], COUNTED + 2)
    px, py = np.empty(count), np.empty(count)
    worst = sigma.max()
    wide, high = 8.0 * near.shape[0], 8.0 * near.shape[1]
    last = base.shape[0]
    for k in range(base.shape[0]):
        if k >= last:
            break
        i, j = base[k, 0], base[k, 1]
        bx, by = local[j, 0] - local[i, 0], local[j, 1] - local[i, 1]
        span = np.sqrt(bx * bx + by * by)
        mx, my = 0.5 * (local[i, 0] + local[j, 0]), 0.5 * (local[i, 1] + local[j, 1])
        distance2 = (local[:, 0] - mx) ** 2 + (local[:, 1] - my) ** 2
        distance2[i] = distance2[j] = np.inf
        order = np.argsort(distance2, kind="mergesort")
        for m in range(count - 2):
            px[m], py[m] = local[order[m], 0] - mx, local[order[m], 1] - my
        ahead[:] = back[:] = 0
        for m in range(count - 2):
            u = (bx * px[m] + by * py[m]) / (span * mask_cell) + 0.5 * MASK
            v = (bx * py[m] - by * px[m]) / (span * mask_cell) + 0.5 * MASK
            if 0.0 <= u < MASK and 0.0 <= v < MASK:
                ahead_at = MASK * int(u) + int(v)
                back_at = MASK * MASK - 1 - ahead_at
                ahead[ahead_at >> 6] |= np.uint64(1) << np.uint64(ahead_at & 63)
                back[back_at >> 6] |= np.uint64(1) << np.uint64(back_at & 63)
        inside = 0
        for word in range(mask.shape[1]):
            inside += ones(ahead[word])
        least = inside * masked[1] / (masked[0] + masked[1])  # a likelihood ratio of 1
        variance = local_sigma[i] ** 2 + local_sigma[j] ** 2 + 2.0 * slack * slack
        widest = 2.0 * np.sqrt(variance + 2.0 * worst * worst)
        begin, end = np.searchsorted(length, span - widest), np.searchsorted(length, span + widest)
        looked += 2 * (end - begin)
        for at in range(begin, end):
            a, b = pair[at, 0], pair[at, 1]
            off = length[at] - span
            for turned in range(2):
                common = 0
                for word in range(mask.shape[1]):
                    common += ones(mask[at, word] & (back[word] if turned else ahead[word]))
                if common < least or off * off > 4.0 * (variance + sigma[a] ** 2 + sigma[b] ** 2):
                    continue
                a, b = pair[at, turned], pair[at, 1 - turned]
                if not (
                    alike(local_dbh[i], local_dbh_sigma[i], dbh[a], dbh_sigma[a])
                    and alike(local_dbh[j], local_dbh_sigma[j], dbh[b], dbh_sigma[b])
                ):
                    continue
                rx, ry = reference[b, 0] - reference[a, 0], reference[b, 1] - reference[a, 1]
                scale = 1.0 / (span * np.sqrt(rx * rx + ry * ry))
                c, s = (bx * rx + by * ry) * scale, (bx * ry - by * rx) * scale
                x, y = 0.5 * (reference[a, 0] + reference[b, 0]), 0.5 * (reference[a, 1] + reference[b, 1])
                ux, uy = (x - low[0]) / cell, (y - low[1]) / cell
                cc, ss = c / cell, s / cell
                score, found = 0.0, 2
                for m in range(count - 2):
                    u = ux + cc * px[m] - ss * py[m]
                    v = uy + ss * px[m] + cc * py[m]
                    agrees = False
                    if 0.0 <= u < wide and 0.0 <= v < high:
                        iu, iv = int(u), int(v)
                        bit = np.uint64(((iu & 7) << 3) | (iv & 7))
                        agrees = (near[iu >> 3, iv >> 3] >> bit) & np.uint64(1) != 0
                    if agrees:
                        score += hit
                        found += 1
                    else:
                        score -= miss
                        if score < DROP:
                            found = 0
                            break
                if found > floor:
                    yaw = np.arctan2(s, c)
                    if found >= enough and last == base.shape[0]:
                        last = min(last, k + 1 + FURTHER_PAIRS)
                    kept = keep_hypothesis(
                        pose, agree, kept, x - c * mx + s * my, y - s * mx - c * my, yaw, found, REACH
                    )
                    floor = max(floor, found // 2)
                    if kept == KEPT:
                        floor = max(floor, int(agree.min()))
    return pose[:kept], agree[:kept], looked


Refusal = Literal["too few stems", "no agreement", "could be chance", "ambiguous", "most stems disagree",
                  "weakly fixed"]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class MapFix:
    """Result of a search, or of an alignment from a known pose.

    Attributes:
        pose: T_map_local of the best pose; None if there is none.
        centre: Mean of the local stems in their frame, shape (2,) [m].
        covariance: Covariance of x, y [m], yaw [rad] in the map of a robot at `centre`, shape (3, 3); zeros
            without a pose.
        reason: Why the pose is not accepted; None if it is.
        local, reference: Rows of the stems that agree, int64, shape (K,).
        inside: Number of local stems where the map has stems, see `crowding`.
        second: Number of stems that agree with the second best pose.
        looked: Number of alignments that were tried.
        chance: Probability that a stem agrees with a random pose.
        residual: Root mean square distance of the stems that agree [m]; NaN without a pose.
    """

    pose: Pose2 | None
    centre: Float
    covariance: Float
    reason: Refusal | None
    local: Int
    reference: Int
    inside: int = 0
    second: int = 0
    looked: int = 0
    chance: float = 0.0
    residual: float = math.nan

    def covariance_at(self, place: Float) -> Float:
        """Return the covariance of x, y [m], yaw [rad] in the map of a robot at a position in the local
        frame, shape (2,) [m], that is exact there: shape (3, 3)."""
        if self.pose is None:
            return self.covariance
        dx, dy = self.pose.rotation() @ (place - self.centre)
        return transported_covariance(self.covariance, float(dx), float(dy))

    def wrong_chance(self, n: int) -> float:
        """Return the probability that one of n stems agrees at a wrong pose: `chance`, or the larger one that
        explains the second best pose."""
        if not self.second:
            return self.chance
        return max(
            self.chance, float(betaincinv(self.second, n - self.second + 1, 1.0 / max(self.looked, 2)))
        )


def false_alarms(k: int, n: int, looked: int, chance: float) -> float:
    """Return the natural logarithm of the expected number of wrong poses at which k or more of n stems agree.
    Two stems, of the pair that was aligned, agree by construction.

    Args:
        k, n: Numbers of stems.
        looked: Number of poses that were tried.
        chance: Probability that a stem agrees.
    """
    return math.log(max(looked, 1)) + float(binom.logsf(k - 3, max(n - 2, 1), chance))


def _none(reason: Refusal, *, looked: int = 0, inside: int = 0, chance: float = 0.0) -> MapFix:
    """Return a result without a pose."""
    rows = np.zeros(0, np.int64)
    return MapFix(None, np.zeros(2), np.zeros((3, 3)), reason, rows, rows, inside, 0, looked, chance)


def search_map(local: MapStems, index: MapIndex, slack: float, level: float) -> MapFix:
    """Return the pose of local stems in a map, without an initial pose.

    Args:
        local: Usable stems in their own frame.
        index: The map.
        slack: See `MapIndex.of`.
        level: Expected number of false alarms.
    """
    local = relative(local)
    if min(len(local), len(index.stems)) < LEAST:
        return _none("too few stems")
    mean = local.position.mean(axis=0)
    centred = MapStems(local.position - mean, local.sigma, local.dbh, local.dbh_sigma)
    base, _ = pairs_within(centred.position, *index.reach, MOST_PAIRS)
    counted = min(len(local) - 2, COUNTED)
    hits = np.arange(counted + 2)
    beyond = hits[math.log(1e6) + binom.logsf(hits - 1, counted, index.chance) <= math.log(level)]
    enough = 2 + int(beyond[0]) if len(beyond) else counted + 3
    rough, agree, looked = align_pairs(
        *_columns(centred), evenly_ordered(base)[:BASE_PAIRS],
        *_columns(index.stems), index.pair, index.length, index.mask, index.mask_cell, index.mask_chance,
        index.low, index.cell, index.near, index.chance, slack, SEEN_AGAIN, enough,
    )  # fmt: skip
    best_first = np.lexsort((*rough.T, -agree))[:REFINED]
    refined = [refine(rough[k], centred, index, slack) for k in best_first]
    refined.sort(key=lambda each: -int(np.count_nonzero(each[1] >= 0)))
    if not refined or np.count_nonzero(refined[0][1] >= 0) < LEAST:
        return _none("no agreement", looked=looked, chance=index.chance)
    rivals = (o for pose, o in refined[1:] if not _is_same(pose, refined[0][0]))
    second = int(np.count_nonzero(next(rivals, np.zeros(0)) >= 0))
    fix = _fix(*refined[0], centred, mean, index, slack, second=second, looked=looked)
    return _decided(fix, len(local), level)


def _is_same(a: Float, b: Float) -> bool:
    """Return whether two poses of the stems about their mean, shape (3,), are of one place."""
    turn = abs(float(wrap_angle(a[2] - b[2])))
    return math.hypot(a[0] - b[0], a[1] - b[1]) <= SAME_XY and turn <= SAME_YAW


def _decided(fix: MapFix, n: int, level: float) -> MapFix:
    """Return a fix with the reason of its refusal, by the tests of this module; `n` is the number of local
    stems."""
    k, sigma = len(fix.local), np.sqrt(np.diag(fix.covariance))
    reason: Refusal | None = None
    if not false_alarms(k, n, fix.looked, fix.chance) <= math.log(level):
        reason = "could be chance"
    elif not false_alarms(k, n, fix.looked, fix.wrong_chance(n)) <= math.log(level):
        reason = "ambiguous"
    elif k < AGREEING * fix.inside:
        reason = "most stems disagree"
    elif max(sigma[:2]) > SIGMA_XY or sigma[2] > SIGMA_YAW:
        reason = "weakly fixed"
    return replace(fix, reason=reason)


def refine(
    pose: Float, local: MapStems, index: MapIndex, slack: float, prior: Float | None = None
) -> tuple[Float, Int]:
    """Return a pose x, y [m], yaw [rad] after pairing and alignment in turns, and the row of the map of each
    local stem, -1 for none, int64, shape (L,).

    Args:
        pose: The pose before, shape (3,).
        local: Local stems, about their mean.
        index: The map.
        slack: See `MapIndex.of`.
        prior: Covariance of `pose`, shape (3, 3), which then takes part in the alignment; None if it is only
            an initial value.
    """
    of, before = np.full(len(local), -1, np.int64), np.full(len(local), -2, np.int64)
    wide = WIDE * slack if prior is None else math.sqrt(slack**2 + float(prior[0, 0] + prior[1, 1]))
    initial = pose
    for k in range(ROUNDS):
        gate = wide if k < WIDE_ROUNDS else slack
        found = partners(pose, *_columns(local), *_columns(index.stems), *index.grid, gate, REACH, of)
        if found < (2 if prior is None else 1) or (k > WIDE_ROUNDS and np.array_equal(of, before)):
            break
        at = np.flatnonzero(of >= 0)
        weight = 1.0 / (local.sigma[at] ** 2 + index.stems.sigma[of[at]] ** 2 + slack**2)
        to = index.stems.position[of[at]]
        if prior is None:
            pose = aligned(local.position[at], to, weight)
        else:
            pose = corrected(initial, prior, local.position[at], to, weight)[0]
        before = of.copy()
    return pose, of


def corrected(
    pose: Float, covariance: Float, local: Float, reference: Float, weight: Float
) -> tuple[Float, Float]:
    """Return a pose x, y [m], yaw [rad], shape (3,), corrected by pairs of stems, and its covariance: one
    step of Gauss-Newton from it with its covariance as a prior. The information of the pairs is divided by
    chi^2 per degree of freedom of their residuals if that is above 1.

    Args:
        pose, covariance: The pose before, shapes (3,) and (3, 3); within a few degrees.
        local, reference: Pairs, shape (M, 2) [m].
        weight: Weights of the pairs, shape (M,) [1/m^2].
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    arm = local @ np.array([[c, s], [-s, c]])
    residual = reference - arm - pose[:2]
    J = np.zeros((len(arm), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -arm[:, 1], arm[:, 0]
    H, g = np.einsum("nki,nkj,n->ij", J, J, weight), np.einsum("nki,nk,n->i", J, residual, weight)
    before = np.linalg.inv(covariance)
    left = residual - J @ np.linalg.solve(H + before, g)
    scale = max(float(weight @ np.sum(left**2, axis=1)) / max(2 * len(arm) - 3, 1), 1.0)
    after = np.linalg.inv(H / scale + before)
    return pose + after @ g / scale, 0.5 * (after + after.T)


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Pose of the base in the map as it is known before an alignment: T_map_base and the covariance of x, y
    [m], yaw [rad], shape (3, 3)."""

    T_map_base: Pose2
    covariance: Float


def fix_near(
    T_map_local: Pose2, local: MapStems, index: MapIndex, slack: float, prior: Prior | None = None
) -> MapFix:
    """Return the pose that fits best near a known one; its reason is None if it is determined, and its
    agreement is not tested. With a prior, that is the most probable pose, and any number of stems determines
    it. The other arguments are those of `search_map`."""
    local = relative(local)
    if not len(local):
        return _none("too few stems")
    mean = local.position.mean(axis=0)
    centred = MapStems(local.position - mean, local.sigma, local.dbh, local.dbh_sigma)
    there = T_map_local @ Pose2(float(mean[0]), float(mean[1]), 0.0)
    known = None
    if prior is not None:
        dx, dy = there.x - prior.T_map_base.x, there.y - prior.T_map_base.y
        known = transported_covariance(prior.covariance, dx, dy)
    pose, of = refine(there.as_array(), centred, index, slack, known)
    at = np.flatnonzero(of >= 0)
    if known is not None and len(at):
        weight = 1.0 / (centred.sigma[at] ** 2 + index.stems.sigma[of[at]] ** 2 + slack**2)
        to = index.stems.position[of[at]]
        pose, covariance = corrected(there.as_array(), known, centred.position[at], to, weight)
        return _fix(pose, of, centred, mean, index, slack, covariance=covariance)
    if len(at) >= 3:
        return _fix(pose, of, centred, mean, index, slack)
    density, inside = crowding(there.as_array(), centred.position, index.tree, WINDOW)
    return _none("no agreement", inside=inside, chance=_chance(density, centred, index, slack))


def _fix(
    pose: Float, of: Int, centred: MapStems, mean: Float, index: MapIndex, slack: float,
    *, second: int = 0, looked: int = 0, covariance: Float | None = None,
) -> MapFix:  # fmt: skip
    """Return a refined pose of the stems about their mean as a fix, without a decision. Its covariance is
    that of the alignment if it is not given."""
    at = np.flatnonzero(of >= 0)
    to, reference = of[at], index.stems
    about_mean = Pose2(*(float(v) for v in pose))
    T_map_local = about_mean @ Pose2(-float(mean[0]), -float(mean[1]))
    if covariance is None:
        variance = centred.sigma[at] ** 2 + reference.sigma[to] ** 2 + slack**2
        try:
            covariance = alignment_covariance(
                about_mean, centred.position[at], reference.position[to], variance
            )
        except np.linalg.LinAlgError:
            covariance = np.diag([1e6, 1e6, 1e6])
    density, inside = crowding(pose, centred.position, index.tree, WINDOW)
    residual = reference.position[to] - about_mean.apply(centred.position[at])
    return MapFix(
        T_map_local, mean, covariance, None, at, to, inside, second, looked,
        _chance(density, centred, index, slack), float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))),
    )  # fmt: skip


def _chance(density: float, local: MapStems, index: MapIndex, slack: float) -> float:
    """Return the probability that a local stem has a partner at a random pose, by the density of the map
    there [1/m^2] and the gate of `partners`."""
    variance = float(np.mean(local.sigma**2) + np.mean(index.stems.sigma**2)) + slack**2
    return float(1.0 - np.exp(-density * np.pi * min(9.0 * variance, REACH**2)))


def _columns(stems: MapStems) -> tuple[Float, Float, Float, Float]:
    """Return positions, sigmas, diameters and their sigmas of stems."""
    return stems.position, stems.sigma, stems.dbh, stems.dbh_sigma


__all__ = ["MapFix", "MapIndex", "Prior", "Refusal", "fix_near", "search_map"]
