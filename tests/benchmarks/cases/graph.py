"""The pose graph beside FastSLAM 2.0 on the first scans of the long runs, and its time as the graph grows."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.config import Parameters
    from pipeline.types.records import Truth
    from tests.benchmarks.slam_runs import Seen

NAME = "graph"
LINE = "slam.method graph and fastslam2 on the same scans: error of the path, trees, time"
SEED = 1
COLUMNS = ("run", "scans", "method", "RMS [m]", "largest [m]", "trees", "s")
SIMULATED = "sim:long?odometry=poor&duration=120"


def run() -> list[Table]:
    """A row of each run and method; the extra `graph` must be installed.

    Raises:
        StemmapError: It is not.
    """
    import importlib.util

    from pipeline.errors import StemmapError
    from tests.benchmarks.slam_runs import seen_in

    if importlib.util.find_spec("gtsam") is None:
        raise StemmapError("the pose graph is not installed", remedy="Install it: uv sync --extra graph")
    data = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    rows: list[tuple[Cell, ...]] = []
    rows += _rows(SIMULATED, *seen_in(SIMULATED))
    park = data / "victoria_park" / "victoria_park_ascii.zip"
    if park.is_file():
        rows += _rows("Victoria Park", *seen_in(str(park)))
    note = f"Seed {SEED}, the path rigidly aligned in the plane; s: CPU time of SLAM and tracking."
    forest = data / "oxford_evo" / "Evo.npz"
    if forest.is_file():
        rows += _oxford(forest)
    return [Table(LINE, COLUMNS, tuple(rows), (note,))]


def _rows(name: str, rows: Sequence[Seen], truth: Truth, parameters: Parameters) -> list[tuple[Cell, ...]]:
    from tests.benchmarks.slam_runs import mapped

    table: list[tuple[Cell, ...]] = []
    for method in ("fastslam2", "graph"):
        begin = time.thread_time()
        done = mapped(rows, truth, parameters.replace({"slam.method": method}), SEED)
        took = time.thread_time() - begin
        table.append((name, len(rows), method, done.rms, done.largest, done.trees, took))
        print(f"{name}, {method}: {done.rms:.3f} m, {took:.0f} s", file=sys.stderr, flush=True)
    return table


def _oxford(forest: Path) -> list[tuple[Cell, ...]]:
    """Every fifth frame with stems: the graph's time grows with the observations."""
    import tempfile

    from tests.benchmarks.cases.oxford import mapped_folder
    from tests.benchmarks.tree_manager_folder import read_recorded, write_states

    recorded = read_recorded(forest)
    table: list[tuple[Cell, ...]] = []
    with tempfile.TemporaryDirectory(prefix="stemmap-oxford-") as folder:
        write_states(recorded, Path(folder), 5)
        for method in ("fastslam2", "graph"):
            begin = time.thread_time()
            _, _, rms, _, largest, trees = mapped_folder(recorded, Path(folder), SEED, method)
            took = time.thread_time() - begin
            table.append(("Oxford Evo, every fifth", len(recorded.poses), method, rms, largest, trees, took))
            print(f"Oxford Evo, {method}: {rms:.3f} m, {took:.0f} s", file=sys.stderr, flush=True)
    return table
