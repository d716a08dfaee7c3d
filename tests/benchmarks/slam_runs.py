"""Runs for SLAM alone: the detections of each scan are computed once and stored, so that ten seeds need ten
runs of SLAM and tracking and not ten runs of the whole pipeline. The order of calls is that of the mapper."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.config import Parameters, preset
from pipeline.detection.cluster_shape import describe_stems
from pipeline.detection.clustering import cluster
from pipeline.detection.free_space import clear_range
from pipeline.detection.verdicts import classify_clusters, detections
from pipeline.evaluation import path_error
from pipeline.geometry.poses import Pose2
from pipeline.ground import scan_ground
from pipeline.ground.scan_ground import height_above
from pipeline.io.readers import open_source
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquire, pass_through, voxel_grid
from pipeline.slam import FastSlam
from pipeline.tracking import Tracker
from pipeline.types.records import Detections, Float, Path, Trees, Truth
from tests.benchmarks.table import Cell, Table

DUPLICATE = 1.0  # m; two trees of the map nearer than this in a stand of wider spacing


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One scan as the input of SLAM and tracking."""

    stamp_ns: int
    odometry: Pose2
    detections: Detections
    clear: Float


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """Result of a run: error of the path without and with SLAM [m], trees, and pairs of trees nearer than a
    metre."""

    seed: int
    rms: float
    median: float
    largest: float
    trees: int
    duplicates: int
    path: Path
    tree_table: Trees

    def row(self) -> tuple[Cell, ...]:
        """As in a table."""
        return (self.seed, self.rms, self.median, self.largest, self.trees, self.duplicates)


COLUMNS = ("seed", "RMS [m]", "median [m]", "largest [m]", "trees", "duplicates")


def seen_in(uri: str, parameters: Parameters | None = None) -> tuple[list[Seen], Truth, Parameters]:
    """All scans of a source through the stages before SLAM."""
    source = open_source(uri)
    known = source.description
    p = preset(known.preset) if parameters is None else parameters
    rows = []
    for step in steps(source.records()):
        raw, offset = acquire(step, known.T_base_lidar, p.acquisition)
        band = pass_through(raw, p.filters)
        if p.ground.method != "none":
            height = height_above(band, scan_ground.find_terrain(raw, p.ground))
            band = scan_ground.in_band(band, height, p.ground)
        filtered = voxel_grid(band, p.filters)
        labels = cluster(filtered, known.sensor, p.clustering)
        radius = (p.detection.radius_min, p.detection.radius_max)
        _, described = describe_stems(filtered, labels, known.sensor, p.shape, radius)
        found = detections(classify_clusters(described, p.detection), offset, p.detection)
        odometry = step.T_odom_base or Pose2()
        rows.append(Seen(step.scan.stamp_ns, odometry, found, clear_range(raw, filtered, offset)))
    return rows, source.truth() or Truth(), p


def mapped(rows: Sequence[Seen], truth: Truth, parameters: Parameters, seed: int) -> Mapped:
    """SLAM and tracking over a run."""
    slam, tracker = FastSlam(parameters.slam, seed), Tracker(parameters.tracking)
    before: Pose2 | None = None
    sigma = np.zeros(len(rows))
    stamps = np.array([s.stamp_ns for s in rows])
    for k, seen in enumerate(rows):
        motion = Pose2() if before is None else before.inverse() @ seen.odometry
        before = seen.odometry
        at = slam.process(k, motion, seen.detections, seen.clear)
        tracker.process(seen.stamp_ns, at, seen.detections, slam.landmarks())
        if slam.is_smoothing_due and (correction := slam.smooth(k)):
            landmarks = slam.landmarks()
            of_map = slam.map_error(landmarks)
            tracker.correct(correction, stamps[: k + 1], slam.estimate(at), landmarks, of_map)
        sigma[k] = np.sqrt(0.5 * (at.covariance[0, 0] + at.covariance[1, 1]))
    poses = slam.path()
    path = Path(stamps, poses[:, 0], poses[:, 1], poses[:, 2], sigma)
    error = path_error(path, truth.path, align=True) if truth.path else None
    trees = tracker.trees()
    return Mapped(
        seed=seed,
        rms=error.rms if error else float("nan"),
        median=error.median if error else float("nan"),
        largest=error.largest if error else float("nan"),
        trees=int(np.count_nonzero(trees.confirmed)),
        duplicates=duplicates(trees.position[trees.confirmed]),
        path=path,
        tree_table=trees,
    )


METHODS = ("fastslam1", "fastslam2")
METHOD_SEEDS = (1, 2, 3)
METHOD_COLUMNS = ("method", *COLUMNS, "s")


def by_method(rows: Sequence[Seen], truth: Truth, parameters: Parameters, title: str) -> Table:
    """A comparison of the methods on the same scans, three seeds each."""
    table: list[tuple[Cell, ...]] = []
    for method in METHODS:
        changed = parameters.replace({"slam.method": method})
        for seed in METHOD_SEEDS:
            begin = time.thread_time()
            done = mapped(rows, truth, changed, seed)
            table.append((method, *done.row(), time.thread_time() - begin))
    return Table(title, METHOD_COLUMNS, tuple(table), ("s: CPU time of SLAM and tracking.",))


def duplicates(position: Float) -> int:
    """Pairs of trees nearer than a metre, positions of shape (T, 2) [m]."""
    from scipy.spatial import cKDTree

    return len(cKDTree(position).query_pairs(DUPLICATE)) if len(position) else 0


def summary(runs: Sequence[Mapped]) -> str:
    """Median and worst of the RMS over the seeds."""
    rms = [run.rms for run in runs]
    return f"RMS over {len(rms)} seeds: median {np.median(rms):.3f} m, worst {max(rms):.3f} m"
