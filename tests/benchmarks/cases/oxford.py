"""Stems of a drive of 1.5 km in a forest (Oxford Evo) read from their folder, with simulated odometry, over
ten seeds."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Table

if TYPE_CHECKING:
    from tests.benchmarks.tree_manager_folder import Recorded

NAME = "oxford"
LINE = "Oxford Evo, 100 particles, ten seeds: error of the path, all frames and every fifth"
SEEDS = range(1, 11)
#: Errors of the simulated odometry: fraction of the length of a step, degrees per root of a metre, degrees
#: per metre.
DISTANCE, TURN, BIAS = 0.02, 0.5, 0.02
COLUMNS = ("seed", "odometry RMS [m]", "RMS [m]", "median [m]", "largest [m]", "trees")


def run() -> list[Table]:
    """Tables with all frames, with every fifth frame, and by method; each seed has another odometry."""
    from tests.benchmarks.tree_manager_folder import read_recorded

    root = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    recorded = read_recorded(root / "oxford_evo" / "Evo.npz")
    return [*(_table(recorded, every) for every in (1, 5)), _methods(recorded)]


def _methods(recorded: Recorded) -> Table:
    """A comparison of the methods over three seeds, each with another odometry."""
    import tempfile

    from tests.benchmarks.slam_runs import METHOD_SEEDS, METHODS
    from tests.benchmarks.tree_manager_folder import write_states

    with tempfile.TemporaryDirectory(prefix="stemmap-oxford-") as folder:
        write_states(recorded, Path(folder), 1)
        rows = []
        for method in METHODS:
            for seed in METHOD_SEEDS:
                begin = time.thread_time()
                row = mapped_folder(recorded, Path(folder), seed, method)
                rows.append((method, *row, time.thread_time() - begin))
    return Table("Oxford Evo by `slam.method`", ("method", *COLUMNS, "s"), tuple(rows), ("s: CPU time.",))


def _table(recorded: Recorded, every: int) -> Table:
    import tempfile

    import numpy as np

    from tests.benchmarks.tree_manager_folder import write_states

    with tempfile.TemporaryDirectory(prefix="stemmap-oxford-") as folder:
        write_states(recorded, Path(folder), every)
        rows = []
        for seed in chosen_seeds(SEEDS):
            rows.append(mapped_folder(recorded, Path(folder), seed))
            print(f"every {every}, seed {seed}: {rows[-1][2]:.3f} m", file=sys.stderr, flush=True)
    rms = [row[2] for row in rows]
    said = f"RMS over {len(rows)} seeds: median {np.median(rms):.3f} m, worst {max(rms):.3f} m"
    return Table(f"{LINE}: every {every}", COLUMNS, tuple(rows), (said,))


def mapped_folder(
    recorded: Recorded, folder: Path, seed: int, method: str | None = None
) -> tuple[int, float, float, float, float, int]:
    """Map the folder with the odometry of a seed, as `stemmap map FOLDER` does."""
    from contextlib import closing

    import numpy as np

    from app.extensions.formats.tree_manager import TRAJECTORY, trajectory_text
    from pipeline.config import preset
    from pipeline.evaluation import path_error
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps
    from tests.benchmarks.tree_manager_folder import perturbed

    told = perturbed(
        recorded.poses,
        distance=DISTANCE,
        turn=np.radians(TURN),
        bias=np.radians(BIAS),
        rng=np.random.default_rng(seed),
    )
    (folder / TRAJECTORY).write_text(trajectory_text(recorded.stamp_ns, told), encoding="utf-8")
    with closing(open_source(str(folder))) as source:
        known = source.description
        p = preset(known.preset)
        p = p if method is None else p.replace({"slam.method": method})
        mapper = Mapper(p, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=seed)
        frame = None
        for step in steps(source.records()):
            frame = mapper.process(step)
    error = path_error(mapper.path, recorded.truth, align=True)
    before = path_error(recorded.path(told), recorded.truth, align=True)
    assert frame is not None
    assert error is not None
    assert before is not None
    trees = int(np.count_nonzero(frame.trees.confirmed))
    return seed, before.rms, error.rms, error.median, error.largest, trees
