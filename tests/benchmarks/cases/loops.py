"""Loops compared with the exact truth: ten simulated minutes with poor wheel odometry."""

from __future__ import annotations

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

NAME = "loops"
LINE = "sim:long with poor odometry: error of path, map and pair distances"
URI = "sim:long?odometry=poor"
SEEDS = range(1, 4)


def run() -> list[Table]:
    """Three seeds of SLAM over one simulated run, and a comparison of the methods."""
    import numpy as np

    from pipeline.evaluation import evaluate, path_error
    from tests.benchmarks.slam_runs import by_method, mapped, seen_in

    rows, truth, parameters = seen_in(URI)
    assert truth.trees is not None
    assert truth.path is not None
    odometry = np.array([row.odometry.as_array()[:2] for row in rows])
    at = [np.interp([r.stamp_ns for r in rows], truth.path.stamp_ns, c) for c in (truth.path.x, truth.path.y)]
    alone = np.hypot(*(odometry - np.column_stack(at)).T)
    table: list[tuple[Cell, ...]] = []
    for seed in chosen_seeds(SEEDS):
        done = mapped(rows, truth, parameters, seed)
        error = path_error(done.path, truth.path, align=False)
        path = np.stack([done.path.x, done.path.y], axis=1)
        found = evaluate(done.tree_table, truth.trees, parameters.evaluation, path)
        rms = error.rms if error else None
        pairs = found.mean_pair_error_percent
        table.append((seed, rms, done.trees, done.duplicates, found.spurious, pairs))
    columns = ("seed", "path RMS [m]", "trees", "duplicates", "spurious", "mean pair error [%]")
    note = f"Odometry alone: {alone.max():.1f} m at the most. Not aligned; the first pose is the origin."
    long = Table(f"{URI}: SLAM and tracking", columns, tuple(table), (note,))
    return [long, by_method(rows, truth, parameters, f"{URI} by `slam.method`, aligned")]
