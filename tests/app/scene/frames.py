"""Frames made by hand, so that the scene is tested without the pipeline."""

from __future__ import annotations

import numpy as np

from app.scene.nodes import LabelNodes
from pipeline.geometry.poses import Pose2
from pipeline.types.records import Clusters, Detections, Frame, PoseEstimate, Trees, Verdict


def make_trees(count: int, seed: int = 1) -> Trees:
    """A map of trees on a loose grid; every fifth has no diameter."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(max(count, 1))))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count]
    numbers = np.arange(1, count + 1)
    return Trees(
        number=numbers,
        position=4.0 * (grid - 0.5 * side) + rng.normal(0.0, 0.6, (count, 2)),
        covariance=np.tile(np.array([[4e-4, 1e-4], [1e-4, 2e-4]]), (count, 1, 1)),
        dbh=np.where(numbers % 5 == 0, np.nan, rng.uniform(0.15, 0.5, count)),
        dbh_sigma=np.full(count, 0.01),
        eccentricity=rng.uniform(2.0, 20.0, count),
        observations=rng.integers(5, 200, count),
        coverage=rng.uniform(1.0, 6.0, count),
        first_seen_ns=np.zeros(count, dtype=np.int64),
        last_seen_ns=np.full(count, 10**9, dtype=np.int64),
        confirmed=np.ones(count, dtype=bool),
    )


def make_frame(index: int = 0, *, trees: int = 25, clusters: int = 8, pose: Pose2 | None = None) -> Frame:
    """A scan with clusters of twenty points each around the robot, every second one a tree."""
    rng = np.random.default_rng(index)
    at = pose or Pose2(0.05 * index, 0.0, 0.0)
    angle = np.linspace(0.0, 2.0 * np.pi, clusters, endpoint=False) + 0.1
    centres = np.column_stack([5.0 * np.cos(angle), 5.0 * np.sin(angle)])
    arc = np.linspace(0.0, np.pi, 20)
    ring = 0.15 * np.stack([np.cos(arc), np.sin(arc)], axis=1)
    points = (centres[:, None, :] + ring[None, :, :]).reshape(-1, 2)
    members = np.column_stack([points, rng.uniform(-0.3, 0.6, len(points))]).astype(np.float32)
    noise = rng.uniform(-8.0, 8.0, (30, 3)).astype(np.float32) * np.array([1, 1, 0.1], dtype=np.float32)
    ground = np.column_stack([rng.uniform(-10, 10, (400, 2)), np.full(400, -0.6)]).astype(np.float32)
    verdicts = np.where(np.arange(clusters) % 2 == 0, Verdict.TREE, Verdict.TOO_LONG).astype(np.int32)
    table = Clusters(
        size=np.full(clusters, 20),
        centroid=np.column_stack([centres + np.array([0.0, 0.1]), np.full(clusters, 0.15)]),
        eccentricity=np.where(np.arange(clusters) == 1, np.inf, 5.0 + np.arange(clusters)),
        centre=centres,
        covariance=np.tile(4e-4 * np.eye(2), (clusters, 1, 1)),
        radius=np.full(clusters, 0.15),
        radius_sigma=np.full(clusters, 0.01),
        radial_std=np.full(clusters, 0.02),
        arc=np.full(clusters, np.pi),
        extent=np.full((clusters, 3), 0.3),
        hidden=np.zeros(clusters, dtype=bool),
        cut=np.zeros(clusters, dtype=bool),
        verdict=verdicts,
    )
    rows = np.nonzero(verdicts == Verdict.TREE)[0]
    return Frame(
        index=index,
        stamp_ns=index * 100_000_000,
        raw=np.vstack([members, noise, ground]),
        filtered=np.vstack([members, noise]),
        labels=np.concatenate([np.repeat(np.arange(clusters), 20), np.full(30, -1)]).astype(np.int32),
        clusters=table,
        detections=Detections(
            cluster=rows,
            centre=centres[rows],
            covariance=np.tile(4e-4 * np.eye(2), (len(rows), 1, 1)),
            radius=np.full(len(rows), 0.15),
            radius_sigma=np.full(len(rows), 0.01),
            arc=np.full(len(rows), np.pi),
            eccentricity=table.eccentricity[rows],
        ),
        estimate=PoseEstimate(
            T_map_base=at,
            covariance=np.diag([1e-4, 1e-4, 1e-5]),
            particles=np.array([at.x, at.y, at.yaw]) + rng.normal(0.0, 0.05, (100, 3)),
            weights=np.full(100, 0.01),
            n_eff=80.0,
            landmarks=np.zeros((0, 2)),
        ),
        T_odom_base=Pose2(at.x * 1.02, at.y + 0.001 * index, at.yaw),
        sensor_offset=np.array([0.12, 0.0, 0.62]),
        trees=make_trees(trees),
        counts={"raw": len(members) + 430, "filtered": len(members) + 30},
    )


def texts_of(labels: LabelNodes) -> list[str]:
    """The visible texts."""
    return [label.text for label in labels._shown.values()]
