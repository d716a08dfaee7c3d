"""Loops against exact truth: ten simulated minutes with poor wheels, and a way over a field after which the
path lies off by more than trees stand apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from tests.benchmarks.wide_ring import Mapped

NAME = "loops"
LINE = "sim:long with poor odometry, and a wide ring over a field: error of path, map and pair distances"
URI = "sim:long?odometry=poor"
SEEDS = range(1, 4)
RING_SEEDS = range(10)


def run() -> list[Table]:
    """Three seeds of SLAM over one simulated run, the methods beside one another, and ten rings."""
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
    for seed in SEEDS:
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
    return [long, by_method(rows, truth, parameters, f"{URI} by `slam.method`, aligned"), ring()]


def ring() -> Table:
    """A wide ring over a field, with and without loops being closed."""
    from pipeline.parameters import preset
    from tests.benchmarks.wide_ring import WideRing, mapped

    rows: list[tuple[Cell, ...]] = []
    for seed in RING_SEEDS:
        apart = preset("stems").replace({"relocalisation.method": "none"})
        without, done = mapped(WideRing(), seed, apart), mapped(WideRing(), seed)
        rows.append((seed, without.told().max(), *_figures(without), *_figures(done), len(done.closed())))
    columns = (
        "seed",
        "largest error [m]",
        "path RMS, not closed [m]",
        "duplicates",
        "path RMS, closed [m]",
        "duplicates, closed",
        "loops closed",
    )
    notes = (
        "Ready stems on a ring of 90 m, half of it without trees, driven 1.3 times; the wheels tell 2 % and "
        "0.11 degrees a metre too much. Largest error: of the pose as told, without closing. Not aligned.",
    )
    return Table("A wide ring over a field", columns, tuple(rows), notes)


def _figures(run: Mapped) -> tuple[float, int]:
    import numpy as np

    from tests.benchmarks.slam_runs import duplicates

    trees = run.frames[-1].trees
    return float(np.sqrt(np.mean(run.errors() ** 2))), duplicates(trees.position[trees.confirmed])
