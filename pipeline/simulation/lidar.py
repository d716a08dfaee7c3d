"""Simulated LiDARs: their beams, and the receiver with mixed echoes at edges, lost weak echoes, and noise.

A sweep of the default sensor, a VLP-16, has 1,800 columns of 16 rays. It begins behind the robot and turns
clockwise seen from above, like the real sensor: column c has the azimuth pi - c * 0.2 degrees at c * 100 ms /
1800 after the stamp of the scan, which is the start of the sweep. All lasers of a column fire at once. Points
are in the sensor frame at their own time, as a driver gives them, so motion distorts the scan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pipeline.jit import compiled
from pipeline.simulation.primitives import ELLIPSOID, Solids
from pipeline.simulation.ray_casting import (
    GROUND,
    NOTHING,
    Optics,
    first_returns,
    ground_incidence,
    meet_solid,
    random_unit,
    ray_directions,
    solid_incidence,
)
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Bool, Float, Float32, Int32, Scan, Sensor

GROUND_REFLECTIVITY = 0.25
SIGMA_MIN = 0.001  # m; the pipeline divides by the range sigma of a sensor


@compiled
def count_echoes(
    kind: int, shape: Float, surface: Float, o: Float, d: Float, d_next: Float, divergence: float
) -> tuple[int, float]:
    """Divide a beam into eight rays side by side in azimuth; return how many meet a shape, 0 to 8, and the
    sum of their ranges [m].

    Args:
        kind, shape, surface: Row of `Solids`.
        o, d: Origin [m] and unit direction of the beam, shape (3,).
        d_next: Unit direction of the ray in the next column, shape (3,).
        divergence: Full width of the beam [rad] times the number of columns.
    """
    ray = np.empty(3)
    count, total = 0, 0.0
    for m in range(8):
        share = divergence * ((m + 0.5) / 8.0 - 0.5) / (2.0 * np.pi)
        for i in range(3):
            ray[i] = d[i] + share * (d_next[i] - d[i])
        met = meet_solid(kind, shape, surface, o, ray, 0.5)
        if met < np.inf:
            count += 1
            total += met
    return count, total


@compiled
def echo(
    c: int,
    k: int,
    ranges: Float,
    hit: Int32,
    solids: Solids,
    o: Float,
    directions: Float,
    optics: Optics,
    last: bool,
) -> tuple[float, int]:
    """Return range and shape that the receiver reports for beam k of column c.

    At the edge of a shape a part of the beam passes and meets the shape behind. Echoes nearer to one another
    than `Optics.pulse` are reported as one range in between; else the stronger one is reported, or the last
    one if `last`. Beams at the edge of foliage are not divided.

    Args:
        c, k: Column and beam.
        ranges, hit: Results of `first_returns`, shape (C, K).
        solids: The shapes.
        o: Positions of the sensor, shape (C, 3) [m].
        directions: Directions of the beams in the scene, shape (C, K, 3).
        optics: Beam and pulse.
        last: Whether the last of two echoes is preferred.

    Returns:
        Range [m], infinite without a return, and the row of the shape, GROUND or NOTHING.
    """
    columns = ranges.shape[0]
    before, after = max(c - 1, 0), min(c + 1, columns - 1)
    t, n = ranges[c, k], hit[c, k]
    # The comparison is false for two misses, whose difference is NaN.
    if not (abs(ranges[before, k] - t) >= 0.05 or abs(ranges[after, k] - t) >= 0.05):
        return t, n
    front = c
    if ranges[before, k] < ranges[front, k]:
        front = before
    if ranges[after, k] < ranges[front, k]:
        front = after
    kind, shape, surface = solids.kind, solids.shape, solids.surface
    edge = hit[front, k]
    if edge < 0 or (kind[edge] == 1 and shape[edge, 8] > 0.0):
        return t, n
    behind, behind_hit = t, n
    if n == edge:
        back = before if hit[before, k] != edge else after
        behind, behind_hit = ranges[back, k], hit[back, k]
    if behind_hit == edge or behind - ranges[front, k] < 0.05:
        return t, n
    neighbour = after if after != c else before
    count, total = count_echoes(
        kind[edge],
        shape[edge],
        surface[edge],
        o[c],
        directions[c, k],
        directions[neighbour, k],
        optics.divergence * columns,
    )
    if count == 0 or count == 8:
        return t, n
    near, part = total / count, count / 8.0
    strong = part * surface[edge, 0] / (near * near)
    weak = 0.0
    if behind < np.inf:
        weak = (
            (1.0 - part)
            * (surface[behind_hit, 0] if behind_hit >= 0 else GROUND_REFLECTIVITY)
            / (behind * behind)
        )
    if behind - near < optics.pulse:
        return (strong * near + weak * behind) / (strong + weak), edge
    if weak == 0.0 or (strong >= weak and not last):
        return near, edge
    return behind, behind_hit


@compiled
def measure(
    ranges: Float,
    hit: Int32,
    solids: Solids,
    terrain: Float,
    o: Float,
    directions: Float,
    optics: Optics,
    noise: Float,
    key: int,
    last: bool,
) -> tuple[Float, Float, Int32]:
    """Return what the receiver reports: range [m] (0 if there is no return, for a lost weak echo and outside
    of the measured ranges), reflectance 0..255 (0 if there is no return) and shape (row, GROUND or NOTHING),
    shape (C, K) each.

    Args:
        ranges, hit: Result of `first_returns`, shape (C, K).
        solids, terrain, o, directions, optics, key: See `first_returns`.
        noise: Error of each range [m], shape (C, K).
        last: Whether the last of two separate echoes is reported, not the stronger one.
    """
    kind, shape, surface = solids.kind, solids.shape, solids.surface
    columns, rings = ranges.shape
    reported = np.zeros((columns, rings))
    reflectance = np.zeros((columns, rings))
    source = np.full((columns, rings), NOTHING, dtype=np.int32)
    for c in range(columns):
        for k in range(rings):
            t, n = echo(c, k, ranges, hit, solids, o, directions, optics, last)
            if n == NOTHING or t > optics.range_max:
                continue
            if n == GROUND:
                reflectivity = GROUND_REFLECTIVITY
                incidence = ground_incidence(terrain, o[c], directions[c, k], t)
            else:
                reflectivity = surface[n, 0]
                incidence = 0.7
                if shape[n, 8] == 0.0 or kind[n] != ELLIPSOID:
                    incidence = solid_incidence(kind[n], shape[n], o[c], directions[c, k], t)
                    incidence = max(incidence, 0.05)
                if surface[n, 1] > 0.0:
                    t += surface[n, 1] * (2.0 * random_unit(n, c // 2, k) - 1.0)
            power = reflectivity * incidence * (optics.strength / t) ** 2
            if power < 10.0 and random_unit(key, c * rings + k, -2) > 1.0 - np.exp(-power):
                continue
            t += noise[c, k]
            if t < optics.range_min or t > optics.range_max:
                continue
            reported[c, k] = t
            shade = 100.0 * reflectivity * (0.4 + 0.6 * incidence)
            shade += 6.0 * (random_unit(key, c * rings + k, -3) - 0.5)
            reflectance[c, k] = min(max(np.floor(shade + 0.5), 0.0), 255.0)
            source[c, k] = n
    return reported, reflectance, source


def scan_of_returns(
    lidar: SpinningLidar, stamp_ns: int, reported: Float, reflectance: Float, source: Int32
) -> Sweep:
    """Return a scan of the returns of a sweep in the field of view, in the order of time, then ring, then
    echo, with the solid of each point.

    Args:
        lidar: The sensor.
        stamp_ns: Time of the start of the sweep [ns].
        reported: Range of each echo of each beam [m], 0 if there is no return, shape (C, K, echoes).
        reflectance, source: See `measure`; of the same shape.
    """
    column, ring, echo_number = np.nonzero(reported > 0.0)
    points = lidar.beams()[column, ring] * reported[column, ring, echo_number, None]
    in_view = lidar.sees(points.astype(np.float32))
    column, ring, echo_number, points = column[in_view], ring[in_view], echo_number[in_view], points[in_view]
    scan = Scan(
        stamp_ns,
        points.astype(np.float32),
        reflectance[column, ring, echo_number].astype(np.float32),
        ring.astype(np.int32),
        lidar.column_offsets_ns()[column],
    )
    return Sweep(scan, source[column, ring, echo_number])


@dataclass(frozen=True, slots=True)
class SpinningLidar:
    """A spinning LiDAR. The defaults are a VLP-16 at 10 Hz.

    Attributes:
        columns: Shots per revolution.
        rings: Number of lasers.
        lowest: Elevation of ring 0 [rad].
        ring_step: Angle between neighbouring rings [rad].
        period_ns: Duration of a revolution [ns].
        range_min, range_max: Measured ranges [m].
        range_sigma: Standard deviation of a range [m].
        divergence: Full width of a beam [rad].
        pulse: Echoes nearer to one another than this are reported as one [m].
        strength: Range at which a perpendicular surface of reflectivity 1 gives a return in 63 % of the shots
            [m].
        field: Half of the width of the field of view in azimuth [rad].
        dual: Whether the last echo of a beam is reported too, where it is separate from the strongest one.
        name: Name of the sensor.
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
    field: float = np.pi
    dual: bool = False
    name: str = "VLP-16"

    @property
    def sensor(self) -> Sensor:
        """The sensor as the pipeline describes it; its range sigma is at least 1 mm."""
        return Sensor(
            name=f"{self.name} (simulated)",
            rings=self.rings,
            ring_step=self.ring_step,
            azimuth_step=2.0 * np.pi / self.columns,
            range_sigma=max(self.range_sigma, SIGMA_MIN),
            range_max=self.range_max,
        )

    @property
    def optics(self) -> Optics:
        """Beams and receiver for the kernels."""
        return Optics(**{name: getattr(self, name) for name in Optics._fields})

    def column_offsets_ns(self) -> Int32:
        """Return the time of each column after the start of the sweep [ns], shape (C,)."""
        offsets = np.arange(self.columns, dtype=np.int64) * self.period_ns // self.columns
        return offsets.astype(np.int32)

    def beams(self) -> Float:
        """Return the unit directions of all rays in the sensor frame, shape (C, K, 3) for C columns and K
        rings. The array is shared between calls and must not be changed."""
        return _beams(self)

    def at_scan(self, k: int) -> SpinningLidar:  # noqa: ARG002 - all turns are alike
        """Return the sensor with the pattern of scan k: this sensor, because all turns are alike."""
        return self

    def fired(self) -> Bool:
        """Return which columns and rings have a ray, shape (C, K): all."""
        return np.ones((self.columns, self.rings), np.bool_)

    def sees(self, points: Float32) -> Bool:
        """Return which points, shape (N, 3) [m], are in the field of view, shape (N,): all."""
        return np.ones(len(points), np.bool_)

    def _directions(self) -> Float:
        """Return the unit directions of all rays in the sensor frame, shape (C, K, 3); column c has the
        azimuth pi - c 2 pi / C."""
        azimuth = np.pi - np.arange(self.columns) * (2.0 * np.pi / self.columns)
        elevation = self.lowest + np.arange(self.rings) * self.ring_step
        out = np.empty((self.columns, self.rings, 3))
        out[:, :, 0] = np.cos(azimuth)[:, None] * np.cos(elevation)
        out[:, :, 1] = np.sin(azimuth)[:, None] * np.cos(elevation)
        out[:, :, 2] = np.sin(elevation)
        return out


