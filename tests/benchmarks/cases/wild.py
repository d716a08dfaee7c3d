"""Stands as difficult as real forests: `sim:wild`, mapped scan by scan.

The seeds 0 to 19 are for scoring only. Training and development use seeds from 100 on.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from contextlib import closing
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING

from pipeline.evaluation import match
from tests.benchmarks.process import on_cores
from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.evaluation import MapScores
    from pipeline.types.records import Float, Trees, TruthTrees

NAME = "wild"
LINE = "Trees of sim:wild, seeds 0 to 19: completeness, correctness, position, DBH, their 95 % intervals"
SEEDS = range(20)
BESIDE = 1.0  # m; a false tree this near to a tree is a duplicate of it


def run() -> list[Table]:
    """Twenty stands."""
    rows, scores, on = list[tuple[Cell, ...]](), list["MapScores"](), Counter[str]()
    inside = Inside()
    for _, (row, score, false, covered) in on_cores(_stand, chosen_seeds(SEEDS)):
        rows.append(row)
        scores.append(score)
        on += false
        inside += covered
        print(" ".join(str(cell) for cell in row), dict(false), file=sys.stderr, flush=True)
    rows.sort(key=lambda row: row[:1])
    found, of = sum(s.TA.count for s in scores), sum(s.TA.of for s in scores)
    false_trees = sum(s.FA.count + s.spurious for s in scores)
    rows.append(
        ("all", "", found, of, false_trees, 100.0 * found / of, 100.0 * found / max(found + false_trees, 1),
         _pooled([(s.position_rmse, s.TA.count) for s in scores]),
         _pooled([(s.dbh_rmse, s.dbh_count) for s in scores]),
         sum(100.0 * (s.dbh_bias or 0.0) * s.dbh_count for s in scores) / sum(s.dbh_count for s in scores),
         *inside.shares, None)
    )  # fmt: skip
    columns = (
        "seed", "sensor", "found", "of", "false", "completeness [%]", "correctness [%]",
        "position RMSE [cm]", "DBH RMSE [cm]", "DBH bias [cm]", "position in its 95 % interval [%]",
        "DBH in its 95 % interval [%]", "path RMS [cm]",
    )  # fmt: skip
    kinds = ", ".join(f"{n} {kind}" for kind, n in on.most_common())
    return [Table(LINE, columns, tuple(rows), (f"False trees are at: {kinds}.",))]


@dataclass(frozen=True, slots=True)
class Inside:
    """Numbers of positions and diameters inside of their 95 % intervals, and of all."""

    positions: int = 0
    of_positions: int = 0
    diameters: int = 0
    of_diameters: int = 0

    def __add__(self, other: Inside) -> Inside:
        return Inside(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def shares(self) -> tuple[float | None, float | None]:
        """Shares of the positions and of the diameters [%]."""
        parts = ((self.positions, self.of_positions), (self.diameters, self.of_diameters))
        return tuple(100.0 * n / of if of else None for n, of in parts)  # type: ignore[return-value]

    @classmethod
    def of(cls, trees: Trees, truth: TruthTrees, path: Float, distance_max: float, reach: float) -> Inside:
        """Count the confirmed trees that match a real tree within `reach` [m] of the path."""
        import numpy as np
        from scipy.stats import chi2

        real = np.isin(np.array(truth.kind), ("tree", "hidden"))
        place = np.stack([truth.x, truth.y], axis=1)[real]
        rows = np.flatnonzero(trees.confirmed)
        true = match(trees.position[rows], place, distance_max)
        rows, true = rows[true >= 0], true[true >= 0]
        near = np.hypot(*(place[true][:, None] - path[None, ::10]).transpose(2, 0, 1)).min(axis=1) <= reach
        rows, true = rows[near], true[near]
        error = trees.position[rows] - place[true]
        squared = np.einsum(
            "ni,ni->n", error, np.linalg.solve(trees.covariance[rows], error[..., None])[..., 0]
        )
        dbh = (trees.dbh[rows] - truth.dbh[real][true]) / trees.dbh_sigma[rows]
        known = np.isfinite(dbh)
        return cls(
            int(np.count_nonzero(squared <= chi2.ppf(0.95, 2))),
            len(rows),
            int(np.count_nonzero(np.abs(dbh[known]) <= math.sqrt(chi2.ppf(0.95, 1)))),
            int(np.count_nonzero(known)),
        )


def _stand(seed: int) -> tuple[tuple[Cell, ...], MapScores, Counter[str], Inside]:
    return mapped(f"sim:wild?seed={seed}", seed)


def mapped(uri: str, seed: int) -> tuple[tuple[Cell, ...], MapScores, Counter[str], Inside]:
    """One stand by its URI: its row, which begins with the seed, its scores, the objects nearest to its false
    trees, and the counts of its intervals."""
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
    settings = parameters.evaluation
    inside = Inside.of(frame.trees, truth.trees, path, settings.match_distance, settings.reach)
    off = path - np.stack([truth.path.x, truth.path.y], axis=1)[: len(path)]
    row = (
        seed, about.sensor.name.removesuffix(" (simulated)"), e.TA.count, e.TA.of, e.FA.count + e.spurious,
        100.0 * (e.completeness or 0.0), 100.0 * (e.correctness or 0.0),
        *(None if v is None else 100.0 * v for v in (e.position_rmse, e.dbh_rmse, e.dbh_bias)),
        *inside.shares,
        float(100.0 * np.sqrt(np.mean(off**2) * 2.0)),
    )  # fmt: skip
    return row, e, _nearest_kinds(frame.trees, truth.trees, path, settings.match_distance), inside


def _nearest_kinds(trees: Trees, truth: TruthTrees, path: Float, match_distance: float) -> Counter[str]:
    """The nearest object of each false tree within reach of the path: another object, "beside a tree", or
    "nothing"."""
    import numpy as np

    from pipeline.config import preset

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
