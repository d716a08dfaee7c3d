"""Evaluation: the map against the ground truth, as in the paper and as in forestry."""

from pipeline.evaluation.matching import match, matched_rows
from pipeline.evaluation.pairs import PairErrors, pair_distances, pair_errors
from pipeline.evaluation.score import Evaluation, Rate, evaluate
from pipeline.evaluation.trajectory import PathError, path_error

__all__ = [
    "Evaluation",
    "PairErrors",
    "PathError",
    "Rate",
    "evaluate",
    "match",
    "matched_rows",
    "pair_distances",
    "pair_errors",
    "path_error",
]
