"""Evaluation of a map against ground truth: the rates of the paper and the scores of forest inventories."""

from pipeline.evaluation.matching import match, matched_rows
from pipeline.evaluation.score import (
    MapScores,
    PairErrors,
    Rate,
    evaluate,
    pair_distances,
    pair_errors,
)
from pipeline.evaluation.trajectory import PathError, path_error

__all__ = [
    "MapScores",
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
