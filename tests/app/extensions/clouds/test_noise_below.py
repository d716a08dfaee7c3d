"""Noise below the ground, stems that stand twice, and clouds in which no upright object is a tree."""

from __future__ import annotations

import numpy as np
import pytest

from app.extensions.clouds.cloud_frame import TURNED
from app.extensions.clouds.inventory import TWICE, _no_tree, _standing_twice, _too_thin, map_plot
from app.extensions.clouds.plot_ground import ground_steps
from app.extensions.clouds.point_cloud import open_cloud
from app.extensions.clouds.terrain_raster import NoiseBelow
from app.extensions.clouds.up_axis import up_by_ground
from app.sources.one_step import finish
from pipeline.config import preset
from pipeline.types.records import Verdict
from tests.app.extensions.clouds.made import Made
from tests.pipeline.plots import PLACES, hill, plot

FOREST = preset("forest")


def noise_below(points, rng, *, depth, share):
    """Points at random places and depths [m], as many as a share of the points."""
    n = int(share * len(points))
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    x, y = rng.uniform(low, high, (n, 2)).T
    return np.column_stack([x, y, rng.uniform(*depth, n)])


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    ("depth", "share"), [((-6.0, -0.3), 0.01), ((-40.0, -5.0), 0.01), ((-4.0, -0.5), 0.01)]
)
@pytest.mark.parametrize("slope", [0.0, 0.35])
def test_noise_below_the_ground_hides_no_stem(depth, share, slope):
    rng = np.random.default_rng(1)
    points = plot(rng, slope=slope)
    noise = noise_below(points, rng, depth=depth, share=share)
    noise[:, 2] += hill(noise[:, 0], noise[:, 1], slope)
    cloud = np.vstack([points, noise])
    assert up_by_ground(cloud)[0] == "z"
    m = map_plot(Made(cloud), FOREST)
    away = np.hypot(*(m.trees.position[:, None] - PLACES[:, :2]).transpose(2, 0, 1))
    assert len(m.trees.number) == len(PLACES)
    assert away.min(axis=0).max() < 0.03


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("name", ["pine_plot", "LPine1_demo", "MLS_Clip"])
def test_noise_below_a_real_plot_changes_no_ground(shared_data, name):
    cloud = open_cloud(str(shared_data / "forest" / f"{name}.laz"))
    points = np.concatenate(list(cloud.parts()))[::2, :3].astype(np.float64)
    rng = np.random.default_rng(2)
    noise = noise_below(points, rng, depth=(-30.0, -1.0), share=0.01)
    noise[:, 2] += np.percentile(points[:, 2], 1)
    grounds = [
        finish(ground_steps(Made(c), 45.0, band=(0.2, 3.0)))[0] for c in (points, np.vstack([points, noise]))
    ]
    x, y = grounds[0].covered_places()[grounds[0].seen[grounds[0].covered]].T
    assert np.percentile(np.abs(grounds[0].at(x, y) - grounds[1].at(x, y)), 95) < 0.4
    assert up_by_ground(np.vstack([points, noise])[::3])[0] == "z"


@pytest.mark.parametrize(("pairs", "is_told"), [(2, False), (5, True), (8, True)])
def test_stems_with_one_shift_stand_twice(pairs, is_told):
    rng = np.random.default_rng(3)
    place, dbh = rng.uniform(-10.0, 10.0, (14, 2)), rng.uniform(0.1, 0.4, 14)
    again = place[:pairs] + np.array([0.3, -0.2]) + rng.normal(0.0, 0.006, (pairs, 2))
    told = _standing_twice(np.vstack([place, again]), np.append(dbh, dbh[:pairs]))
    assert [text.startswith(TWICE) for text in told] == [True] * is_told
    assert not _standing_twice(place, dbh)


def test_rows_and_dense_stems_stand_once():
    rng = np.random.default_rng(4)
    rows = np.stack(np.meshgrid(np.arange(0.0, 8.0, 0.8), np.arange(0.0, 8.0, 0.8)), axis=-1).reshape(-1, 2)
    assert not _standing_twice(rows + rng.normal(0.0, 0.01, rows.shape), np.full(len(rows), 0.1))
    for _ in range(20):
        assert not _standing_twice(rng.uniform(-6.0, 6.0, (120, 2)), rng.uniform(0.06, 0.11, 120))
    twin_rows = np.stack(np.meshgrid([0.0, 0.75, 3.0, 3.75], np.arange(0.0, 20.0, 1.2)), axis=-1)
    twin_rows = twin_rows.reshape(-1, 2)
    assert not _standing_twice(twin_rows, np.full(len(twin_rows), 0.1))
    assert not _standing_twice(np.zeros((0, 2)), np.zeros(0))


def test_forked_stems_stand_once():
    rng, told = np.random.default_rng(5), 0
    for _ in range(100):
        place, angle = rng.uniform(-60.0, 60.0, (60, 2)), rng.uniform(0.0, 2.0 * np.pi, 60)
        twin = place + rng.uniform(0.2, 0.4, 60)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        told += bool(_standing_twice(np.vstack([place, twin]), np.full(120, 0.25)))
    assert told <= 2


def test_ground_that_is_hardly_seen_below_undergrowth_is_no_noise():
    rng, size = np.random.default_rng(6), 16.0
    places = rng.uniform(0.0, size, (64 * 15_680, 2))
    layers = ((-0.03, 0.03, 60), (0.5, 14.0, 1620), (14.0, 25.0, 14_000))  # of ground, undergrowth, crowns
    heights = np.concatenate([rng.uniform(low, high, 64 * n) for low, high, n in layers])
    noise = NoiseBelow(np.zeros(2), np.full(2, size))
    noise.add(np.column_stack([places, heights]).astype(np.float32))
    assert noise.floor() is None


@pytest.mark.parametrize(
    ("verdicts", "up", "seen", "is_told"),
    [([Verdict.BUSH] * 9, "z, as usual", 0.9, False), ([Verdict.POLE] * 3, "z, as usual", 0.9, True),
     ([Verdict.OTHER] * 2, "z, as usual", 0.9, False), ([], "z, as usual", 0.9, False),
     ([], f"-z, {TURNED}", 0.9, True), ([Verdict.BUSH], "z, as usual", 0.05, True),
     ([Verdict.POLE] * 5 + [Verdict.TREE], f"-z, {TURNED}", 0.05, False)],
)  # fmt: skip
def test_no_tree_is_doubted_where_something_may_hide_all(verdicts, up, seen, is_told):
    assert bool(_no_tree(np.array(verdicts, np.int32), up, seen)) == is_told


@pytest.mark.parametrize(("thin", "trees", "is_told"), [(5, 4, True), (5, 5, False), (2, 0, False)])
def test_stems_below_the_limit_of_a_radius_are_told_if_they_are_most(thin, trees, is_told):
    told = _too_thin(np.array([Verdict.TOO_THIN] * thin + [Verdict.TREE] * trees, np.int32), 0.04)
    assert ["limit of 0.08 m" in text for text in told] == [True] * is_told
