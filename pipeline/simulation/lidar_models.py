"""Simulated LiDARs by name: spinning ones by their data sheets, and two whose pattern does not repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pipeline.simulation.lidar import SIGMA_MIN, SolidStateLidar, SpinningLidar
from pipeline.types.records import Bool, Float, Float32, Int, Sensor

PERIOD_S = 0.1


@dataclass(frozen=True, slots=True)
class RosetteLidar(SpinningLidar):
    """A LiDAR without rings whose pattern does not repeat. Its rays are on a fine grid, of which each scan
    has those cells that its pattern crosses, in the exact directions of the pattern. The time of a ray
    follows from its azimuth, as that of a spinning LiDAR.

    Attributes:
        spacing: Angle between neighbouring returns if it is coarse [rad], else 0.
        pattern: Name of the pattern in PATTERNS.
        scan: Number of the scan, which moves the pattern on.
    """

    spacing: float = 0.0
    pattern: str = "Mid-360"
    scan: int = 0

    @property
    def sensor(self) -> Sensor:
        """The sensor as the pipeline describes it, without rings; the range sigma is at least SIGMA_MIN."""
        sigma = max(self.range_sigma, SIGMA_MIN)
        dense = Sensor(f"{self.name} (simulated)", range_sigma=sigma, range_max=self.range_max)
        return replace(dense, ring_step=self.spacing, azimuth_step=self.spacing) if self.spacing else dense

    def at_scan(self, k: int) -> RosetteLidar:
        """Return a copy of the sensor with the pattern of scan k."""
        return replace(self, scan=self.scan + k)

    def fired(self) -> Bool:
        """Return which cells of the grid have a ray, shape (C, K)."""
        return _rays(self)[1]

    def sees(self, points: Float32) -> Bool:
        """Return which points, shape (N, 3) [m], are in cells with a ray, shape (N,)."""
        column, ring = self._cell(*_angles(points.astype(np.float64)))
        inside = (ring >= 0) & (ring < self.rings)
        seen: Bool = inside & self.fired()[column, np.clip(ring, 0, self.rings - 1)]
        return seen

    def _directions(self) -> Float:
        """Return the directions of the cells, shape (C, K, 3); their middles where there is no ray."""
        return _rays(self)[0]

    def _cell(self, azimuth: Float, elevation: Float) -> tuple[Int, Int]:
        """Return column and row of the cell of each direction [rad]; rows may be outside of the grid."""
        column = np.rint((np.pi - azimuth) / (2.0 * np.pi / self.columns)).astype(np.int64) % self.columns
        return column, np.rint((elevation - self.lowest) / self.ring_step).astype(np.int64)


def _angles(directions: Float) -> tuple[Float, Float]:
    """Return azimuth and elevation [rad] of directions or points, shape (N, 3)."""
    x, y, z = directions.T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


@lru_cache(maxsize=2)
def _rays(lidar: RosetteLidar) -> tuple[Float, Bool]:
    """Return the directions of the cells of a grid, shape (C, K, 3), and which have a ray, shape (C, K)."""
    directions = SpinningLidar._directions(lidar).copy()
    fired = np.zeros(directions.shape[:2], np.bool_)
    azimuth, elevation = PATTERNS[lidar.pattern](lidar.scan * PERIOD_S)
    column, ring = lidar._cell(azimuth, elevation)
    inside = (ring >= 0) & (ring < lidar.rings)
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    directions[column[inside], ring[inside]] = rays[inside]
    fired[column[inside], ring[inside]] = True
    return directions, fired


def _mid_360(start_s: float) -> tuple[Float, Float]:
    """Return azimuth and elevation [rad] of 20,000 rays from a time on [s]: four lasers on a mirror that
    turns 10.7 times a second and nods 357 times, from -7 to 52 degrees."""
    t = start_s + np.linspace(0.0, PERIOD_S, 5000, endpoint=False)[:, None]
    turn = np.broadcast_to(np.pi - 2.0 * np.pi * 10.7 * t, (5000, 4))
    nod = 2.0 * np.pi * 357.3 * t + 0.5 * np.pi * np.arange(4)
    elevation = np.radians(22.5 + 29.5 * np.sin(nod))
    return np.arctan2(np.sin(turn), np.cos(turn)).ravel(), elevation.ravel()


def _avia(start_s: float) -> tuple[Float, Float]:
    """Return azimuth and elevation [rad] of 24,000 rays from a time on [s]: six lasers, one above the other,
    through two prisms that turn against each other, in a cone of 70 degrees."""
    t = start_s + np.linspace(0.0, PERIOD_S, 4000, endpoint=False)[:, None]
    one, other = 2.0 * np.pi * 121.57 * t, -2.0 * np.pi * 77.73 * t
    half = np.radians(17.6)
    azimuth = np.broadcast_to(half * (np.cos(one) + np.cos(other)), (4000, 6))
    elevation = half * (np.sin(one) + np.sin(other)) + np.radians(0.68) * (np.arange(6) - 2.5)
    return azimuth.ravel(), elevation.ravel()


PATTERNS: dict[str, Callable[[float], tuple[Float, Float]]] = {"Mid-360": _mid_360, "Avia": _avia}


def _spinning(
    name: str, columns: int, rings: int, lowest: float, highest: float, far: float
) -> SpinningLidar:
    """Return a spinning LiDAR with evenly spaced rings from the lowest to the highest [degrees], and a
    maximum range [m]."""
    step = np.radians((highest - lowest) / (rings - 1))
    return SpinningLidar(
        columns, rings, lowest=np.radians(lowest), ring_step=float(step), range_max=far, name=name
    )


def _rosette(
    name: str, spacing: float, cell: float, lowest: float, highest: float, field: float, far: float
) -> RosetteLidar:
    """Return a LiDAR without rings with an angle between neighbouring returns and cells of a width, from the
    lowest to the highest elevation and to an azimuth to each side [degrees], and a maximum range [m]."""
    rings = round((highest - lowest) / cell) + 1
    return RosetteLidar(
        columns=round(360.0 / cell),
        rings=rings,
        lowest=np.radians(lowest),
        ring_step=float(np.radians(cell)),
        field=float(np.radians(field)),
        range_min=0.1,
        range_max=far,
        divergence=0.004,
        spacing=float(np.radians(spacing)),
        name=name,
        pattern=name,
    )


#: Simulated sensors by their names in URIs; the rings of VLP-32 and Helios are evenly spaced here.
LIDARS = {
    "vlp16": SpinningLidar(),
    "vlp32": _spinning("VLP-32", 1800, 32, -25.0, 15.0, 200.0),
    "os0-128": _spinning("OS0-128", 1024, 128, -45.0, 45.0, 50.0),
    "os1-64": _spinning("OS1-64", 1024, 64, -22.5, 22.5, 100.0),
    "xt32": _spinning("XT32", 2000, 32, -16.0, 15.0, 120.0),
    "helios": _spinning("Helios", 1800, 32, -55.0, 15.0, 150.0),
    "mid360": _rosette("Mid-360", 1.05, 0.4, -8.0, 53.0, 180.0, 40.0),
    "avia": _rosette("Avia", 0.0, 0.2, -38.0, 38.0, 36.0, 190.0),
    "solid": SolidStateLidar(),
}
