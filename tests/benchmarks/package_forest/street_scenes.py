"""Simulated streets and parks, seen in a few scans by LiDARs of several kinds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.poses import Pose2, Pose3
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar, sweep_scene
from pipeline.simulation.scene_objects import SceneBuilder, add_hedge
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Float, Scan, Sensor, Step
from tests.benchmarks.package_forest.street_objects import KINDS, add_car, add_fence, add_wall

PERIOD_NS = 100_000_000
PARKS_ONE_WAY, PARKS_ALL_AROUND = 0.6, 0.3  # share of the scenes that are parks
# Rings, lowest and highest elevation [deg], on a car (else on a small robot), and probability.
SPINNING = (
    (64, -24.8, 2.0, True, 0.5),
    (64, -22.5, 22.5, False, 0.2),
    (32, -30.67, 10.67, True, 0.15),
    (16, -15.0, 15.0, False, 0.15),
)
HALF_LENGTH, HALF_PARK = 42.0, 30.0  # m; of a street, of a park

# Probabilities of objects on a lawn and in a garden, and the parameters of the Dirichlet distribution from
# which the mixture of each verge is drawn.
LAWN = {
    "shrub": 0.28, "crown": 0.1, "lamp": 0.1, "sign": 0.08, "post": 0.1, "bin": 0.05, "person": 0.08,
    "motorcycle": 0.06, "hedge": 0.12, "drum": 0.03,
}  # fmt: skip
GARDEN = {"tree": 0.3, "crown": 0.2, "shrub": 0.35, "post": 0.1, "lamp": 0.05}
VERGE = {
    "tree": 1.2, "lamp": 0.7, "sign": 1.0, "bollard": 0.4, "mast": 0.2, "bin": 0.3, "motorcycle": 0.5,
    "person": 0.5, "shrub": 0.4, "drum": 0.3, "nothing": 0.8,
}  # fmt: skip
BORDERS = ("hedge", "fence", "wall", "house", "shrubs", "nothing")


@dataclass(frozen=True, slots=True, eq=False)
class StreetScans:
    """Scans of a simulated street or park with their ground truth.

    Attributes:
        steps: One step per scan, with the true pose.
        sensor, T_base_lidar: Sensor and its mounting.
        points: All returns in the frame of the map, shape (N, 3) [m].
        kind: Kind of the object of each return ("ground", "trunk", "foliage", "pole", ...), shape (N,).
        trunk: Positions of the trunks, shape (T, 2) [m].
        returns: Number of returns of each trunk, shape (T,).
    """

    steps: list[Step]
    sensor: Sensor
    T_base_lidar: Pose3
    points: Float
    kind: np.ndarray[tuple[int], np.dtype[np.str_]]
    trunk: Float
    returns: np.ndarray[tuple[int], np.dtype[np.int64]]


def simulate_street(seed: int, *, one_way: bool) -> StreetScans:
    """Simulate a street or a park that is drawn from the seed, seen in one, two or four scans, which may be
    made from one place. The same arguments give the same scans.

    Args:
        seed: Random seed, not negative.
        one_way: Whether a solid-state LiDAR looks in one direction from one place; otherwise a spinning
        LiDAR,
            which moves in most scenes.
    """
    rng = np.random.default_rng([seed, int(one_way), 0x57AEE7])
    slope = float(rng.choice([0.0, rng.uniform(-0.12, 0.12)]))
    terrain = SimulatedTerrain.grow(slope, float(rng.uniform(0.0, 0.25)), float(rng.uniform(8.0, 25.0)), rng)
    scene = SceneBuilder(terrain, rng)
    is_park = rng.random() < (PARKS_ONE_WAY if one_way else PARKS_ALL_AROUND)
    (_add_park if is_park else _add_street)(scene)
    scans = int(rng.choice([1, 2, 4]))
    lidar: SpinningLidar
    if one_way:
        lidar = SolidStateLidar(range_sigma=scene.uniform(0.01, 0.03))
        height, advance, yaw = scene.uniform(0.6, 2.0), 0.0, scene.uniform(-np.pi, np.pi)
    else:
        lidar, height = _spinning_lidar(scene)
        advance, yaw = float(rng.choice([0.0, 0.3, 1.0])), float(rng.normal(0.0, 0.1))
    poses = [Pose2(k * advance * np.cos(yaw), k * advance * np.sin(yaw), yaw) for k in range(scans)]
    return _scanned(scene, lidar, height, poses)


def _spinning_lidar(scene: SceneBuilder) -> tuple[SpinningLidar, float]:
    """Draw a spinning LiDAR (see SPINNING) and its height above the ground [m]; the generator of the scene
    advances."""
    sigma = scene.uniform(0.01, 0.03)
    rings, low, high, on_car, _ = SPINNING[int(scene.rng.choice(len(SPINNING), p=[p for *_, p in SPINNING]))]
    height = scene.uniform(1.6, 2.1) if on_car else scene.uniform(0.6, 1.4)
    low, step = float(np.radians(low)), float(np.radians((high - low) / (rings - 1)))
    return SpinningLidar(rings=rings, lowest=low, ring_step=step, range_sigma=sigma), height


def _scanned(scene: SceneBuilder, lidar: SpinningLidar, height: float, poses: list[Pose2]) -> StreetScans:
    """Return scans of a scene, one from each pose, without motion during a scan.

    Args:
        scene: The scene; its generator gives the noise.
        lidar: The sensor. A solid-state sensor gets a random pattern for each scan.
        height: Height of the sensor above the ground [m].
        poses: Poses in the plane.
    """
    solids, terrain = scene.solids.build(), scene.terrain
    steps, clouds, owners = list[Step](), [], []
    for k, pose in enumerate(poses):
        if isinstance(lidar, SolidStateLidar):
            lidar = replace(lidar, pattern=int(scene.rng.integers(0, 2**31)))
        T_map_lidar = Pose3.from_euler(scene.foot(pose.x, pose.y), 0.0, 0.0, pose.yaw)
        R, o = T_map_lidar.R, T_map_lidar.t + np.array([0.0, 0.0, height])
        still = (np.tile(R, (lidar.columns, 1, 1)), np.tile(o, (lidar.columns, 1)))
        sweep = sweep_scene(lidar, solids, terrain, *still, k * PERIOD_NS, scene.rng)
        points, solid = sweep.scan.points, sweep.solid
        t_ns = k * PERIOD_NS
        steps.append(Step(k, Scan(t_ns, points), pose, elapsed_ns=t_ns, period_ns=PERIOD_NS))
        clouds.append(points @ R.T + o)
        owners.append(np.where(solid >= 0, solids.owner[solid], -1))
    owner = np.concatenate(owners)
    trunks = scene.true_objects()  # streets and parks have no other ground truth
    return StreetScans(
        steps=steps,
        sensor=lidar.sensor,
        T_base_lidar=Pose3(np.eye(3), np.array([0.0, 0.0, height])),
        points=np.concatenate(clouds),
        kind=np.array([*scene.kinds, "ground"])[owner],
        trunk=np.stack([trunks.x, trunks.y], axis=1),
        returns=np.bincount(owner[owner >= 0], minlength=len(scene.kinds))[np.array(scene.owners, np.int64)],
    )


# --- layouts ---------------------------------------------------------------------------------------


def add_any(scene: SceneBuilder, kinds: Mapping[str, float], x: float, y: float) -> None:
    """Add an object of a kind drawn with its probability at x, y [m]; "nothing" adds none.

    Args:
        scene: Receives it.
        kinds: Probabilities by the name of the kind (of KINDS, or "nothing"), sum 1.
        x, y: Position [m].
    """
    kind = str(scene.rng.choice(list(kinds), p=list(kinds.values())))
    if kind != "nothing":
        KINDS[kind](scene, x, y)


def _add_street(scene: SceneBuilder) -> None:
    """Add verges with objects at both sides of a carriageway along x, then borders and gardens behind."""
    rng = scene.rng
    for side in (-1.0, 1.0):
        kerb = scene.uniform(2.8, 6.0)
        _add_verge(scene, side, kerb)
        border, x = kerb + scene.uniform(1.0, 5.0), -HALF_LENGTH
        while x < HALF_LENGTH:
            length = scene.uniform(2.0, 14.0)
            _add_border(scene, side, np.array([x, side * border]), length)
            for _ in range(int(rng.integers(0, 4))):
                x_garden, y_garden = x + length * rng.random(), side * (border + scene.uniform(0.8, 8.0))
                add_any(scene, GARDEN, x_garden, y_garden)
            x += length + float(rng.choice([0.0, rng.uniform(0.5, 3.0)]))


def _add_border(scene: SceneBuilder, side: float, start: Float, length: float) -> None:
    """Add a random kind of border behind a verge: hedge, fence, wall, house, shrubs, or none.

    Args:
        scene: Receives it.
        side: 1 on the left of the street, -1 on the right.
        start: Its first point, shape (2,) [m].
        length: Its length along x [m].
    """
    end = start + np.array([length, 0.0])
    kind = scene.rng.choice(BORDERS)
    if kind == "hedge":
        add_hedge(scene, start, end)
    elif kind == "fence":
        add_fence(scene, start, end)
    elif kind == "wall":
        add_wall(scene, start, end, scene.uniform(0.6, 2.2), 0.3)
    elif kind == "house":
        back = np.array([0.0, side * scene.uniform(3.0, 6.0)])
        add_wall(scene, start + back, end + back, scene.uniform(4.0, 8.0), 4.0)
    elif kind == "shrubs":
        for _ in range(int(length)):
            x, y = start + np.array([length * scene.rng.random(), side * scene.uniform(0.0, 1.5)])
            KINDS["shrub"](scene, x, y)


def _add_verge(scene: SceneBuilder, side: float, kerb: float) -> None:
    """Add objects along one side of a street, with a random mixture of kinds, and parked cars.

    Args:
        scene: Receives them.
        side: 1 on the left of the street, -1 on the right.
        kerb: Distance of the kerb from the middle of the street [m].
    """
    rng = scene.rng
    mixture = dict(zip(VERGE, rng.dirichlet(list(VERGE.values())).tolist(), strict=True))
    x = -HALF_LENGTH
    while x < HALF_LENGTH:
        add_any(scene, mixture, x, side * (kerb + scene.uniform(0.3, 1.2)))
        x += scene.uniform(1.5, 7.0)
    parked = float(rng.choice([0.0, 0.3, 0.8]))
    for x in np.arange(-HALF_LENGTH, HALF_LENGTH, 6.0):
        if rng.random() < parked and abs(x) > 4.0:
            add_car(scene, float(x), side * (kerb - 1.2), float(rng.normal(0.0, 0.03)))


def _add_park(scene: SceneBuilder) -> None:
    """Add rows of trees with gaps on a lawn with other objects; the surroundings of the sensor stay free."""
    rng = scene.rng
    spacing, turn = scene.uniform(3.0, 9.0), scene.uniform(0.0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    for row in np.arange(-HALF_PARK, HALF_PARK, scene.uniform(4.0, 15.0)):
        for along in np.arange(-HALF_PARK, HALF_PARK, spacing):
            u, v = along + 0.4 * rng.standard_normal(), row + 0.4 * rng.standard_normal()
            x, y = c * u - s * v, s * u + c * v
            if np.hypot(x, y) > 2.5 and rng.random() < 0.7:
                KINDS["tree"](scene, x, y)
    for _ in range(int(rng.integers(5, 40))):
        x, y = (float(v) for v in rng.uniform(-HALF_PARK, HALF_PARK, 2))
        if np.hypot(x, y) >= 3.0:
            add_any(scene, LAWN, x, y)
