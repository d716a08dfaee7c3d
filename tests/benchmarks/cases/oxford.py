"""Stems found in a forest of 1.5 km (Oxford Evo) with made odometry, over ten seeds."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.table import Table

if TYPE_CHECKING:
    from pipeline.records import Detections, Float, Truth
    from tests.benchmarks.slam_runs import Seen

NAME = "oxford"
LINE = "Oxford Evo, 100 particles, ten seeds: error of the path, all frames and every fifth"
SEEDS = range(1, 11)
#: Of the made odometry: parts of the distance, degrees per root of metre, degrees per metre.
DISTANCE, TURN, BIAS = 0.02, 0.5, 0.02
REACH = 20.0  # m; stems farther away are left out
CHANGES: dict[str, object] = {
    "slam.noise_distance": 0.05,
    "slam.noise_turn_distance": 0.6,
    "slam.distance_max": 2.0,
    "slam.view_range": 0.0,
}


def run() -> list[Table]:
    """One table with all frames, one with every fifth; the odometry differs by seed as well."""
    from pipeline.parameters import preset
    from tests.benchmarks.slam_runs import COLUMNS, mapped, summary

    parameters = preset("forest").replace(CHANGES)
    tables = []
    for every in (1, 5):
        frames = (_frames(seed, every) for seed in SEEDS)
        runs = [
            mapped(rows, truth, parameters, seed) for seed, (rows, truth) in zip(SEEDS, frames, strict=True)
        ]
        title = f"{LINE}: every {every}"
        tables.append(Table(title, COLUMNS, tuple(r.row() for r in runs), (summary(runs),)))
    return tables


def _frames(seed: int, every: int) -> tuple[list[Seen], Truth]:
    """Frames levelled by the pose's roll and pitch, with perturbed increments of the trajectory."""
    import numpy as np

    from pipeline.geometry import Pose2, Pose3
    from pipeline.records import Truth, TruthPath
    from pipeline.visibility import BINS
    from tests.benchmarks.slam_runs import Seen

    data = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    evo = np.load(data / "oxford_evo" / "Evo.npz")
    table = evo["trajectory"]
    poses = [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
    stamp = np.rint((table[:, 0] - table[0, 0]) * 1e9).astype(np.int64)
    rng = np.random.default_rng(seed)
    odometry, rows = Pose2(), []
    for k, pose in enumerate(poses):
        if k:
            step = poses[k - 1].planar().inverse() @ pose.planar()
            d = float(np.hypot(step.x, step.y))
            n = rng.standard_normal(2)
            turn = np.radians(TURN * np.sqrt(d) * n[1] + BIAS * d)
            grown = 1.0 + DISTANCE * n[0]
            odometry = odometry @ Pose2(step.x * grown, step.y * grown, step.yaw + float(turn))
        roll, pitch, _ = pose.euler()
        level = Pose3.from_euler(np.zeros(3), roll, pitch, 0.0)
        found = level.apply(evo["xyz"][evo["frame"] == k])[:, :2] if k % every == 0 else np.zeros((0, 2))
        found = found[np.hypot(found[:, 0], found[:, 1]) < REACH]
        rows.append(Seen(int(stamp[k]), odometry, _detections(found), np.zeros(BINS)))
    path = TruthPath(
        stamp,
        table[:, 1],
        table[:, 2],
        np.array([p.planar().yaw for p in poses]),
        same_frame=False,
    )
    return rows, Truth(path=path)


def _detections(centre: Float) -> Detections:
    import numpy as np

    from pipeline.records import Detections

    n = len(centre)
    nothing = np.full(n, np.nan)
    R = np.zeros((n, 2, 2))
    reach = np.hypot(centre[:, 0], centre[:, 1])
    R[:, 0, 0] = R[:, 1, 1] = 0.1**2 + (reach * np.radians(0.4)) ** 2
    return Detections(np.arange(n), centre, R, nothing, nothing, np.zeros(n), nothing)
