"""Ten simulated minutes with poor wheels: path, pair distances and spurious trees against exact truth."""

from __future__ import annotations

from tests.benchmarks.table import Table

NAME = "loops"
LINE = "sim:long with poor odometry: error of path and pair distances"
URI = "sim:long?odometry=poor"
SEEDS = range(1, 4)


def run() -> list[Table]:
    """Three seeds of SLAM over one simulated run."""
    import numpy as np

    from pipeline.evaluation import evaluate, path_error
    from tests.benchmarks.slam_runs import mapped, seen_in

    rows, truth, parameters = seen_in(URI)
    assert truth.trees is not None
    assert truth.path is not None
    table: list[tuple[int, float | None, int, int, float | None]] = []
    for seed in SEEDS:
        done = mapped(rows, truth, parameters, seed)
        error = path_error(done.path, truth.path, align=False)
        path = np.stack([done.path.x, done.path.y], axis=1)
        found = evaluate(done.tree_table, truth.trees, parameters.evaluation, path)
        rms = error.rms if error else None
        table.append((seed, rms, done.trees, found.spurious, found.mean_pair_error_percent))
    columns = ("seed", "path RMS [m]", "trees", "spurious", "mean pair error [%]")
    return [Table(LINE, columns, tuple(table))]
