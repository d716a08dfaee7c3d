"""stemmap compared with the pipeline that a user would write from the paper with libraries."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.benchmarks import recorded
from tests.benchmarks.process import Side, sides
from tests.benchmarks.table import Cell, Table, ratio
from tests.benchmarks.timing import middle, quantile
from tests.benchmarks.turns import STAGES

if TYPE_CHECKING:
    from pipeline.evaluation import MapScores

NAME = "peer"
LINE = "The whole pipeline beside one written with Open3D, NumPy, filterpy and plain Python"

MODULES = {"ours": "tests.benchmarks.ours", "peer": "tests.benchmarks.peer.pipeline"}
CHUNK = 5  # scans that a side maps before it is the other's turn
BUDGET_S = 70.0  # of one comparison; the peer is slow, and both stop at the same scan
# As in the paper, but with a box all around the robot, 2D clustering and fewer points: about ten trees per
# scan.
_WIDE: dict[str, object] = {
    "filters.x_min": -10.0,
    "clustering.dimensions": 2,
    "clustering.eps": 0.15,
    "clustering.min_points": 8,
}
NOTES = (
    "The peer: Open3D's voxel_down_sample and cluster_dbscan, a NumPy PCA for each cluster, FastSLAM in "
    "Python loops over particles and landmarks (Probabilistic Robotics, table 13.1: every landmark is "
    "asked), a filterpy KalmanFilter for each tree. Same scans, same parameters, other random numbers.",
    "Peak memory is that of the whole process with its interpreter and libraries; neither side simulates.",
)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Input of both sides: a source, the step between its scans, the maximum number of scans, and the
    parameters."""

    uri: str
    stride: int
    scans: int
    preset: str
    changes: dict[str, object]
    words: str


COMPARISONS = (
    Comparison("sim:paper", 3, 110, "paper", {}, "preset paper"),
    Comparison(
        "sim:stand",
        5,
        150,
        "paper",
        _WIDE,
        "preset paper, box all around, 2D clustering (eps 0.15 m, 8 points)",
    ),
)


def run() -> list[Table]:
    """Both comparisons: times, then maps."""
    return [table for comparison in COMPARISONS for table in compare(comparison, BUDGET_S)]


def compare(comparison: Comparison, budget_s: float) -> list[Table]:
    """Map the same scans with both sides in turns."""
    from pipeline.config import preset

    # The peer does not search for obstacles.
    parameters = preset(comparison.preset).replace({**comparison.changes, "obstacles.method": "none"})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recorded.write(comparison.uri, folder, stride=comparison.stride, scans=comparison.scans)
        values = folder / "parameters.json"
        values.write_text(json.dumps(dict(parameters.flat())), encoding="utf-8")
        with sides(MODULES, str(folder), str(values)) as both:
            times = _take_turns(both, comparison.scans, budget_s)
            results = {side: process.ask({"result": True}) for side, process in both.items()}
    n = len(times["peer"])
    on = f"{comparison.uri}, one scan in {comparison.stride}, {n} scans, {comparison.words}"
    return [
        Table(f"Time and memory on {on}", _TIME_COLUMNS, tuple(_time_rows(times, results)), NOTES),
        Table(f"Map of {on}", _MAP_COLUMNS, tuple(_map_rows(comparison, parameters, results))),
    ]


def _take_turns(both: dict[str, Side], scans: int, budget_s: float) -> dict[str, list[dict[str, float]]]:
    times: dict[str, list[dict[str, float]]] = {side: [] for side in both}
    end = time.monotonic() + budget_s
    for _ in range(0, scans, CHUNK):
        for side, process in both.items():
            times[side] += process.ask({"scans": CHUNK})["times"]
        if time.monotonic() > end:
            break
    return times


_TIME_COLUMNS = ("stage", "ours ms", "p99", "peer ms", "p99", "ratio of medians")


def _time_rows(
    times: dict[str, list[dict[str, float]]], results: dict[str, dict[str, Any]]
) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for stage in (*STAGES, "total"):
        ours, peer = ([row[stage] for row in times[side]] for side in ("ours", "peer"))
        rows.append(
            (
                stage,
                middle(ours),
                quantile(ours, 0.99),
                middle(peer),
                quantile(peer, 0.99),
                ratio(middle(peer), middle(ours)),
            )
        )
    ours_mib, peer_mib = results["ours"]["peak_mib"], results["peer"]["peak_mib"]
    rows.append(("peak memory MiB", ours_mib, None, peer_mib, None, ratio(peer_mib, ours_mib)))
    return rows


_MAP_COLUMNS = (
    "side",
    "TA",
    "TR",
    "FA",
    "FR",
    "spurious",
    "position RMSE m",
    "mean pair error %",
    "landmarks",
)


def _map_rows(
    comparison: Comparison,
    parameters: Any,
    results: dict[str, dict[str, Any]],
) -> list[tuple[Cell, ...]]:
    rows: list[tuple[Cell, ...]] = []
    for side, result in results.items():
        e = _judged(comparison.uri, parameters, result)
        rates = [f"{rate.count}/{rate.of}" for rate in (e.TA, e.TR, e.FA, e.FR)]
        rows.append(
            (side, *rates, e.spurious, e.position_rmse, e.mean_pair_error_percent, result["landmarks"])
        )
    return rows


def _judged(uri: str, parameters: Any, result: dict[str, Any]) -> MapScores:
    import numpy as np

    from pipeline.evaluation import evaluate
    from pipeline.io.readers import open_source
    from pipeline.types.records import Trees

    truth = open_source(uri).truth()
    if truth is None or truth.trees is None:
        raise ValueError(f"{uri} has no truth")
    position = np.array(result["trees"], np.float64).reshape(-1, 2)
    n = len(position)
    unknown, ints = np.full(n, np.nan), np.zeros(n, np.int64)
    trees = Trees(
        number=np.arange(1, n + 1),
        position=position,
        covariance=np.zeros((n, 2, 2)),
        dbh=unknown,
        dbh_sigma=unknown,
        eccentricity=unknown,
        observations=ints,
        coverage=np.zeros(n),
        first_seen_ns=ints,
        last_seen_ns=ints,
        confirmed=np.ones(n, np.bool_),
    )
    path = np.array(result["path"], np.float64).reshape(-1, 2)
    return evaluate(trees, truth.trees, parameters.evaluation, path)
