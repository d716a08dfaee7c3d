"""Streets and parks to learn from: simulated at random, seen by sensors of several kinds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.training.layout import lay_park, lay_street
from app.training.scene_objects import GROUND, Furniture
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.simulation.lidar import SpinningLidar, Sweep, sweep_scene
from pipeline.simulation.terrain import Terrain
from pipeline.types.records import Float, Float32, Int, Int32, Scan, Sensor, Step

CONE = float(np.radians(35.0))  # half of a solid-state sensor's field of view
PERIOD_NS = 100_000_000
PARKS_ONE_WAY, PARKS_ALL_AROUND = 0.6, 0.3  # part of the scenes that are parks
# Rings, lowest and highest elevation [deg], on a car or on a small robot, how often.
SPINNING = (
    (64, -24.8, 2.0, True, 0.5),
    (64, -22.5, 22.5, False, 0.2),
    (32, -30.67, 10.67, True, 0.15),
    (16, -15.0, 15.0, False, 0.15),
)


@dataclass(frozen=True, slots=True)
class SolidStateLidar(SpinningLidar):
    """A sensor that looks one way, in a cone, with a pattern that never repeats.

    Attributes:
        draw: Seed of the pattern.
    """

    columns: int = 1028
    rings: int = 200
    lowest: float = -CONE
    ring_step: float = 2.0 * CONE / 199
    divergence: float = 0.004
    draw: int = 0

    @property
    def sensor(self) -> Sensor:
        """What the pipeline is told of it: no rings."""
        return Sensor("solid state (simulated)", azimuth_step=0.0035, range_sigma=self.range_sigma)

    def beams(self) -> Float:
        """A grid of rays, each moved at random by less than half a step, shape (C, K, 3)."""
        rng = np.random.default_rng(self.draw)
        step, shape = 2.0 * np.pi / self.columns, (self.columns, self.rings)
        azimuth = np.pi - step * (np.arange(self.columns)[:, None] + rng.uniform(-0.45, 0.45, shape))
        elevation = self.lowest + self.ring_step * (np.arange(self.rings) + rng.uniform(-0.45, 0.45, shape))
        level = np.cos(elevation)
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """A scene that was simulated: steps to be mapped, and what is true.

    Attributes:
        steps: One a scan, with the true pose.
        sensor: What the pipeline is told; T_base_lidar: its mounting.
        points: All returns in the frame of the map, shape (N, 3) [m]; label: their classes, shape (N,).
        trunk: Places of the trunks, shape (T, 2) [m]; seen: returns of each, shape (T,).
    """

    steps: list[Step]
    sensor: Sensor
    T_base_lidar: Pose3
    points: Float
    label: Int
    trunk: Float
    seen: Int


def simulate_street(seed: int, *, one_way: bool) -> Street:
    """A street or a park, drawn from the seed, seen in one to four scans from one or more places."""
    rng = np.random.default_rng([seed, int(one_way), 0x57AEE7])
    slope = float(rng.choice([0.0, rng.uniform(-0.12, 0.12)]))
    terrain = Terrain.grow(slope, float(rng.uniform(0.0, 0.25)), float(rng.uniform(8.0, 25.0)), rng)
    furniture = Furniture(terrain, rng)
    park = rng.random() < (PARKS_ONE_WAY if one_way else PARKS_ALL_AROUND)
    (lay_park if park else lay_street)(furniture, rng)
    scans = int(rng.choice([1, 2, 4]))
    if one_way:
        lidar: SpinningLidar = SolidStateLidar(range_sigma=float(rng.uniform(0.01, 0.03)))
        height, advance, yaw = float(rng.uniform(0.6, 2.0)), 0.0, float(rng.uniform(-np.pi, np.pi))
    else:
        lidar, height = _spinning(rng)
        advance, yaw = float(rng.choice([0.0, 0.3, 1.0])), float(rng.normal(0.0, 0.1))
    poses = [Pose2(k * advance * np.cos(yaw), k * advance * np.sin(yaw), yaw) for k in range(scans)]
    return _see(lidar, height, furniture, terrain, poses, rng)


def _spinning(rng: np.random.Generator) -> tuple[SpinningLidar, float]:
    """A spinning LiDAR and its height [m]."""
    sigma = float(rng.uniform(0.01, 0.03))
    kind = int(rng.choice(len(SPINNING), p=[often for *_, often in SPINNING]))
    rings, low, high, on_car, _ = SPINNING[kind]
    step = float(np.radians((high - low) / (rings - 1)))
    height = float(rng.uniform(1.6, 2.1) if on_car else rng.uniform(0.6, 1.4))
    lidar = SpinningLidar(rings=rings, lowest=float(np.radians(low)), ring_step=step, range_sigma=sigma)
    return lidar, height


def _see(
    lidar: SpinningLidar,
    height: float,
    furniture: Furniture,
    terrain: Terrain,
    poses: list[Pose2],
    rng: np.random.Generator,
) -> Street:
    solids = furniture.solids()
    classes = np.array([*furniture.classes, GROUND])
    steps: list[Step] = []
    clouds, owners = [], []
    for k, pose in enumerate(poses):
        if isinstance(lidar, SolidStateLidar):
            lidar = replace(lidar, draw=int(rng.integers(0, 2**31)))
        c, s = np.cos(pose.yaw), np.sin(pose.yaw)
        R: Float = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        ground = float(terrain.height(np.array([pose.x]), np.array([pose.y]))[0])
        o: Float = np.array([pose.x, pose.y, ground + height])
        still = (np.tile(R, (lidar.columns, 1, 1)), np.tile(o, (lidar.columns, 1)))
        sweep = sweep_scene(lidar, solids, terrain, *still, k * PERIOD_NS, rng)
        points, solid = _in_view(sweep, isinstance(lidar, SolidStateLidar))
        steps.append(Step(k, Scan(k * PERIOD_NS, points), pose))
        clouds.append(points @ R.T + o)
        owners.append(np.where(solid >= 0, solids.owner[solid], -1))
    owner = np.concatenate(owners)
    trunk_owner = np.array([n for n, _, _ in furniture.trunks], np.int64)
    return Street(
        steps=steps,
        sensor=lidar.sensor,
        T_base_lidar=Pose3(np.eye(3), np.array([0.0, 0.0, height])),
        points=np.concatenate(clouds),
        label=classes[owner],
        trunk=np.array([[x, y] for _, x, y in furniture.trunks]).reshape(-1, 2),
        seen=np.bincount(owner[owner >= 0], minlength=len(furniture.classes))[trunk_owner],
    )


def _in_view(sweep: Sweep, one_way: bool) -> tuple[Float32, Int32]:
    """The points of a sweep, and what each belongs to, that lie in the sensor's field of view."""
    points = sweep.scan.points
    if not one_way:
        return points, sweep.solid
    kept = points[:, 0] > np.cos(CONE) * np.linalg.norm(points, axis=1)
    return points[kept], sweep.solid[kept]
