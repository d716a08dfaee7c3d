"""TA, TR, FA, FR with their counts, completeness, correctness, and the errors of what was matched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.config.stages import Evaluation as Parameters
from pipeline.evaluation.matching import match
from pipeline.evaluation.pairs import pair_errors
from pipeline.geometry.poses import Float
from pipeline.types.records import Bool, Trees, TruthTrees

_LEAST_TREES = 4
_DOUBTFUL = 0.25  # share of the trees that match


@dataclass(frozen=True, slots=True)
class Rate:
    """A count out of a whole; the rate is None where the whole is empty."""

    count: int
    of: int

    @property
    def rate(self) -> float | None:
        """count / of."""
        return self.count / self.of if self.of else None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The map against the ground truth within reach of the path. Lengths in metres; None where
    nothing was matched.

    Attributes:
        TA, FR: True acceptance and false rejection, of the real trees; they sum to the whole.
        TR, FA: True rejection and false acceptance, of the other things; they sum to the whole.
        spurious: Trees of the map where nothing stands.
        completeness: TA as a rate; correctness: part of the map's trees that are trees; f1: their
            harmonic mean.
        position_rmse, position_bias: Of the matched trees; the bias is the length of the mean error.
        dbh_rmse, dbh_bias: Of the matched trees with a diameter on both sides; dbh_count: how many.
        mean_pair_error_percent, largest_pair_error_percent: Of the distances between matched trees.
        reach: Truth farther than this from the path was not asked for.
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
        """Whether so few of the trees match, of map or truth, whichever has fewer, that the truth may be of
        another forest or in another frame. A few trees tell nothing."""
        mapped = self.TA.count + self.FA.count + self.spurious
        fewer = min(mapped, self.TA.of)
        return fewer >= _LEAST_TREES and self.TA.count < _DOUBTFUL * fewer


def evaluate(
    trees: Trees, truth: TruthTrees, parameters: Parameters, path: Float | None = None
) -> Evaluation:
    """Compare the confirmed trees with the truth.

    Args:
        trees: The map.
        truth: What really stands there, in the frame of the map.
        parameters: The distance of a match, and how far from the path truth is asked for.
        path: shape (N, 2) [m]; None asks for all truth.
    """
    confirmed = trees.confirmed
    found = trees.position[confirmed]
    position = np.stack([truth.x, truth.y], axis=1)
    is_tree = np.array([kind == "tree" for kind in truth.kind], np.bool_)
    asked = _within(position, path, parameters.reach)
    truth_of = match(found, position, parameters.match_distance)
    matched = truth_of >= 0
    hit = np.zeros(len(position), np.bool_)
    hit[truth_of[matched]] = True
    counted = _within(found, path, parameters.reach)
    counted[matched] = asked[truth_of[matched]]
    right = matched & counted
    right[matched] &= is_tree[truth_of[matched]]
    spurious = int(np.count_nonzero(counted & ~matched))
    completeness = Rate(_count(hit & asked & is_tree), _count(asked & is_tree))
    correctness = Rate(_count(right), _count(counted)).rate
    offset = found[right] - position[truth_of[right]]
    wider = trees.dbh[confirmed][right] - truth.dbh[truth_of[right]]
    wider = wider[np.isfinite(wider)]
    pairs = pair_errors(found[right], position[truth_of[right]])
    return Evaluation(
        TA=completeness,
        TR=Rate(_count(~hit & asked & ~is_tree), _count(asked & ~is_tree)),
        FA=Rate(_count(hit & asked & ~is_tree), _count(asked & ~is_tree)),
        FR=Rate(_count(~hit & asked & is_tree), _count(asked & is_tree)),
        spurious=spurious,
        completeness=completeness.rate,
        correctness=correctness,
        f1=_harmonic(completeness.rate, correctness),
        position_rmse=_rms(np.hypot(*offset.T)),
        position_bias=float(np.hypot(*offset.mean(axis=0))) if len(offset) else None,
        dbh_rmse=_rms(wider),
        dbh_bias=float(wider.mean()) if len(wider) else None,
        dbh_count=len(wider),
        mean_pair_error_percent=_none(pairs.mean),
        largest_pair_error_percent=_none(pairs.largest),
        reach=parameters.reach,
    )


def _within(position: Float, path: Float | None, reach: float) -> Bool:
    if path is None or len(position) == 0:
        return np.ones(len(position), np.bool_)
    if len(path) == 0:
        return np.zeros(len(position), np.bool_)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(path).query(position)
    near: Bool = distance <= reach
    return near


def _count(mask: Bool) -> int:
    return int(np.count_nonzero(mask))


def _none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _harmonic(a: float | None, b: float | None) -> float | None:
    if a is None or b is None:
        return None
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _rms(error: Float) -> float | None:
    return float(np.sqrt((error**2).mean())) if len(error) else None
