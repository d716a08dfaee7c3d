"""A constructed run of known size: a lane past thirty trunks, driven there and back, seen by a VLP-16."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Scan, Sensor, Step

TRUNKS = 30
LENGTH = 30.0  # m
STEP = 0.1  # m a scan: 1 m/s at 10 Hz
HEIGHT = 1.0  # m, of the sensor above level ground
RADIUS = 0.15
NOISE = 0.02
EDGE = 30.0  # m; the stand's edge, seen through gaps in one direction of four
SEEN_EDGE = 0.25
MOUNTING = Pose3(np.eye(3), np.array([0.0, 0.0, HEIGHT]))
VLP16 = Sensor("VLP-16", 16, np.radians(2.0), np.radians(0.2), NOISE, 100.0)
PERIOD_NS = 100_000_000

Float = NDArray[np.float64]


def trunks() -> Float:
    """Where the trunks stand, shape (30, 2) [m]: two ragged rows beside the lane."""
    random = np.random.default_rng(1)
    x = np.repeat(np.linspace(0.0, LENGTH, TRUNKS // 2), 2) + random.uniform(-0.4, 0.4, TRUNKS)
    y = np.tile([3.5, -3.5], TRUNKS // 2) + random.uniform(-1.0, 1.0, TRUNKS)
    return np.stack([x, y], axis=1)


def steps() -> Iterator[Step]:
    """There and back, facing forward all the time; perfect odometry."""
    random = np.random.default_rng(2)
    stand = trunks()
    one_way = np.arange(0.0, LENGTH, STEP)
    for index, x in enumerate(np.concatenate([one_way, one_way[::-1]])):
        scan = Scan(index * PERIOD_NS, _sweep(stand - np.array([x, 0.0]), random))
        yield Step(index, scan, Pose2(float(x), 0.0, 0.0), tilt_known=True)


def half() -> int:
    """Number of the first scan on the way back, when all trunks are known."""
    return len(np.arange(0.0, LENGTH, STEP))


def _sweep(stand: Float, random: np.random.Generator) -> NDArray[np.float32]:
    """Returns of one turn, sensor frame: the nearest of trunk, ground and edge along each ray."""
    azimuth = np.tile(np.radians(np.arange(0.0, 360.0, 0.2)), (16, 1))
    elevation = np.radians(np.arange(-15.0, 16.0, 2.0))[:, None]
    edge = np.where(random.uniform(size=azimuth.shape[1]) < SEEN_EDGE, EDGE, np.inf)
    flat = np.minimum(np.tile(edge, (16, 1)), _to_trunks(azimuth[0], stand))
    with np.errstate(divide="ignore"):
        ground = np.where(elevation < 0.0, HEIGHT / -np.tan(np.minimum(elevation, -1e-9)), np.inf)
    flat = np.minimum(flat, ground)
    reach = flat / np.cos(elevation) + random.normal(0.0, NOISE, flat.shape)
    seen = np.isfinite(reach) & (reach < 60.0)
    ray = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation) + 0 * azimuth,
        ],
        axis=2,
    )
    returns: NDArray[np.float32] = (ray * np.where(seen, reach, 0.0)[:, :, None])[seen].astype(np.float32)
    return returns


def _to_trunks(azimuth: Float, stand: Float) -> Float:
    """Level distance to the nearest trunk in each direction, infinite where none stands, shape (A,)."""
    along = np.cos(azimuth)[:, None] * stand[:, 0] + np.sin(azimuth)[:, None] * stand[:, 1]
    beside2 = (stand**2).sum(axis=1) - along**2
    depth2 = RADIUS**2 - beside2
    hit = (depth2 > 0.0) & (along > 0.0)
    distance = np.where(hit, along - np.sqrt(np.maximum(depth2, 0.0)), np.inf)
    nearest: Float = distance.min(axis=1)
    return nearest
