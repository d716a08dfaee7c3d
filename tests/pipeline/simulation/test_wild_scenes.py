"""`sim:wild`: stems against closed forms, leaves against the law of absorption, drawn values within their
bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import preset
from pipeline.evaluation import evaluate
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SpinningLidar, sweep_scene
from pipeline.simulation.primitives import ELLIPSOID, STEM, Section, SolidsBuilder
from pipeline.simulation.ray_casting import meet_cone, meet_stem
from pipeline.simulation.robot_motion import SPIN, drive_course, lay_course, lay_on_terrain, wheel_odometry
from pipeline.simulation.scenarios import QUALITIES, SCENARIOS, WILD
from pipeline.simulation.scene import Plot
from pipeline.simulation.scene_objects import SceneBuilder
from pipeline.simulation.terrain import SimulatedTerrain, WheelContact
from pipeline.simulation.wild_scenes import (
    BARK,
    DISTRIBUTIONS,
    LOWER_STEM,
    OBJECTS,
    add_wild_tree,
    draw_section,
)
from pipeline.types.records import HIDDEN, Float, TruthTrees
from tests.benchmarks.package_forest.augmentation import first_along
from tests.pipeline.strategies import trees

SEEDS = st.integers(0, 2**32 - 1)
FLAT = SimulatedTerrain(np.zeros((1, 4)))


def stem(section: Section, radius: float = 0.2, tilt: float = 0.0) -> tuple[Float, Float]:
    builder = SolidsBuilder()
    builder.stem(0, [0.0, 0.0, -5.0], [10.0 * tilt, 0.0, 5.0], (radius, radius), section)
    solids = builder.build()
    return solids.shape[0], solids.surface[0]


def outline(shape: Float, surface: Float, rays: int = 7200) -> Float:
    """Points where horizontal rays towards the axis meet a stem at height 0, shape (rays, 2)."""
    a = np.arange(rays) * (2.0 * np.pi / rays)
    towards = np.stack([np.cos(a), np.sin(a), np.zeros(rays)], axis=1)
    met = np.array([meet_stem(shape, surface, 3.0 * u, -u) for u in towards])
    points: Float = ((3.0 - met)[:, None] * towards)[:, :2]
    return points


def tape(points: Float) -> float:
    from scipy.spatial import ConvexHull

    return float(ConvexHull(points).area)


def test_a_stem_without_lobes_and_bark_is_a_cone():
    shape, surface = stem(Section(), tilt=0.1)
    rng = np.random.default_rng(2)
    for _ in range(300):
        o = rng.uniform(-3.0, 3.0, 3) + np.array([5.0, 0.0, 0.0])
        d = rng.uniform(-0.3, 0.3, 3) - np.array([1.0, 0.0, 0.0])
        d /= np.linalg.norm(d)
        cone, ours = meet_cone(shape, o, d), meet_stem(shape, surface, o, d)
        assert np.isfinite(ours) == np.isfinite(cone)
        if np.isfinite(cone):
            assert ours == pytest.approx(cone, abs=2e-3)


def test_the_tape_around_an_ellipse_has_its_perimeter():
    # An ellipse with half axes 1 + e and 1 - e: perimeter 2 pi (1 + e^2 / 4 + ...), Ramanujan 1914.
    e = 0.05
    assert Section(oval=e).perimeter_factor() == pytest.approx(1.0 + 0.75 * e * e, abs=1e-3)
    assert Section().perimeter_factor() == pytest.approx(1.0)


@settings(max_examples=8)
@given(SEEDS)
def test_a_tape_around_bark_touches_its_ridges(seed):
    rng = np.random.default_rng(seed)
    radius = float(rng.uniform(0.08, 0.3))
    section = draw_section(2.0 * radius, rng)
    shape, surface = stem(section, radius)
    points = outline(shape, surface)
    expected = 2.0 * np.pi * radius * section.perimeter_factor()
    # Between two ridges the tape is straight, which shortens it by less than 1 - cos of half their angle.
    short = 1.0 - np.cos(np.pi / section.furrows)
    assert tape(points) == pytest.approx(expected, rel=short + 5e-3)
    assert np.hypot(*points.T).min() >= radius * (2.0 - section.widest) - section.bark - 2e-3


def test_furrows_reach_their_depth():
    shape, surface = stem(Section(bark=0.02, furrows=24))
    r = np.hypot(*outline(shape, surface).T)
    assert r.max() == pytest.approx(0.2, abs=1e-3)
    assert r.min() == pytest.approx(0.18, abs=1e-3)


def test_leaves_pass_beams_by_the_law_of_absorption():
    builder = SolidsBuilder()
    builder.ellipsoid(0, [4.0, 0.0, 0.0], [0.5, 0.5, 0.5], free_path=0.4)
    rays = np.tile([1.0, 0.0, 0.0], (20_000, 1))
    passed = np.isinf(first_along(builder.build(), rays, 7)).mean()
    assert passed == pytest.approx(np.exp(-1.0 / 0.4), abs=0.01)


def test_ditches_are_as_deep_and_as_far_apart_as_asked():
    terrain = FLAT.with_ditches(0.3, 1.2, 12.0, 0.0, 0.25)
    z = terrain.height(np.linspace(0.0, 24.0, 2401), np.zeros(2401))
    assert z.max() - z.min() == pytest.approx(0.3, abs=0.03)
    low = np.flatnonzero((z[1:-1] < z[:-2]) & (z[1:-1] < z[2:]) & (z[1:-1] < z.min() + 0.01)) + 1
    np.testing.assert_allclose(0.01 * low, [3.0, 15.0], atol=0.02)


def test_wheels_average_the_ground():
    slope = WheelContact(SimulatedTerrain(np.array([[0.1, -0.05, 2.0, 0.0]])))
    np.testing.assert_allclose(slope.evaluate(np.array([3.0]), np.array([4.0])), [[2.1, 0.1, -0.05]])
    ditch = FLAT.with_ditches(0.3, 1.0, 12.0, 0.0, 0.0)
    x, y = np.linspace(0.0, 12.0, 400), np.zeros(400)
    ground, wheels = ditch.evaluate(x, y), WheelContact(ditch).evaluate(x, y)
    assert np.abs(wheels[:, 1]).max() < np.abs(ground[:, 1]).max()


def test_wheels_that_spin_measure_too_much():
    course = lay_course(np.array(SCENARIOS[WILD].waypoints), True)
    motion = lay_on_terrain(drive_course(course, 1.5, 120.0), FLAT, np.random.default_rng(0))
    spins = QUALITIES["slipping"].spins
    assert spins > 0.0
    quality = replace(QUALITIES["slipping"], scale=0.0, turn_scale=0.0, distance_noise=0.0)
    firm = replace(quality, spins=0.0)
    lengths = [
        np.hypot(*np.diff(wheel_odometry(motion, q, np.random.default_rng(1))[:, :2], axis=0).T).sum()
        for q in (quality, firm)
    ]
    expected = spins * lengths[1] * np.mean(SPIN)
    assert lengths[0] - lengths[1] == pytest.approx(expected, rel=0.5)


def test_the_same_seed_gives_the_same_bytes():
    first, again = (open_simulated("sim:wild?seed=104").run for _ in range(2))
    for k in (0, 37):
        assert first.sweep(k).scan.points.tobytes() == again.sweep(k).scan.points.tobytes()
    other = open_simulated("sim:wild?seed=105").run
    assert other.digest() != first.digest()
    assert other.sweep(0).scan.points.tobytes() != first.sweep(0).scan.points.tobytes()


def test_seeds_draw_every_sensor_and_numbers_within_their_bounds():
    names, law = set(), DISTRIBUTIONS["dbh"]
    runs = [open_simulated(f"sim:wild?seed={seed}").run for seed in range(100, 116)]
    for run in runs:
        truth = run.scene.truth
        names.add(run.lidar.name)
        dbh = truth.dbh[np.isfinite(truth.dbh)]
        assert len(dbh) == SCENARIOS[WILD].trees
        assert law.low <= dbh.min()
        assert dbh.max() <= law.high
        for kind in ("pole", "bush", "other"):
            of = [objects.count for objects in OBJECTS.values() if objects.kind == kind]
            assert sum(low for low, _ in of) <= truth.kind.count(kind) <= sum(high for _, high in of)
    assert len(names) == 4
    dbh = np.concatenate([run.scene.truth.dbh for run in runs])
    dbh = dbh[np.isfinite(dbh)]
    assert np.mean(dbh) == pytest.approx(0.5 * (law.low + law.high), abs=0.02)
    assert all(law.reason or law.unit for law in DISTRIBUTIONS.values())


def test_drawn_stems_keep_their_lean_diameter_and_bark():
    course = lay_course(np.array(SCENARIOS[WILD].waypoints), True)
    rng = np.random.default_rng(5)
    scene, plot = SceneBuilder(FLAT, rng), Plot(course, 15.0)
    for n in range(200):
        add_wild_tree(scene, plot, 100.0 + 20.0 * n, 0.0, 0.3)
    solids = scene.solids.build()
    lower = (solids.kind == STEM) & (solids.shape[:, 2] == 0.6)
    shape, surface = solids.shape[lower], solids.surface[lower]
    along = 0.7 / shape[:, 5]
    at_breast = shape[:, :3] + along[:, None] * shape[:, 3:6]
    np.testing.assert_allclose(at_breast[:, 0], 100.0 + 20.0 * np.arange(200), atol=1e-9)
    radius = shape[:, 7] + shape[:, 8] * along
    factor = [Section(*row[2:6]).perimeter_factor() for row in surface]
    np.testing.assert_allclose(2.0 * radius * factor, 0.3, atol=1e-9)
    lean = np.degrees(np.arccos(shape[:, 5]))
    assert lean.max() <= DISTRIBUTIONS["lean"].high + 1e-9
    assert lean.mean() == pytest.approx(4.0, abs=0.5)
    bark = surface[:, 6] * radius / shape[:, 7]
    assert np.all((bark >= BARK[0]) & (bark <= BARK[1] * 1.001))


def test_undergrowth_reaches_its_share_of_the_lower_stem():
    run = open_simulated("sim:wild?seed=100").run
    kinds = np.array(run.scene.kinds)
    plants = (run.scene.still.kind == ELLIPSOID) & (kinds[run.scene.still.owner] == "undergrowth")
    x, y, z = run.scene.still.shape[plants, :3].T
    top = z - run.scene.terrain.height(x, y) + run.scene.still.shape[plants, 5]
    law = DISTRIBUTIONS["undergrowth height"]
    assert np.count_nonzero(plants) > 60
    assert np.all((top >= LOWER_STEM * law.low - 1e-9) & (top <= LOWER_STEM * law.high + 1e-9))


def test_wind_moves_leaves_only_and_more_at_the_top():
    run = open_simulated("sim:wild?seed=101").run
    assert run.scene.wind > 0.0
    moved = [run.scene.solids_at(*run.sensor_poses(k)) for k in (0, 6)]
    shift = np.abs(moved[1].shape[:, 0] - moved[0].shape[:, 0])
    leaves = (moved[0].kind == ELLIPSOID) & (moved[0].shape[:, 8] > 0.0)
    assert shift[~leaves].max() == 0.0
    assert 0.0 < shift[leaves].max() < 2.0 * run.scene.wind * 3.0
    np.testing.assert_allclose(moved[0].capsule[leaves, 0], moved[0].shape[leaves, 0])


def test_trees_out_of_view_are_hidden_and_count_neither_way():
    truth = open_simulated("sim:wild?seed=105").truth().trees
    assert truth is not None
    assert HIDDEN in truth.kind
    plot = TruthTrees(np.array([0.0, 5.0]), np.zeros(2), np.full(2, 0.3), ("tree", HIDDEN))
    for places in ([[0.0, 0.0], [5.0, 0.1]], [[0.0, 0.0]]):
        e = evaluate(trees(places), plot, preset("forest").evaluation)
        assert (e.TA.count, e.TA.of, e.spurious, e.correctness) == (1, 1, 0, 1.0)


def test_two_echoes_are_separate_and_the_first_is_that_of_one_echo():
    builder = SolidsBuilder()
    builder.cone(0, [5.0, 0.0, -2.0], [5.0, 0.0, 2.0], (0.1, 0.1))
    builder.box(1, [12.0, 0.0, 0.0], [0.1, 6.0, 4.0])
    solids = builder.build()
    scans = []
    for dual in (False, True):
        lidar = SpinningLidar(range_sigma=0.0, dual=dual)
        still = np.tile(np.eye(3), (lidar.columns, 1, 1)), np.tile([0.0, 0.0, 1.0], (lidar.columns, 1))
        scans.append(sweep_scene(lidar, solids, FLAT, *still, 0, np.random.default_rng(1)).scan)
    one, two = scans
    assert len(one.points) < len(two.points) < 1.1 * len(one.points)
    known = {row.tobytes() for row in two.points}
    assert all(row.tobytes() in known for row in one.points)
