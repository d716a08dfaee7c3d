"""Scenes: the ground truth matches the solids, the path is free, and each scenario opens."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.primitives import CONE
from pipeline.simulation.scenarios import SCENARIOS, WILD, scenarios
from pipeline.simulation.scene import Person
from pipeline.simulation.terrain import SimulatedTerrain
from pipeline.types.records import HIDDEN

PLAIN = [name for name in SCENARIOS if name != WILD]


@pytest.mark.slow_after(3)
@pytest.mark.parametrize("name", SCENARIOS)
def test_each_scenario_opens_and_its_path_keeps_clear(name):
    for seed in range(3):
        source = open_simulated(f"sim:{name}?seed={seed}")
        truth = source.truth()
        trees, path = truth.trees, truth.path
        assert trees is not None
        assert path is not None
        plan = SCENARIOS[name]
        assert trees.kind.count("tree") + trees.kind.count(HIDDEN) == plan.trees
        assert (HIDDEN in trees.kind) <= (name == WILD)
        away = np.hypot(path.x[:, None] - trees.x, path.y[:, None] - trees.y)
        radius = np.where(np.isnan(trees.dbh), 0.3, 0.5 * trees.dbh)
        assert (away - radius).min() >= 0.4
        walkers = sum(kind == "walker" for kind in source.run.scene.kinds) - len(plan.crossings)
        assert walkers == plan.walking


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("name", PLAIN)
def test_trunks_have_the_diameter_and_place_that_the_truth_tells(name):
    run = open_simulated(f"sim:{name}").run
    scene = run.scene
    truth = scene.truth
    solids = scene.still
    number = 0
    for row, (kind, x, y, dbh) in enumerate(zip(truth.kind, truth.x, truth.y, truth.dbh, strict=True)):
        assert np.isnan(dbh) == (kind != "tree")
        if kind != "tree":
            continue
        trunk = np.nonzero((solids.owner == row) & (solids.kind == CONE) & (solids.surface[:, 1] > 0))[0][0]
        shape = solids.shape[trunk]
        breast = scene.terrain.height(np.array([x]), np.array([y]))[0] + 1.3
        along = (breast - shape[2]) / shape[5]
        axis = shape[:3] + along * shape[3:6]
        np.testing.assert_allclose(axis[:2], [x, y], atol=1e-9)
        assert 2.0 * (shape[7] + shape[8] * along) == pytest.approx(dbh, abs=1e-6)
        # A centimetre of diameter for each metre; the lean is a few degrees.
        assert -2.0 * shape[8] / shape[5] == pytest.approx(0.01, rel=0.02)
        assert shape[5] > np.cos(np.radians(8.0))
        number += 1
    assert number == SCENARIOS[name].trees


def test_trunks_keep_their_distance_and_sizes():
    for name, plan in ((name, SCENARIOS[name]) for name in PLAIN):
        truth = open_simulated(f"sim:{name}?seed=5").run.scene.truth
        tree = np.array(truth.kind) == "tree"
        x, y, r = truth.x[tree], truth.y[tree], 0.5 * truth.dbh[tree]
        free = np.hypot(x[:, None] - x, y[:, None] - y) - r[:, None] - r
        np.fill_diagonal(free, np.inf)
        assert free.min() >= plan.gap
        assert truth.dbh[tree].min() >= plan.dbh[0] - 1e-9
        assert truth.dbh[tree].max() <= plan.dbh[1] + 1e-9


def test_dense_has_1500_stems_on_a_hectare():
    plan = SCENARIOS["dense"]
    assert plan.trees / (2.0 * plan.half_side) ** 2 * 1e4 == pytest.approx(1500.0)


def test_the_papers_plot_has_its_things_within_its_box():
    source = open_simulated("sim:paper")
    trees = source.truth().trees
    assert trees is not None
    assert sorted(trees.kind) == ["bush", "person", "pole", "pole", *["tree"] * 7]
    path = source.truth().path
    assert path is not None
    nearest = np.hypot(path.x[:, None] - trees.x, path.y[:, None] - trees.y).min(axis=0)
    assert np.all((nearest > 1.2) & (nearest < 6.0))
    assert np.abs(path.y).max() < 1.0


@pytest.mark.slow
def test_one_may_ask_for_more_trees_until_the_plot_is_full():
    trees = open_simulated("sim:stand?trees=90").truth().trees
    assert trees is not None
    assert trees.kind.count("tree") == 90
    with pytest.raises(SourceError, match="no place is left for another tree"):
        open_simulated("sim:stand?trees=2000")
    few = open_simulated("sim:paper?trees=3").truth().trees
    assert few is not None
    assert few.kind.count("tree") == 3
    assert "tree" not in open_simulated("sim:stand?trees=0").run.scene.truth.kind


def test_walkers_go_at_their_pace_and_stay_on_the_ground():
    terrain = SimulatedTerrain.grow(0.1, 0.3, 9.0, np.random.default_rng(1))
    walker = Person(7, np.array([1.0, 2.0]), np.array([7.0, 2.0]), 0.0, 1.1, 3.0)
    places = np.array([walker.place(t)[0] for t in np.arange(0.0, 30.0, 0.1)])
    steps = np.hypot(*np.diff(places, axis=0).T)
    assert np.median(steps) == pytest.approx(0.11)
    assert steps.max() <= 0.11 + 1e-9
    assert places[:, 0].min() >= 1.0
    assert places[:, 0].max() <= 7.0
    body = walker.solids(4.2, terrain)
    ground = terrain.height(body.capsule[:, 0], body.capsule[:, 1])
    top = (np.maximum(body.capsule[:, 2], body.capsule[:, 5]) - ground).max()
    assert 1.5 < top < 1.9
    assert set(body.owner) == {7}


def test_who_stands_only_sways():
    at = np.array([3.0, 4.0])
    somebody = Person(0, at, at, 1.0, 0.0, 2.0)
    places = np.array([somebody.place(t)[0] for t in np.arange(0.0, 60.0, 0.5)])
    reach = np.hypot(*(places - at).T)
    assert 0.005 < reach.max() < 0.03


def test_menu_lists_every_scenario():
    menu = scenarios()
    assert list(menu) == [f"sim:{name}" for name in SCENARIOS]
    assert {"sim:stand", "sim:paper", "sim:slope", "sim:dense", "sim:wild"} <= set(menu)
    assert all(len(line) > 20 for line in menu.values())
