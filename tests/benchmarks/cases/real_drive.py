"""A real drive without odometry: trees that are mapped twice when the robot returns.

The recording is `moving/vlp16_campus_loop` of the shared data. Its alley is driven twice, 35 s apart. The
reference of the path is a graph of registrations of its scans: the steps of LiDAR odometry, and loops between
scans of both visits that are registered directly (GICP), solved with GTSAM.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.types.records import Float, Frame

    #: Stamp [ns] and de-skewed points in the level base frame, shape (N, 3) [m].
    Cloud = tuple[int, Float]

NAME = "real_drive"
LINE = "Real drive of a VLP-16 without odometry: trees that stand twice, and the path"
SEEDS = range(5)
NEAR, LATER_S = 0.8, 10.0  # m, s
APART_S = 15.0  # s between two visits of a place
REACH = 6.0  # m between two scans that are registered as a loop
EVERY = 8  # scans between two loops
FITS = 0.6  # minimum share of matched points of a loop
STEP_SIGMA, LOOP_SIGMA = (0.02, 0.002), (0.10, 0.01)  # m, rad


def run() -> list[Table]:
    """All seeds."""
    import numpy as np

    from tests.benchmarks.golden import DATA

    rows = list[tuple[Cell, ...]]()
    folder = DATA / "moving" / "vlp16_campus_loop"
    reference: Float | None = None
    for seed in chosen_seeds(SEEDS):
        path, trees, clouds, odometry = _mapped(str(folder), seed, keep=reference is None)
        if reference is None:
            reference = _reference(clouds, odometry)
        off = np.hypot(*(path[:, :2] - reference[:, :2]).T)
        row = (seed, len(trees), _doubles(trees), float(np.sqrt(np.mean(off**2))), float(off.max()))
        print(row, file=sys.stderr, flush=True)
        rows.append(row)
    columns = ("seed", "trees", f"pairs within {NEAR} m", "path RMS [m]", "path largest [m]")
    return [Table(LINE, columns, tuple(rows), (f"Pairs: first seen more than {LATER_S:.0f} s apart.",))]


def _mapped(uri: str, seed: int, *, keep: bool) -> tuple[Float, Float, Sequence[Cloud], Float]:
    """Map the drive; return its path, the confirmed trees (x, y, time first seen), its clouds (if `keep`),
    and its odometry."""
    import numpy as np

    from app.sources.request import with_odometry
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps
    from pipeline.preprocessing import acquire

    source, _ = with_odometry(open_source(uri), "auto")
    about = source.description
    mapper = Mapper(preset(about.preset), sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=seed)
    clouds, frames = list["Cloud"](), list["Frame"]()
    for step in steps(source.records()):
        frames.append(mapper.process(step))
        if keep:
            points, sensor = acquire(step, about.T_base_lidar, mapper.parameters.acquisition)
            clouds.append((step.scan.stamp_ns, points + sensor))
    trees, odometry = frames[-1].trees, [frame.T_odom_base.as_array() for frame in frames]
    found = trees.confirmed
    first = (trees.first_seen_ns[found] - mapper.path.stamp_ns[0]) * 1e-9
    path = np.stack([mapper.path.x, mapper.path.y, mapper.path.yaw], axis=1)
    return path, np.column_stack([trees.position[found], first]), clouds, np.array(odometry)


def _doubles(trees: Float) -> int:
    """The number of pairs of trees within NEAR that were first seen more than LATER_S apart."""
    import numpy as np

    apart = np.hypot(*(trees[:, None, :2] - trees[None, :, :2]).transpose(2, 0, 1))
    later = np.abs(trees[:, None, 2] - trees[None, :, 2]) > LATER_S
    return int(np.count_nonzero((apart < NEAR) & later)) // 2


def _reference(clouds: Sequence[Cloud], odometry: Float) -> Float:
    """The path x, y, yaw of the graph (GTSAM): steps of the odometry, and loops by GICP between scans of two
    visits."""
    import gtsam
    import numpy as np

    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    step_noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([STEP_SIGMA[0]] * 2 + [STEP_SIGMA[1]]))
    loop_noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0),
        gtsam.noiseModel.Diagonal.Sigmas(np.array([LOOP_SIGMA[0]] * 2 + [LOOP_SIGMA[1]])),
    )
    poses = [gtsam.Pose2(*row) for row in odometry]
    graph.add(gtsam.PriorFactorPose2(0, poses[0], gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    for k, pose in enumerate(poses):
        initial.insert(k, pose)
        if k:
            graph.add(gtsam.BetweenFactorPose2(k - 1, k, poses[k - 1].between(pose), step_noise))
    for k in range(0, len(clouds), EVERY):
        away = np.hypot(*(odometry[:k, :2] - odometry[k, :2]).T)
        times = np.array([stamp_ns for stamp_ns, _ in clouds[:k]])
        away[times > clouds[k][0] - APART_S * 1e9] = np.inf
        if not len(away) or away.min() > REACH:
            continue
        first = int(np.argmin(away))
        loop = _registered(clouds[first][1], clouds[k][1], odometry[first], odometry[k])
        if loop is not None:
            graph.add(gtsam.BetweenFactorPose2(first, k, gtsam.Pose2(*loop), loop_noise))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    at = [solved.atPose2(k) for k in range(len(poses))]
    return np.array([[p.x(), p.y(), p.theta()] for p in at])


def _registered(first: Float, second: Float, at: Float, later: Float) -> Float | None:
    """The pose x, y, yaw of the second cloud relative to the first one by GICP; None if the registration
    fails."""
    import numpy as np
    import small_gicp

    from pipeline.geometry.poses import Pose2, Pose3

    guess = Pose2(*at).inverse() @ Pose2(*later)
    T = np.eye(4)
    T[:3, :3], T[:2, 3] = Pose3.from_euler(np.zeros(3), 0.0, 0.0, guess.yaw).R, (guess.x, guess.y)
    clouds = [
        small_gicp.preprocess_points(cloud.astype(np.float64), 0.25, 10, 1) for cloud in (first, second)
    ]
    inliers = 0
    for reach in (3.0, 1.5, 0.8):
        result = small_gicp.align(
            clouds[0][0], clouds[1][0], clouds[0][1], T, "GICP", max_correspondence_distance=reach,
            max_iterations=60,
        )  # fmt: skip
        T, inliers = result.T_target_source, result.num_inliers
    if inliers < FITS * clouds[1][0].size():
        return None
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
