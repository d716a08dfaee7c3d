"""Evaluation of a map against ground truth.

Trees are matched one to one with the minimum sum of distances. The scores are TA, TR, FA and FR as in the
paper, completeness, correctness, and the errors of positions, diameters and distances between trees; for the
path it is the absolute trajectory error (ATE).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.config.stages import Evaluation
from pipeline.geometry.poses import Float, Pose2
from pipeline.types.records import HIDDEN, Bool, Int, Path, Trees, TruthPath, TruthTrees


def match(found: Float, truth: Float, distance_max: float) -> Int:
    """Return the row of `truth` that is assigned to each row of `found`, -1 for none, int64, shape (N,).
    Positions that are not finite have no partner; either side may be empty.

    The assignment has the maximum number of pairs within `distance_max`, and among such assignments the
    minimum sum of distances (Kuhn 1955, solved by scipy).

    Args:
        found: Positions, shape (N, 2) [m].
        truth: Positions in the same frame, shape (M, 2) [m].
        distance_max: Maximum distance of a pair [m].
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching
    from scipy.spatial import cKDTree

    truth_of = np.full(len(found), -1, np.int64)
    mine, others = (np.flatnonzero(np.isfinite(each).all(axis=1)) for each in (found, truth))
    if not len(mine) or not len(others):
        return truth_of
    reach = distance_max * (1.0 + 1e-9)  # scipy rounds the distance in another way
    pairs = cKDTree(found[mine]).sparse_distance_matrix(cKDTree(truth[others]), reach, output_type="ndarray")
    row, column = pairs["i"], pairs["j"]
    distance = np.hypot(*(found[mine[row]] - truth[others[column]]).T)
    near = distance <= distance_max
    # Each position may also stay alone, which costs more than all pairs together. A cost of 0 would be no
    # entry of the sparse matrix, so all costs are increased by the same amount.
    alone = np.arange(len(mine))
    cost = np.append(distance[near], np.full(len(mine), (min(len(mine), len(others)) + 1) * distance_max))
    entries = np.append(row[near], alone), np.append(column[near], len(others) + alone)
    graph = coo_array((cost + distance_max, entries), shape=(len(mine), len(others) + len(mine)))
    chosen, partner = min_weight_full_bipartite_matching(graph.tocsr())
    paired = partner < len(others)
    truth_of[mine[chosen[paired]]] = others[partner[paired]]
    return truth_of


# A ground truth is doubtful if less than this share of at least so many trees matches.
_DOUBTFUL_SHARE, _DOUBTFUL_TREES = 0.25, 4


@dataclass(frozen=True, slots=True)
class Rate:
    """A count and the total of which it is a part."""

    count: int
    of: int

    @property
    def rate(self) -> float | None:
        """count / of, 0 to 1; None if the total is 0."""
        return self.count / self.of if self.of else None


@dataclass(frozen=True, slots=True)
class MapScores:
    """Scores of a map against the ground truth within reach of the path. Lengths are in metres; an error
    without matched trees, and a share of nothing, is None.

    Attributes:
        TA, FR: True acceptances and false rejections of the real trees; the counts sum to the real trees.
        TR, FA: True rejections and false acceptances of other objects; the counts sum to the other objects.
        spurious: Number of mapped trees at which the ground truth has neither a tree nor another object.
        completeness: Mapped share of the real trees; correctness: share of the mapped trees that are real
            trees; f1: harmonic mean of both.
        position_rmse, position_bias: Position error of the matched trees; the bias is the length of the mean
            error vector.
        dbh_rmse, dbh_bias, dbh_count: DBH error, mean error and number of the matched trees whose diameter is
            known in the map and in the ground truth.
        mean_pair_error_percent, largest_pair_error_percent: See `PairErrors`, for the matched trees.
        reach: Maximum distance between the path and an object of the ground truth that counts.
        beyond: Number of trees and other objects of the ground truth that are farther from the path.
        dbh_ratio: Median DBH of the trees of `dbh_count` in the ground truth, divided by that in the map.
        missed: Positions x, y of the real trees that are not mapped (FR), in the order of the ground truth.
        false: Numbers of the mapped trees that are no real trees (FA and spurious ones), in ascending order.
    """

    TA: Rate
    TR: Rate
    FA: Rate
    FR: Rate
    spurious: int
    completeness: float | None
    correctness: float | None
    f1: float | None
    position_rmse: float | None
    position_bias: float | None
    dbh_rmse: float | None
    dbh_bias: float | None
    dbh_count: int
    mean_pair_error_percent: float | None
    largest_pair_error_percent: float | None
    reach: float
    beyond: int = 0
    dbh_ratio: float | None = None
    missed: tuple[tuple[float, float], ...] = ()
    false: tuple[int, ...] = ()

    @property
    def dbh_factor(self) -> float:
        """How many times too large the diameters of the ground truth are, if their unit is probably wrong: a
        power of ten up to 1000, or down to 0.001. 1 if it is not, or with fewer than four diameters. Errors
        of a diameter do not reach a factor of five in the median."""
        if self.dbh_ratio is None or self.dbh_count < _DOUBTFUL_TREES or self.dbh_ratio <= 0.0:
            return 1.0
        exponent = math.log10(self.dbh_ratio)
        return float(10.0 ** round(exponent)) if 0.7 < abs(exponent) < 3.5 else 1.0

    @property
    def is_doubtful(self) -> bool:
        """Whether the ground truth may belong to another forest or another frame: of the smaller of the two
        sets of trees less than a quarter matches. With fewer than four trees the result is False."""
        mapped = self.TA.count + self.FA.count + self.spurious
        fewer = min(mapped, self.TA.of)
        return fewer >= _DOUBTFUL_TREES and self.TA.count < _DOUBTFUL_SHARE * fewer


