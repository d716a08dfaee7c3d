"""Families of LiDARs in the same stands: 20 s of `sim:wild` seen by each of them, mapped scan by scan.

Development uses seeds from 100 on.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import TYPE_CHECKING

from pipeline.simulation.scenarios import LIDAR_NAMES
from tests.benchmarks.cases.wild import mapped
from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.evaluation import MapScores

NAME = "sensors"
LINE = (
    "Trees of sim:wild (20 s) seen by each family of LiDARs, seeds 20 to 24: completeness, correctness, DBH"
)
SEEDS = range(20, 25)


def run() -> list[Table]:
    """Five stands for each sensor; the last columns are differences from the first sensor, in points."""
    rows = list[tuple[Cell, ...]]()
    base: tuple[float, float] | None = None
    for name in LIDAR_NAMES:
        scores, on = list["MapScores"](), Counter[str]()
        for seed in chosen_seeds(SEEDS):
            row, score, false, _ = mapped(f"sim:wild?seed={seed}&duration=20&lidar={name}", seed)
            scores.append(score)
            on += false
            print(name, *row, dict(false), file=sys.stderr, flush=True)
        found, of = sum(s.TA.count for s in scores), sum(s.TA.of for s in scores)
        false_trees = sum(s.FA.count + s.spurious for s in scores)
        complete = 100.0 * found / max(of, 1)
        correct = 100.0 * found / max(found + false_trees, 1)
        base = base or (complete, correct)
        fitted = max(sum(s.dbh_count for s in scores), 1)
        squares = sum((s.dbh_rmse or 0.0) ** 2 * s.dbh_count for s in scores)
        bias = sum((s.dbh_bias or 0.0) * s.dbh_count for s in scores) / fitted
        rows.append(
            (name, found, of, false_trees, complete, correct, fitted, 100.0 * (squares / fitted) ** 0.5,
             100.0 * bias, complete - base[0], correct - base[1])
        )  # fmt: skip
    columns = (
        "sensor", "found", "of", "false", "completeness [%]", "correctness [%]", "diameters",
        "DBH RMSE [cm]", "DBH bias [cm]", "completeness to VLP-16", "correctness to VLP-16",
    )  # fmt: skip
    return [Table(LINE, columns, tuple(rows))]
