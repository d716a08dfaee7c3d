"""Stands that are as hard as forests are: `sim:wild`, mapped scan by scan.

The seeds 0 to 19 are for scoring only. Training and development use seeds from 100 on.
"""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import closing
from typing import TYPE_CHECKING

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.evaluation import MapScores
    from pipeline.types.records import Float, Trees, TruthTrees

NAME = "wild"
LINE = "Trees of sim:wild, seeds 0 to 19: completeness, correctness, position, DBH"
SEEDS = range(20)
BESIDE = 1.0  # m; a false tree this near to a tree is a second one of it


def run() -> list[Table]:
    """Twenty stands."""
    rows, scores, on = list[tuple[Cell, ...]](), list["MapScores"](), Counter[str]()
    for seed in chosen_seeds(SEEDS):
        row, score, false = mapped(f"sim:wild?seed={seed}", seed)
        rows.append(row)
        scores.append(score)
        on += false
        print(" ".join(str(cell) for cell in row), dict(false), file=sys.stderr, flush=True)
    found, of = sum(s.TA.count for s in scores), sum(s.TA.of for s in scores)
    false_trees = sum(s.FA.count + s.spurious for s in scores)
    rows.append(
        ("all", "", found, of, false_trees, 100.0 * found / of, 100.0 * found / max(found + false_trees, 1),
         _pooled([(s.position_rmse, s.TA.count) for s in scores]),
         _pooled([(s.dbh_rmse, s.dbh_count) for s in scores]),
         sum(100.0 * (s.dbh_bias or 0.0) * s.dbh_count for s in scores) / sum(s.dbh_count for s in scores),
         None)
    )  # fmt: skip
    columns = (
        "seed", "sensor", "found", "of", "false", "completeness [%]", "correctness [%]",
        "position RMSE [cm]", "DBH RMSE [cm]", "DBH bias [cm]", "path RMS [cm]",
    )  # fmt: skip
    kinds = ", ".join(f"{n} {kind}" for kind, n in on.most_common())
    return [Table(LINE, columns, tuple(rows), (f"False trees are at: {kinds}.",))]


def mapped(uri: str, seed: int) -> tuple[tuple[Cell, ...], MapScores, Counter[str]]:
    """One stand by its URI: its row, which begins with the seed, its scores, and what is nearest to its false
    trees."""
    import numpy as np

    from pipeline.config import preset
    from pipeline.evaluation import evaluate
    from pipeline.io.readers.simulated import open_simulated
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    parameters = preset("forest")
    with closing(open_simulated(uri)) as source:
        about, truth = source.description, source.truth()
        mapper = Mapper(parameters, sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=0)
        frame = [mapper.process(step) for step in steps(source.records())][-1]
    assert truth.trees is not None
    assert truth.path is not None
    path = np.stack([mapper.path.x, mapper.path.y], axis=1)
    e = evaluate(frame.trees, truth.trees, parameters.evaluation, path)
    off = path - np.stack([truth.path.x, truth.path.y], axis=1)[: len(path)]
    row = (
        seed, about.sensor.name.removesuffix(" (simulated)"), e.TA.count, e.TA.of, e.FA.count + e.spurious,
        100.0 * (e.completeness or 0.0), 100.0 * (e.correctness or 0.0),
        *(None if v is None else 100.0 * v for v in (e.position_rmse, e.dbh_rmse, e.dbh_bias)),
        float(100.0 * np.sqrt(np.mean(off**2) * 2.0)),
    )  # fmt: skip
    return row, e, _nearest_kinds(frame.trees, truth.trees, path, parameters.evaluation.match_distance)


def _nearest_kinds(trees: Trees, truth: TruthTrees, path: Float, match_distance: float) -> Counter[str]:
    """What is nearest to the false trees within reach of the path: another object, "beside a tree", or
    "nothing"."""
    import numpy as np

    from pipeline.config import preset
    from pipeline.evaluation import match

    found = trees.position[trees.confirmed]
    place = np.stack([truth.x, truth.y], axis=1)
    reach = preset("forest").evaluation.reach
    near_path = np.hypot(*(found[:, None] - path[None, ::10]).transpose(2, 0, 1)).min(axis=1) <= reach
    kind, kinds = np.array(truth.kind), Counter[str]()
    for row in np.flatnonzero((match(found, place, match_distance) < 0) & near_path):
        away = np.hypot(*(place - found[row]).T)
        n = int(np.argmin(away))
        tree = kind[n] in ("tree", "hidden")
        kinds["nothing" if away[n] > BESIDE else "beside a tree" if tree else str(kind[n])] += 1
    return kinds + Counter(
        str(kind[n])
        for n in match(found, place, match_distance)
        if n >= 0 and kind[n] not in ("tree", "hidden")
    )


def _pooled(parts: list[tuple[float | None, int]]) -> float | None:
    """The RMS over all seeds of an RMS [m] with its count in each seed, in cm."""
    n = sum(count for rms, count in parts if rms is not None)
    if n == 0:
        return None
    return 100.0 * float((sum(count * rms**2 for rms, count in parts if rms is not None) / n) ** 0.5)