def evaluate(trees: Trees, truth: TruthTrees, parameters: Evaluation, path: Float | None = None) -> MapScores:
    """Return the scores of the confirmed trees. Trees and objects beyond the reach of the path do not count;
    a mapped tree that is matched counts if its partner is within reach.

    Args:
        trees: The map.
        truth: Trees and other objects of the ground truth, in the frame of the map. Objects of kind HIDDEN
            count neither way: a tree of the map at one of them is neither right nor wrong.
        parameters: Maximum distance of a match, and maximum distance of the ground truth from the path.
        path: Positions of the robot, shape (N, 2) [m]; None scores the whole ground truth, an empty path
            nothing.
    """
    confirmed = trees.confirmed
    found = trees.position[confirmed]
    position = np.stack([truth.x, truth.y], axis=1)
    is_tree = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    counts = np.array([k != HIDDEN for k in truth.kind], np.bool_)
    in_reach = _within(position, path, parameters.reach) & counts
    truth_of = match(found, position, parameters.match_distance)
    matched = truth_of >= 0
    hit = np.zeros(len(position), np.bool_)
    hit[truth_of[matched]] = True
    counted = _within(found, path, parameters.reach)
    counted[matched] = in_reach[truth_of[matched]]
    right = matched & counted
    right[matched] &= is_tree[truth_of[matched]]
    spurious = int(np.count_nonzero(counted & ~matched))
    missed = ~hit & in_reach & is_tree
    completeness = Rate(_count(hit & in_reach & is_tree), _count(in_reach & is_tree))
    correctness = Rate(_count(right), _count(counted)).rate
    offset = found[right] - position[truth_of[right]]
    dbh = np.stack([trees.dbh[confirmed][right], truth.dbh[truth_of[right]]])
    dbh = dbh[:, np.isfinite(dbh).all(axis=0)]
    dbh_error = dbh[0] - dbh[1]
    pairs = pair_errors(found[right], position[truth_of[right]])
    return MapScores(
        TA=completeness,
        TR=Rate(_count(~hit & in_reach & ~is_tree), _count(in_reach & ~is_tree)),
        FA=Rate(_count(hit & in_reach & ~is_tree), _count(in_reach & ~is_tree)),
        FR=Rate(_count(missed), _count(in_reach & is_tree)),
        spurious=spurious,
        completeness=completeness.rate,
        correctness=correctness,
        f1=_harmonic(completeness.rate, correctness),
        position_rmse=_rms(np.hypot(*offset.T)),
        position_bias=float(np.hypot(*offset.mean(axis=0))) if len(offset) else None,
        dbh_rmse=_rms(dbh_error),
        dbh_bias=float(dbh_error.mean()) if len(dbh_error) else None,
        dbh_count=len(dbh_error),
        mean_pair_error_percent=_none(pairs.mean),
        largest_pair_error_percent=_none(pairs.largest),
        reach=parameters.reach,
        beyond=_count(counts & ~in_reach),
        dbh_ratio=float(np.median(dbh[1]) / np.median(dbh[0])) if len(dbh_error) else None,
        missed=tuple((float(x), float(y)) for x, y in position[missed]),
        false=tuple(sorted(trees.number[confirmed][counted & ~right].tolist())),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
    """Errors of the distances between all pairs of N trees (Fig. 7).

    Attributes:
        percent: shape (N, N): 100 |d_map - d_truth| / d_truth, 0 on the diagonal.
        mean: Mean over the pairs [%], NaN for fewer than two trees.
        largest: Maximum over the pairs [%], NaN for fewer than two trees.
    """

    percent: Float
    mean: float
    largest: float


def pair_distances(position: Float) -> Float:
    """Return the distances between all pairs of N positions (Fig. 6), shape (N, N) [m], 0 on the diagonal.

    Args:
        position: Positions, shape (N, 2) [m].
    """
    difference = position[:, None, :] - position[None, :, :]
    distances: Float = np.hypot(difference[..., 0], difference[..., 1])
    return distances


def pair_errors(found: Float, truth: Float) -> PairErrors:
    """Return the errors of the distances between N mapped trees. Pairs at the same place in the ground truth
    have the error 0.

    Distances do not depend on the frame, so the two maps need no alignment.

    Args:
        found: Positions of the mapped trees, shape (N, 2) [m].
        truth: Positions of the same trees in the ground truth, in the same order, shape (N, 2) [m].
    """
    d_map, d_truth = pair_distances(found), pair_distances(truth)
    apart = d_truth > 0.0
    percent = np.zeros_like(d_truth)
    percent[apart] = 100.0 * np.abs(d_map - d_truth)[apart] / d_truth[apart]
    pairs = percent[np.triu_indices(len(found), k=1)]
    if len(pairs) == 0:
        return PairErrors(percent, float("nan"), float("nan"))
    return PairErrors(percent, float(pairs.mean()), float(pairs.max()))


_PATH_ROWS = 16_384  # in one tree of positions, which takes more memory than they do


def _within(position: Float, path: Float | None, reach: float) -> Bool:
    """Return which positions are at most `reach` from a position of the path, shape (N,): all if the path is
    None, none if it is empty.

    Args:
        position: Positions, shape (N, 2) [m].
        path: Positions of the robot, shape (M, 2) [m], or None.
        reach: Maximum distance [m].
    """
    if path is None or len(position) == 0:
        return np.ones(len(position), np.bool_)
    from scipy.spatial import cKDTree

    near = np.zeros(len(position), np.bool_)
    for start in range(0, len(path), _PATH_ROWS):
        far = np.flatnonzero(~near)
        if not len(far):
            break
        distance, _ = cKDTree(path[start : start + _PATH_ROWS]).query(position[far])
        near[far] = distance <= reach
    return near


def _count(mask: Bool) -> int:
    """Return the number of true elements."""
    return int(np.count_nonzero(mask))


def _none(value: float) -> float | None:
    """Return a number, or None if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _harmonic(a: float | None, b: float | None) -> float | None:
    """Return the harmonic mean of two shares; 0 if both are 0, None if one is None."""
    if a is None or b is None:
        return None
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _rms(error: Float) -> float | None:
    """Return the root mean square of errors, shape (N,); None without any."""
    return float(np.sqrt((error**2).mean())) if len(error) else None


@dataclass(frozen=True, slots=True)
class PathError:
    """Distances between the path and the true path at the times of the true path.

    Attributes:
        rms, median, largest: Over all compared positions [m].
        compared: Number of true positions within the time of the path.
        aligned: Whether a rigid motion was fitted first.
    """

    rms: float
    median: float
    largest: float
    compared: int
    aligned: bool


def path_error(path: Path, truth: TruthPath, *, align: bool | None = None) -> PathError | None:
    """Return the error of a path, or None if it has fewer than two poses or fewer than three true positions
    are within its time. The path is interpolated linearly at the times of the true positions.

    Args:
        path: In the frame of the map.
        truth: In the frame of the map or in another one.
        align: Whether to fit a rigid motion in the plane first; None fits it if the frames differ.
    """
    if len(path.stamp_ns) < 2:
        return None
    common = (truth.stamp_ns >= path.stamp_ns[0]) & (truth.stamp_ns <= path.stamp_ns[-1])
    if np.count_nonzero(common) < 3:
        return None
    t = truth.stamp_ns[common]
    ours = np.stack([_at(t, path.stamp_ns, path.x), _at(t, path.stamp_ns, path.y)], axis=1)
    theirs = np.stack([truth.x[common], truth.y[common]], axis=1)
    aligned = not truth.same_frame if align is None else align
    if aligned:
        ours = fit_rigid(ours, theirs).apply(ours)
    distance = np.hypot(*(ours - theirs).T)
    return PathError(
        rms=float(np.sqrt((distance**2).mean())),
        median=float(np.median(distance)),
        largest=float(distance.max()),
        compared=len(distance),
        aligned=aligned,
    )


def fit_rigid(a: Float, b: Float) -> Pose2:
    """Return the pose T_b_a that minimises sum |b - T_b_a a|^2 over N pairs of points (Umeyama 1991, without
    scale), N > 0; the yaw is 0 for coincident points.

    Args:
        a, b: Points in the two frames, shape (N, 2) [m] each.
    """
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    M = (a - mean_a).T @ (b - mean_b)
    yaw = float(np.arctan2(M[0, 1] - M[1, 0], M[0, 0] + M[1, 1]))
    turned = Pose2(0.0, 0.0, yaw).apply(mean_a[None, :])[0]
    return Pose2(float(mean_b[0] - turned[0]), float(mean_b[1] - turned[1]), yaw)


def _at(wanted_ns: Int, stamp_ns: Int, value: Float) -> Float:
    """Return values interpolated linearly at other times, shape (K,); outside of the times the first or last
    value.

    Args:
        wanted_ns: Times [ns], int64, shape (K,).
        stamp_ns: Times of the values, ascending [ns], int64, shape (N,), N > 0.
        value: Values, shape (N,).
    """
    start = stamp_ns[0]  # int64 nanoseconds since the epoch do not fit a float; differences do
    result: Float = np.interp((wanted_ns - start) * 1e-9, (stamp_ns - start) * 1e-9, value)
    return result
