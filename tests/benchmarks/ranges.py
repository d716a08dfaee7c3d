"""Detection of trunks in single scans over distance:
`python -m tests.benchmarks.ranges [--set shape.split_slices=4]`.

Of the trees of simulated scenes that return at least four points in the height band: for how many the scan
has a cluster, and a detection, within 0.4 m; and detections that are no tree, by distance.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise

import numpy as np

from pipeline.config import Parameters, preset
from pipeline.detection.cluster_shape import describe_stems
from pipeline.detection.clustering import cluster
from pipeline.detection.verdicts import classify_clusters, detections
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground import scan_ground
from pipeline.ground.scan_ground import height_above
from pipeline.io.readers import open_source
from pipeline.odometry.synchroniser import steps
from pipeline.preprocessing import acquire, pass_through, voxel_grid
from pipeline.types.records import Float, Float32, Sensor, Step
from tests.benchmarks.package_forest.street_scenes import simulate_street

EDGES = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
NEAR, SEEN, LEAST = 0.4, 0.35, 4

Place = tuple[Step, Pose3, Sensor, Float]


def main() -> None:
    """Print a line for each kind of sensor and distance."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.NAME=VALUE")
    changes = {
        name: json.loads(value) for name, value in (text.split("=") for text in parser.parse_args().set)
    }
    parameters = preset("forest").replace(changes)
    kinds = {"VLP-16": _stands(), "64 rings": _streets(one_way=False), "one way": _streets(one_way=True)}
    for kind, places in kinds.items():
        count = np.zeros((len(EDGES) - 1, 4), np.int64)
        for place in places:
            count += _count(place, parameters)
        for (near, far), (of, clusters, found, others) in zip(pairwise(EDGES), count, strict=True):
            print(
                f"{kind} {near:.0f} to {far:.0f} m: {of} trunks, "
                f"cluster {100 * clusters / max(of, 1):.0f} %, "
                f"detection {100 * found / max(of, 1):.0f} %, {others} detections of other things",
                flush=True,
            )


def _stands() -> Iterator[Place]:
    for scene in ("stand", "slope", "dense"):
        for seed in (21, 22):
            with closing(open_source(f"sim:{scene}?seed={seed}&odometry=exact&duration=41")) as source:
                truth = source.truth()
                assert truth is not None
                assert truth.trees is not None
                tree = np.array([kind == "tree" for kind in truth.trees.kind])
                place = np.stack([truth.trees.x, truth.trees.y], axis=1)[tree]
                about = source.description
                for step in steps(source.records()):
                    if step.index % 80 == 0:
                        yield step, about.T_base_lidar, about.sensor, place


def _streets(*, one_way: bool) -> Iterator[Place]:
    for seed in range(200, 230):
        street = simulate_street(seed, one_way=one_way)
        if one_way or street.sensor.rings == 64:
            yield street.steps[0], street.T_base_lidar, street.sensor, street.trunk[street.returns >= 10]


def _count(place: Place, parameters: Parameters) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    step, T_base_lidar, sensor, trees = place
    p = parameters
    raw, offset = acquire(step, T_base_lidar, p.acquisition)
    boxed = pass_through(raw, p.filters)
    height = height_above(boxed, scan_ground.find_terrain(raw, p.ground))
    points = voxel_grid(scan_ground.in_band(boxed, height, p.ground), p.filters)
    radius = (p.detection.radius_min, p.detection.radius_max)
    _, described = describe_stems(points, cluster(points, sensor, p.clustering), sensor, p.shape, radius)
    found = detections(classify_clusters(described, p.detection), offset, p.detection).centre
    here = _in_base_frame(trees, step.T_odom_base or Pose2())
    reach, away = np.hypot(*here.T), np.hypot(*found.T)
    seen = _returns_near(here, points, offset) >= LEAST
    to_cluster, to_detection = _nearest(here, described.centre + offset[:2]), _nearest(here, found)
    other = _nearest(found, here) > 0.6
    rows = np.zeros((len(EDGES) - 1, 4), np.int64)
    for k, (near, far) in enumerate(pairwise(EDGES)):
        asked = seen & (reach >= near) & (reach < far)
        rows[k, 0] = asked.sum()
        rows[k, 1] = (to_cluster[asked] < NEAR).sum()
        rows[k, 2] = (to_detection[asked] < NEAR).sum()
        rows[k, 3] = (other & (away >= near) & (away < far)).sum()
    return rows


def _in_base_frame(place: Float, pose: Pose2) -> Float:
    c, s = np.cos(pose.yaw), np.sin(pose.yaw)
    moved = place - np.array([pose.x, pose.y])
    return np.stack([c * moved[:, 0] + s * moved[:, 1], c * moved[:, 1] - s * moved[:, 0]], axis=1)


def _returns_near(place: Float, points: Float32, offset: Float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    from scipy.spatial import cKDTree

    if len(place) == 0 or len(points) == 0:
        return np.zeros(len(place), np.int64)
    tree = cKDTree(points[:, :2] + offset[:2])
    return np.asarray(tree.query_ball_point(place, SEEN, return_length=True))


def _nearest(place: Float, other: Float) -> Float:
    from scipy.spatial import cKDTree

    if len(place) == 0 or len(other) == 0:
        return np.full(len(place), np.inf)
    distance: Float = cKDTree(other).query(place)[0]
    return distance


if __name__ == "__main__":
    main()
