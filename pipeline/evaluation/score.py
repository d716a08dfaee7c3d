"""Scores of a map against the ground truth: TA, TR, FA and FR as in the paper, completeness, correctness, and
the errors of positions, diameters and distances between trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.config.stages import Evaluation
from pipeline.evaluation.matching import match
from pipeline.geometry.poses import Float
from pipeline.types.records import HIDDEN, Bool, Trees, TruthTrees

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
    """Scores of a map against the ground truth within reach of the path. Lengths are in metres; a score
    without matched trees is None.

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
        path: Positions of the robot, shape (N, 2) [m]; None scores the whole ground truth.
    """
    confirmed = trees.confirmed
    found = trees.position[confirmed]
    position = np.stack([truth.x, truth.y], axis=1)
    is_tree = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    in_reach = _within(position, path, parameters.reach) & np.array(
        [k != HIDDEN for k in truth.kind], np.bool_
    )
    truth_of = match(found, position, parameters.match_distance)
    matched = truth_of >= 0
    hit = np.zeros(len(position), np.bool_)
    hit[truth_of[matched]] = True
    counted = _within(found, path, parameters.reach)
    counted[matched] = in_reach[truth_of[matched]]
    right = matched & counted
    right[matched] &= is_tree[truth_of[matched]]
    spurious = int(np.count_nonzero(counted & ~matched))
    completeness = Rate(_count(hit & in_reach & is_tree), _count(in_reach & is_tree))
    correctness = Rate(_count(right), _count(counted)).rate
    offset = found[right] - position[truth_of[right]]
    dbh_error = trees.dbh[confirmed][right] - truth.dbh[truth_of[right]]
    dbh_error = dbh_error[np.isfinite(dbh_error)]
    pairs = pair_errors(found[right], position[truth_of[right]])
    return MapScores(
        TA=completeness,
        TR=Rate(_count(~hit & in_reach & ~is_tree), _count(in_reach & ~is_tree)),
        FA=Rate(_count(hit & in_reach & ~is_tree), _count(in_reach & ~is_tree)),
        FR=Rate(_count(~hit & in_reach & is_tree), _count(in_reach & is_tree)),
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
    if len(path) == 0:
        return np.zeros(len(position), np.bool_)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(path).query(position)
    near: Bool = distance <= reach
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