@lru_cache(maxsize=4)
def _beams(lidar: SpinningLidar) -> Float:
    """Return the unit directions of all rays of a sensor in its frame, shape (C, K, 3); the results for the
    last four sensors are stored, and must not be changed."""
    return lidar._directions()


CONE = float(np.radians(35.0))  # half the opening angle of a solid-state sensor


@dataclass(frozen=True, slots=True)
class SolidStateLidar(SpinningLidar):
    """A LiDAR that looks in one direction, in a cone, with a pattern that does not repeat.

    Attributes:
        pattern: Random seed of the pattern.
    """

    columns: int = 1028
    rings: int = 200
    lowest: float = -CONE
    ring_step: float = 2.0 * CONE / 199
    divergence: float = 0.004
    field: float = CONE
    name: str = "solid state"
    pattern: int = 0

    @property
    def sensor(self) -> Sensor:
        """The sensor as the pipeline describes it, without rings; the range sigma is at least SIGMA_MIN."""
        sigma = max(self.range_sigma, SIGMA_MIN)
        return Sensor(f"{self.name} (simulated)", azimuth_step=0.0035, range_sigma=sigma)

    def at_scan(self, k: int) -> SolidStateLidar:
        """Return a copy of the sensor with the pattern of scan k: the seed `pattern` + k."""
        return replace(self, pattern=self.pattern + k)

    def sees(self, points: Float32) -> Bool:
        """Return which points, shape (N, 3) [m], in the sensor frame are in the cone of CONE around x, shape
        (N,); False at the origin."""
        ahead: Bool = points[:, 0] > np.cos(CONE) * np.linalg.norm(points, axis=1)
        return ahead

    def _directions(self) -> Float:
        """Return a grid of rays, each moved at random by less than half a step, shape (C, K, 3); the seed
        `pattern` decides."""
        rng = np.random.default_rng(self.pattern)
        step, shape = 2.0 * np.pi / self.columns, (self.columns, self.rings)
        azimuth = np.pi - step * (np.arange(self.columns)[:, None] + rng.uniform(-0.45, 0.45, shape))
        elevation = self.lowest + self.ring_step * (np.arange(self.rings) + rng.uniform(-0.45, 0.45, shape))
        level = np.cos(elevation)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A sweep, and the solid of each of its points.

    Attributes:
        scan: The scan as a driver gives it.
        solid: Row of each point in the solids, -2 for the ground, -1 for a run through a cloud, int32, shape
            (N,).
    """

    scan: Scan
    solid: Int32


def cast_beams(
    lidar: SpinningLidar, solids: Solids, terrain: SimulatedTerrain, R: Float, o: Float, key: int
) -> tuple[Float, Float, Int32]:
    """Return the directions of the beams of a sweep in the world, shape (C, K, 3), and range [m] and shape
    (row of `solids`, GROUND or NOTHING) of the first return of each beam, see `first_returns`, shape (C, K)
    each.

    Args:
        lidar: The sensor.
        solids, terrain: The scene.
        R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        key: Random seed of foliage.
    """
    directions = ray_directions(R, lidar.beams())
    away = np.hypot(*(solids.capsule[:, :2] - o[lidar.columns // 2, :2]).T)
    order = np.argsort(away, kind="stable")
    return directions, *first_returns(solids, terrain.packed, R, o, directions, lidar.optics, key, order)


def sweep_scene(
    lidar: SpinningLidar,
    solids: Solids,
    terrain: SimulatedTerrain,
    R: Float,
    o: Float,
    stamp_ns: int,
    rng: np.random.Generator,
) -> Sweep:
    """Simulate a sweep of a scene.

    Args:
        lidar: The sensor.
        solids: All solids at this time, of any number.
        terrain: The ground.
        R, o: Pose of the sensor in the world at each column, shapes (C, 3, 3) and (C, 3) [m].
        stamp_ns: Time of the start of the sweep [ns].
        rng: Random generator of this sweep.

    Returns:
        The returns in the sensor frame at their own time, without correction of the motion; there may be
        none. A sensor with `dual` reports up to two per beam.
    """
    key = int(rng.integers(0, 2**62))
    noise = lidar.range_sigma * rng.standard_normal((lidar.columns, lidar.rings))
    directions, ranges, hit = cast_beams(lidar, solids, terrain, R, o, key)
    returns = [
        measure(ranges, hit, solids, terrain.packed, o, directions, lidar.optics, noise, key, last)
        for last in ((False, True) if lidar.dual else (False,))
    ]
    if lidar.dual:
        strongest, last_range = returns[0][0], returns[1][0]
        last_range[np.abs(last_range - strongest) < lidar.pulse] = 0.0
    return scan_of_returns(
        lidar, stamp_ns, *(np.stack(columns, axis=2) for columns in zip(*returns, strict=True))
    )
