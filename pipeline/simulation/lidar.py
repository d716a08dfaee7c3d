"""The simulated LiDAR: a VLP-16 that spins while the robot drives, so each scan is distorted by motion.

One sweep has 1,800 columns of 16 rays. It begins behind the robot and turns clockwise seen from above,
as the real sensor does: column c looks along the azimuth pi - c * 0.2 degrees at c * 100 ms / 1800
after the stamp of the scan, which is the sweep's start. All 16 lasers of a column fire at once. Points
are in the sensor's frame at their own time; that is what a driver gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.simulation.primitives import Solids
from pipeline.simulation.ray_casting import first_returns, ray_directions
from pipeline.simulation.receiver import measure, pack_returns
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Float, Int32, Scan, Sensor


@dataclass(frozen=True, slots=True)
class SpinningLidar:
    """A spinning LiDAR. The defaults are a VLP-16 at 10 Hz.

    Attributes:
        columns: Shots per turn.
        rings: Lasers.
        lowest: Elevation of ring 0 [rad].
        ring_step: Between neighbouring rings [rad].
        period_ns: Of one turn.
        range_min, range_max: [m].
        range_sigma: Standard deviation of a range [m].
        divergence: Full width of a beam [rad].
        pulse: Echoes nearer to one another than this melt into one [m].
        strength: Reflectivity 1 seen head-on at this range returns with 63 % [m].
    """

    columns: int = 1800
    rings: int = 16
    lowest: float = float(np.radians(-15.0))
    ring_step: float = float(np.radians(2.0))
    period_ns: int = 100_000_000
    range_min: float = 0.5
    range_max: float = 100.0
    range_sigma: float = 0.02
    divergence: float = 0.003
    pulse: float = 0.6
    strength: float = 110.0

    @property
    def sensor(self) -> Sensor:
        """What the pipeline is told of it."""
        return Sensor(
            name="VLP-16 (simulated)",
            rings=self.rings,
            ring_step=self.ring_step,
            azimuth_step=2.0 * np.pi / self.columns,
            # No sensor is perfect, and the pipeline divides by it.
            range_sigma=max(self.range_sigma, 0.001),
            range_max=self.range_max,
        )

    def column_offsets_ns(self) -> Int32:
        """Time of each column after the start of the sweep [ns], shape (C,)."""
        offsets = np.arange(self.columns, dtype=np.int64) * self.period_ns // self.columns
        return offsets.astype(np.int32)

    def beams(self) -> Float:
        """Unit directions of all rays in the sensor's frame, shape (C, K, 3)."""
        azimuth = np.pi - np.arange(self.columns) * (2.0 * np.pi / self.columns)
        elevation = self.lowest + np.arange(self.rings) * self.ring_step
        out = np.empty((self.columns, self.rings, 3))
        out[:, :, 0] = np.cos(azimuth)[:, None] * np.cos(elevation)
        out[:, :, 1] = np.sin(azimuth)[:, None] * np.cos(elevation)
        out[:, :, 2] = np.sin(elevation)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One sweep and what each of its points belongs to.

    Attributes:
        scan: As the driver gives it.
        solid: int32, shape (N,): row in the solids that were cast, -2 for the ground.
    """

    scan: Scan
    solid: Int32


def sweep_scene(
    lidar: SpinningLidar,
    solids: Solids,
    terrain: Terrain,
    R: Float,
    o: Float,
    stamp_ns: int,
    rng: np.random.Generator,
) -> Sweep:
    """One sweep.

    Args:
        lidar: The sensor.
        solids: What stands there at this time.
        terrain: The ground.
        R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        stamp_ns: Start of the sweep.
        rng: Of this sweep alone.
    """
    key = int(rng.integers(0, 2**62))
    noise = lidar.range_sigma * rng.standard_normal((lidar.columns, lidar.rings))
    beams = _beams(lidar)
    directions = ray_directions(R, beams)
    away = np.hypot(*(solids.capsule[:, :2] - o[lidar.columns // 2, :2]).T)
    ranges, hit = first_returns(
        solids.kind,
        solids.shape,
        solids.capsule,
        terrain.packed,
        R,
        o,
        directions,
        lidar.lowest,
        lidar.ring_step,
        lidar.range_max,
        key,
        np.argsort(away, kind="stable"),
    )
    reported, reflectance, source = measure(
        ranges,
        hit,
        solids.kind,
        solids.shape,
        solids.surface,
        terrain.packed,
        o,
        directions,
        lidar.divergence,
        lidar.pulse,
        0.25,
        lidar.strength,
        lidar.range_min,
        lidar.range_max,
        noise,
        key,
    )
    points, shade, ring, offset_ns, solid = pack_returns(
        reported, reflectance, source, beams, lidar.column_offsets_ns()
    )
    return Sweep(Scan(stamp_ns, points, shade, ring, offset_ns), solid)


@lru_cache(maxsize=4)
def _beams(lidar: SpinningLidar) -> Float:
    return lidar.beams()
