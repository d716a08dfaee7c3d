"""Strategies and small builders that the tests of the stages share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from pipeline.detection.free_space import BINS
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import (
    Clusters,
    Detections,
    Labels,
    Landmarks,
    PoseEstimate,
    Scan,
    Sensor,
    Step,
    Trees,
    TruthTrees,
    Verdict,
)

SENSOR = Sensor("VLP-16", rings=16, ring_step=np.radians(2.0), azimuth_step=np.radians(0.2), range_sigma=0.02)
NOTHING_SEEN = np.zeros(BINS)
ALL_FREE = np.full(BINS, np.inf)

angles = st.floats(-30.0, 30.0, allow_nan=False)
metres = st.floats(-50.0, 50.0, allow_nan=False)
seeds = st.integers(0, 2**32 - 1)
poses2 = st.builds(Pose2, metres, metres, st.floats(-3.1, 3.1))
poses3 = st.builds(
    lambda x, y, z, roll, pitch, yaw: Pose3.from_euler(np.array([x, y, z]), roll, pitch, yaw),
    metres,
    metres,
    metres,
    st.floats(-3.1, 3.1),
    st.floats(-1.5, 1.5),
    st.floats(-3.1, 3.1),
)


def first_of(values: Iterable[Any]) -> list[Any]:
    """Return the values of a parameter of a test: the first for the default run, the others marked slow."""
    first, *others = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*first), *(pytest.param(*other, marks=pytest.mark.slow) for other in others)]


def arc(radius, half_angle, *, distance=4.0, bearing=0.0, rows=6, n=60, height=1.0, lean=(0.0, 0.0)):
    """Points evenly along the arc of a trunk that faces the sensor, float64, shape (rows * n, 3)."""
    turn = np.linspace(-half_angle, half_angle, n) + np.pi + bearing
    z = np.linspace(0.0, height, rows)
    turn, z = (grid.ravel() for grid in np.meshgrid(turn, z))
    x = distance * np.cos(bearing) + radius * np.cos(turn) + lean[0] * (z - z.mean())
    y = distance * np.sin(bearing) + radius * np.sin(turn) + lean[1] * (z - z.mean())
    return np.stack([x, y, z], axis=1)


def one_cluster(points):
    """Labels that put all points into one cluster."""
    return Labels(np.zeros(len(points), np.int32), 1, np.zeros(1, np.bool_))


def scan(stamp_ns, points=(), offset_ns=None):
    """A scan from rows of points."""
    rows = np.asarray(points, np.float32).reshape(-1, 3)
    return Scan(stamp_ns, rows, offset_ns=None if offset_ns is None else np.asarray(offset_ns, np.int32))


def step(index, points=(), pose=None, **rest: Any):
    """A step at 10 Hz."""
    at_ns, period_ns = index * 100_000_000, 100_000_000
    return Step(index, scan(1 + at_ns, points), pose, elapsed_ns=at_ns, period_ns=period_ns, **rest)


def detections(centre, *, sigma=0.03, radius=0.15, arc=1.0):
    """Detections at rows of x, y in the base frame."""
    rows = np.asarray(centre, np.float64).reshape(-1, 2)
    n = len(rows)
    return Detections(
        cluster=np.arange(n),
        centre=rows,
        covariance=np.tile(np.eye(2) * sigma**2, (n, 1, 1)),
        radius=np.full(n, radius),
        radius_sigma=np.full(n, 0.02),
        arc=np.full(n, arc),
        eccentricity=np.full(n, 5.0),
    )


def track(tracker, stamp_ns, pose, covariance, found, *, births=None, gone=(), heights=None, score=None):
    """Update a tracker with a scan, as SLAM would associate it.

    Args:
        tracker: The tracker.
        stamp_ns: Time of the scan.
        pose, covariance: Pose of the base and its covariance.
        found: Detections.
        births: Landmark of each detection; by default the row.
        gone: Landmarks of trees that the map of SLAM no longer holds.
        heights: See `Tracker.process`.
        score: Score of landmarks by birth; 1 for others.
    """
    births = np.arange(len(found.cluster)) if births is None else np.asarray(births, np.int64)
    old = tracker.tracks.landmark
    old = np.flatnonzero((old >= 0) & ~np.isin(old, births) & ~np.isin(old, gone))
    mine = births >= 0
    position = np.concatenate([pose.apply(found.centre[mine]), tracker.tracks.x[old, :2]])
    birth = np.concatenate([births[mine], tracker.tracks.landmark[old]])
    landmarks = Landmarks(
        birth,
        position,
        np.tile([1e-4, 0.0, 1e-4], (len(position), 1)),
        np.array([(score or {}).get(int(b), 1.0) for b in birth]),
        gate=3.5,
        distance_max=1.0,
    )
    estimate = PoseEstimate(
        pose, covariance, pose.as_array()[None], np.ones(1), 1.0, position, landmark_of=births
    )
    tracker.process(stamp_ns, estimate, found, landmarks, heights)


def clusters(**columns: Any):
    """One cluster that is a tree by every rule of the preset forest, but for the columns given."""
    good = Clusters(
        size=np.array([60]),
        centroid=np.array([[4.0, 0.0, 0.5]]),
        eccentricity=np.array([5.0]),
        centre=np.array([[4.2, 0.0]]),
        covariance=np.eye(2)[None] * 1e-4,
        radius=np.array([0.2]),
        radius_sigma=np.array([0.01]),
        radial_std=np.array([0.01]),
        arc=np.array([2.0]),
        extent=np.array([[0.2, 0.4, 1.0]]),
        hidden=np.array([False]),
        cut=np.array([False]),
        verdict=np.array([Verdict.OTHER], np.int32),
    )
    return replace(good, **{name: np.asarray(value) for name, value in columns.items()})


def trees(position, *, dbh=0.3, confirmed=True):
    """A map of trees at rows of x, y."""
    rows = np.asarray(position, np.float64).reshape(-1, 2)
    n = len(rows)
    return Trees(
        number=np.arange(1, n + 1),
        position=rows,
        covariance=np.tile(np.eye(2) * 1e-4, (n, 1, 1)),
        dbh=np.full(n, dbh),
        dbh_sigma=np.full(n, 0.01),
        eccentricity=np.full(n, 5.0),
        observations=np.full(n, 9),
        coverage=np.full(n, 2.0),
        first_seen_ns=np.zeros(n, np.int64),
        last_seen_ns=np.full(n, 10**9),
        confirmed=np.full(n, confirmed),
    )


def truth_trees(position, kinds=None, *, dbh=0.3):
    """True trees (or other things) at rows of x, y."""
    rows = np.asarray(position, np.float64).reshape(-1, 2)
    return TruthTrees(rows[:, 0], rows[:, 1], np.full(len(rows), dbh), tuple(kinds or ("tree",) * len(rows)))


def simulated_cloud(duration=1, scan_index=3):
    """Points of one scan of the paper's scenario, level sensor frame, float32, shape (N, 3)."""
    from pipeline.io.readers import open_source

    source = open_source(f"sim:paper?duration={duration}")
    scans = [record for record in source.records() if isinstance(record, Scan)]
    return scans[scan_index].points
