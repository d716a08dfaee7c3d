"""Global matching of a constellation of stems with a map, without an initial pose: the pose with its
covariance, or the reason of a refusal.

A wrong loop ruins a map, a missed one costs little. A pose is accepted only if (1) enough stems agree, (2)
so many would not agree by chance, by the number of false alarms of the a contrario method (Desolneux,
Moisan, Morel 2000), (3) no other pose explains nearly as many, as in the regular grid of a plantation, and
(4) the stems that agree determine the pose well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipeline.config.stages import Relocalisation
from pipeline.geometry.poses import Float, Pose2
from pipeline.jit import compiled
from pipeline.loop_closure.pose_hypotheses import cells_of, crowding, pairs_within, partners, search
from pipeline.slam.places import AGREEING, WINDOW
from pipeline.types.records import Bool, Int, Int32, Trees


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


@compiled
def aligned(local: Float, reference: Float, weight: Float, n: int, out: Float) -> None:
    """Write the pose T that minimises the weighted sum of |reference - T local|^2 into `out` (Horn 1987, in
    the plane).

    tan yaw = sum w (l x r) / sum w (l . r) of the points about their weighted means. One pair, or coincident
    points, give the yaw 0; without pairs the result is NaN.

    Args:
        local, reference: The first `n` rows are pairs, shape (M, 2) [m].
        weight: Weights of the pairs, shape (M,) [1/m^2].
        n: Number of pairs.
        out: Filled with x, y [m], yaw [rad], shape (3,).
    """
    total = lx = ly = rx = ry = 0.0
    for k in range(n):
        total += weight[k]
        lx += weight[k] * local[k, 0]
        ly += weight[k] * local[k, 1]
        rx += weight[k] * reference[k, 0]
        ry += weight[k] * reference[k, 1]
    lx, ly, rx, ry = lx / total, ly / total, rx / total, ry / total
    dot = cross = 0.0
    for k in range(n):
        ax, ay = local[k, 0] - lx, local[k, 1] - ly
        bx, by = reference[k, 0] - rx, reference[k, 1] - ry
        dot += weight[k] * (ax * bx + ay * by)
        cross += weight[k] * (ax * by - ay * bx)
    yaw = np.arctan2(cross, dot)
    c, s = np.cos(yaw), np.sin(yaw)
    out[0], out[1], out[2] = rx - c * lx + s * ly, ry - s * lx - c * ly, yaw


def alignment_covariance(pose: Pose2, local: Float, reference: Float, variance: Float) -> Float:
    """Return the covariance of an aligned pose x, y [m], yaw [rad], shape (3, 3): (sum J^T J / variance)^-1
    at the solution.

    Where the residuals are larger than their variances, it grows by their ratio; it never shrinks.

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
SECOND_BEST = 0.7  # largest ratio of the agreements of the second best pose and the best one
LEAD = 3  # least difference of their numbers
SIGMA_XY, SIGMA_YAW = 0.5, 0.05  # m, rad; largest standard deviations of the pose


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Result of a search.

    Attributes:
        pose: T_reference_local; None if it was refused.
        covariance: Covariance of x, y [m], yaw [rad], shape (3, 3); zeros if refused.
        reason: Reason of the refusal, or None.
        local, reference: Rows of the stems that agree in the best pose, int64, shape (K,).
        second: Number of stems that agree in the second best pose.
        false_alarms: Decimal logarithm of the expected number of equally good agreements by chance.
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
    Stems whose position or sigma is not finite are ignored; either side may be empty.

    Args:
        local: Stems in their own frame, for example of the map since the robot was lost.
        reference: Stems in the frame of the map.
        parameters: Parameters of this stage.
        hypotheses: Number of hypotheses after which no further pair of local stems is tried.
    """
    rows, map_rows = np.flatnonzero(local.usable()), np.flatnonzero(reference.usable())
    search_ = _Search(local.take(rows), reference.take(map_rows), parameters, hypotheses)
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
    """A refined pose x, y, yaw; the row of the map for each local stem, or -1; the number of pairs."""

    pose: Float
    of: Int
    found: int

    def is_same(self, other: _Candidate) -> bool:
        """Return whether more than half of the pairs are those of another candidate. Both have the same local
        stems."""
        return 2 * int(np.count_nonzero((self.of >= 0) & (self.of == other.of))) > self.found


class _Search:
    """One search. The local stems are centred at their mean, which decouples rotation and translation."""

    def __init__(self, local: MapStems, reference: MapStems, parameters: Relocalisation, most: int) -> None:
        """Prepare a search.

        Args:
            local, reference: Usable stems of the constellation and of the map.
            parameters: Parameters of the stage.
            most: Number of hypotheses after which no further pair of local stems is tried.
        """
        self.reason: Refusal = "too few stems"
        self._p = parameters
        self._mean: Float = local.position.mean(axis=0) if len(local) else np.zeros(2)
        self._local = MapStems(local.position - self._mean, local.sigma, local.dbh, local.dbh_sigma)
        self._reference = reference
        self._most, self._looked = most, 0

    def best_two(self) -> tuple[_Candidate | None, _Candidate | None]:
        """Return the pose in which most stems agree, and the best pose with other pairs; None for each that
        does not exist, with the reason in `reason`."""
        local, reference, p = self._local, self._reference, self._p
        if min(len(local), len(reference)) < p.stems_min:
            return None, None
        self.reason = "no agreement"
        base, _ = pairs_within(local.position, SHORTEST, LONGEST, MOST_PAIRS)
        pair, length = pairs_within(reference.position, SHORTEST - 1.0, LONGEST + 1.0, MOST_PAIRS)
        if not len(base) or not len(pair):
            return None, None
        self._grid = cells_of(reference.position, REACH)
        rough, _, self._looked = search(
            *self._columns(local), _evenly(base), *self._columns(reference), pair, length, *self._grid,
            p.slack, REACH, LEAST, self._most,
        )  # fmt: skip
        refined = sorted((self._refined(pose) for pose in rough), key=lambda c: -c.found)
        if not refined or refined[0].found < LEAST:
            return None, None
        best = refined[0]
        return best, next((c for c in refined[1:] if not c.is_same(best)), None)

    def checked(self, best: _Candidate, second: int) -> tuple[Pose2, Float, float, Refusal | None]:
        """Return the pose T_reference_local, its covariance, shape (3, 3), the decimal logarithm of the false
        alarms, and the reason of a refusal (None for none). `second` is the number of pairs of the second
        best pose, 0 without one."""
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
        if found < self._p.stems_min:
            return "too few stems"
        if chance > np.log10(FALSE_ALARMS):
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
        pose = pose.copy()
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
            aligned(local.position[at], reference.position[to], weight, found, pose)
            before = of.copy()
        return _Candidate(pose, of, found)

    @staticmethod
    def _columns(stems: MapStems) -> tuple[Float, Float, Float, Float]:
        """Return positions, sigmas, diameters and their sigmas of stems, in the order in which the kernels
        expect them."""
        return stems.position, stems.sigma, stems.dbh, stems.dbh_sigma


def _evenly(base: Int32) -> Int32:
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


__all__ = ["MapStems", "Match", "Refusal", "find_constellation"]
