"""Whole sweeps: each ray hits the nearest solid, range noise has the requested sigma, and motion distorts the
scan."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar, Sweep, sweep_scene
from pipeline.simulation.primitives import ELLIPSOID, Solids, SolidsBuilder
from pipeline.simulation.ray_casting import GROUND, first_returns, ray_directions
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import Bool, Float
from tests.pipeline.simulation import oracle

DEEP = SimulatedTerrain(np.array([[0.0, 0.0, -500.0, 0.0]]))


def still_pose(lidar: SpinningLidar) -> tuple[Float, Float]:
    return np.tile(np.eye(3), (lidar.columns, 1, 1)), np.zeros((lidar.columns, 3))


def sweep(lidar: SpinningLidar, builder: SolidsBuilder, terrain: SimulatedTerrain = DEEP) -> Sweep:
    R, o = still_pose(lidar)
    return sweep_scene(lidar, builder.build(), terrain, R, o, 0, np.random.default_rng(0))


@pytest.mark.parametrize("lidar", [SpinningLidar(range_sigma=0.0), SolidStateLidar(range_sigma=0.0)])
def test_the_described_sensor_has_a_positive_range_sigma(lidar):
    assert lidar.sensor.range_sigma > 0.0


def only(solids: Solids, keep: Bool) -> Solids:
    s = solids
    return Solids(s.kind[keep], s.shape[keep], s.capsule[keep], s.surface[keep], s.owner[keep])


@pytest.mark.parametrize(("uri", "k"), [("sim:stand", 333), ("sim:slope?seed=1", 500), ("sim:dense", 77)])
def test_every_ray_of_a_moving_sweep_agrees_with_testing_all_shapes(uri, k):
    run = open_simulated(uri).run
    lidar, terrain = run.lidar, run.scene.terrain
    times, R, o = run.sensor_poses(k)
    bodies = [person.solids(float(times[0]), terrain) for person in run.scene.persons]
    solids = run.scene.still
    for body in bodies:
        solids = solids.join(body)
    solids = only(solids, (solids.kind != ELLIPSOID) | (solids.shape[:, 8] == 0.0))
    directions = ray_directions(R, lidar.beams())
    order = np.arange(len(solids.kind))
    ranges, hit = first_returns(solids, terrain.packed, R, o, directions, lidar.optics, 1, order)
    # Each third column, so that the slow way takes a second and not three.
    rays, origins = directions[::3].reshape(-1, 3), np.repeat(o[::3], lidar.rings, axis=0)
    slow = oracle.first_ranges(solids, origins, rays)
    ranges, hit = ranges[::3].ravel(), hit[::3].ravel()
    on_solid = hit >= 0
    assert on_solid.sum() > 700
    np.testing.assert_allclose(ranges[on_solid], slow[on_solid], atol=1e-6)
    # What did not meet a shape met the ground before any, or nothing within reach.
    missed = np.isfinite(slow) & (slow < lidar.range_max) & ~on_solid
    assert np.all(hit[missed] == GROUND)
    assert np.all(ranges[missed] < slow[missed] + 1e-3)
    some = np.random.default_rng(0).choice(np.nonzero(~on_solid)[0], 60, replace=False)
    ground = oracle.ground_ranges(terrain, origins[some], rays[some], 60.0)
    near = (ground < 59.0) & (ground < slow[some])
    np.testing.assert_allclose(ranges[some][near], ground[near], atol=0.02)


def test_range_noise_has_the_sigma_that_was_asked_for():
    for sigma in (0.01, 0.03):
        lidar = SpinningLidar(range_sigma=sigma)
        builder = SolidsBuilder()
        builder.box(0, [10.0, 0.0, 0.0], [1.0, 30.0, 30.0], reflectivity=0.9)
        scan = sweep(lidar, builder).scan
        error = np.linalg.norm(scan.points, axis=1) * (1.0 - 9.0 / scan.points[:, 0])
        error = error[np.abs(scan.points[:, 1]) < 9.0]
        assert error.size > 7000
        assert np.std(error) == pytest.approx(sigma, rel=0.04)
        assert abs(np.mean(error)) < 4.0 * sigma / np.sqrt(error.size)


def test_a_sweep_without_noise_lies_on_the_shape():
    lidar = SpinningLidar(range_sigma=0.0, divergence=0.0)
    builder = SolidsBuilder()
    builder.cone(0, [4.0, 1.0, -3.0], [4.0, 1.0, 3.0], (0.3, 0.3))
    points = sweep(lidar, builder).scan.points
    np.testing.assert_allclose(np.hypot(points[:, 0] - 4.0, points[:, 1] - 1.0), 0.3, atol=1e-5)


def test_a_cylinder_from_afar_has_the_eccentricity_of_the_closed_form():
    # Seen evenly in azimuth from afar, a half circle has e = (1/3) / (1 - 1/3 - (pi/4)^2) = 6.69.
    lidar = SpinningLidar(columns=360_000, rings=1, lowest=0.0, range_sigma=0.0, divergence=0.0, strength=1e6)
    builder = SolidsBuilder()
    builder.cone(0, [60.0, 0.0, -1.0], [60.0, 0.0, 1.0], (0.5, 0.5))
    level = sweep(lidar, builder).scan.points[:, :2].astype(np.float64)
    assert len(level) > 900
    largest, smallest = np.linalg.eigvalsh(np.cov(level.T, bias=True))[::-1]
    half_circle = (1.0 / 3.0) / (1.0 - 1.0 / 3.0 - (np.pi / 4.0) ** 2)
    assert largest / smallest == pytest.approx(half_circle, rel=0.02)


def test_flat_ground_drops_out_where_it_is_grazed():
    flat = SimulatedTerrain(np.array([[0.0, 0.0, -0.8, 0.0]]))
    ring = sweep(SpinningLidar(), SolidsBuilder(), terrain=flat).scan.ring
    assert ring is not None
    seen = np.bincount(ring, minlength=16) / 1800.0
    assert seen[0] > 0.99  # 15 degrees down, 3 m away
    assert seen[7] < 0.1  # 1 degree down, 46 m away
    assert np.all(np.diff(seen[:8]) <= 0.0)
    assert np.all(seen[8:] == 0.0)


def melted_points(gap: float) -> int:
    """Points of a cylinder 5 m away with a wall `gap` behind its front, of neither."""
    lidar = SpinningLidar(range_sigma=0.0)
    builder = SolidsBuilder()
    builder.cone(0, [5.2, 0.0, -2.0], [5.2, 0.0, 2.0], (0.2, 0.2))
    builder.box(0, [5.2 + gap + 0.5, 0.0, 0.0], [0.5, 3.0, 2.0])
    points = sweep(lidar, builder).scan.points.astype(np.float64)
    on_cylinder = np.abs(np.hypot(points[:, 0] - 5.2, points[:, 1]) - 0.2) < 0.01
    on_wall = np.abs(points[:, 0] - 5.2 - gap) < 0.01
    return int(np.sum(~on_cylinder & ~on_wall & (np.abs(points[:, 1]) < 0.5)))


def test_edges_melt_into_what_is_close_behind_and_only_there():
    # Sixteen rings with two edges each; the beam covers the edge in most of them or in few.
    assert melted_points(0.4) > 0
    assert melted_points(1.5) <= melted_points(0.4) // 4


def test_a_wide_beam_makes_thin_things_wider():
    def width(divergence: float) -> int:
        lidar = SpinningLidar(range_sigma=0.0, divergence=divergence, strength=1e6)
        builder = SolidsBuilder()
        builder.cone(0, [10.0, 0.02, -3.0], [10.0, 0.02, 3.0], (0.15, 0.15))
        return len(sweep(lidar, builder).scan.points)

    assert width(0.003) > width(0.0)


def test_foliage_lets_a_part_of_the_light_through():
    builder = SolidsBuilder()
    builder.ellipsoid(0, [6.0, 0.0, 0.0], [1.0, 1.0, 1.0], free_path=1.0)
    builder.box(1, [12.0, 0.0, 0.0], [0.5, 8.0, 4.0])
    got = sweep(SpinningLidar(range_sigma=0.0), builder)
    points = got.scan.points
    central = np.linalg.norm(points[:, 1:] / points[:, :1], axis=1) < 0.03
    through = np.mean(got.solid[central] == 1)
    # Through the middle the way is 2 m, at a mean free path of 1 m.
    assert through == pytest.approx(np.exp(-2.0), abs=0.06)
    depth = points[got.solid == 0, 0]
    assert np.ptp(depth) > 1.0


def test_points_come_in_the_order_of_time_clockwise_from_behind():
    scan = open_simulated("sim:stand").run.sweep(4).scan
    assert scan.offset_ns is not None
    assert scan.ring is not None
    assert np.all(np.diff(scan.offset_ns) >= 0)
    assert scan.offset_ns[0] < 1_000_000
    assert 99_000_000 < scan.offset_ns[-1] < 100_000_000
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    expected = np.pi - scan.offset_ns / 1e8 * 2.0 * np.pi
    difference = (azimuth - expected + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(difference).max() < np.radians(0.01)
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    np.testing.assert_allclose(elevation, -15.0 + 2.0 * scan.ring, atol=0.01)


def test_a_scan_is_bent_by_the_motion_and_straight_at_the_times_of_its_points():
    source = open_simulated("sim:paper?sigma=0")
    run = source.run
    k = 100
    got = run.sweep(k)
    scan = got.scan
    assert scan.offset_ns is not None
    times = k * 0.1 + scan.offset_ns / 1e9
    R, o = run.motion.sensor_at(times, run.T_base_lidar)
    each = np.einsum("nij,nj->ni", R, scan.points.astype(np.float64)) + o
    frozen = scan.points @ R[0].T + o[0]
    trunks = np.isin(got.solid, np.nonzero(run.scene.still.surface[:, 1] > 0.0)[0])

    def off_trunk(points: Float) -> Float:
        rows = got.solid[trunks]
        shape = run.scene.still.shape[rows]
        w = points[trunks] - shape[:, :3]
        h = np.sum(w * shape[:, 3:6], axis=1)
        side = np.linalg.norm(w - h[:, None] * shape[:, 3:6], axis=1)
        off: Float = np.abs(side - shape[:, 7] - shape[:, 8] * h)
        return off

    assert trunks.sum() > 300
    # Bark and mixed pixels aside, each point lies on its trunk only where it was really seen from.
    assert np.median(off_trunk(each)) < 0.005
    assert np.median(off_trunk(frozen)) > 0.01
    assert np.abs(frozen - each).max() > 0.05
